"""Scenes in the layout of DeepShadow: shadow pictures of a relief seen from straight above, with given point lights."""

from pathlib import Path

import numpy as np
from msgspec import Struct

from calibration.calibration import Calibration
from calibration.camera import Camera
from calibration.known_scene import Importer, KnownScene
from calibration.light import Light
from calibration.lights.number_lists import named_numbers
from calibration.pose import Pose
from calibration.scenes.distant_camera import LOOKING_DOWN
from capture.errors import CalibrationError
from capture.files.names import inside
from capture.files.schema import Number, Positive, read_scene, read_text
from capture.photos.photo import read_grey
from capture.session.sorting import scene_photos

LIGHTS, PARAMETERS, PICTURES = "all_object_lights.txt", "params.json", "0"
BACKGROUND = 0.5  # of the silhouette's white: darker pixels are bare ground
BELOW_LIGHTS = 0.5  # of the distance from the camera to the nearest light: the assumed place of the relief


def _recognised(folder: Path) -> str | None:
    is_one = (folder / LIGHTS).is_file() and (folder / PARAMETERS).is_file()
    return f"{LIGHTS} and {PARAMETERS}" if is_one else None


class _Parameters(Struct):
    focal_length: Positive
    cam_location_x: Number
    cam_location_y: Number
    cam_location_z: Number


def load_deepshadow(folder: Path) -> KnownScene:
    """Load camera, lights and picture files of a DeepShadow scene, world frame (z up), scene units.

    The camera stands at the place in params.json and looks straight down: a light at world (x, y, z) lies at
    (x - cx, cy - y, cz - z) of the camera at (cx, cy, cz). The principal point is the centre of the picture.
    The layout does not give the ground's height, so `ground_known` is False and ground_height is assumed: far below
    the camera, by the distance of the lights. A silhouette without background carries no information and is left out.

    Args:
        folder: holds all_object_lights.txt (name x y z in each line), params.json, and 0/NAME_shadow1.png.

    Raises:
        CalibrationError: a file or field is missing or impossible; the message names both.
    """
    names, places, _ = named_numbers(read_text(folder / LIGHTS), folder / LIGHTS)
    if None in names:
        raise CalibrationError(
            f"{folder / LIGHTS}, light {names.index(None) + 1} has no name; 'name x y z' was needed."
        )
    usable = scene_photos([inside(folder, f"{PICTURES}/{one}_shadow1.png", str(folder / LIGHTS)) for one in names])
    shadow, places = tuple(usable.paths), places[usable.rows]
    height, width = read_grey(shadow[0]).shape
    given = read_scene(folder / PARAMETERS, _Parameters)
    eye = np.array([given.cam_location_x, given.cam_location_y, given.cam_location_z])
    camera = Camera.centred(width, height, given.focal_length)
    lights = tuple(Light(path.name, "point", position=place) for place, path in zip(places, shadow, strict=True))
    nearest = float(np.linalg.norm(places - eye, axis=1).min())
    ground = min(eye[2] - BELOW_LIGHTS * nearest, float(places[:, 2].min()) - 0.5 * BELOW_LIGHTS * nearest)
    # white on black, named after the first picture
    mask = folder / PICTURES / f"{shadow[0].name.split('_0_0')[0]}_silhouette.png"
    is_blank = not mask.is_file() or (read_grey(mask) >= BACKGROUND).all()
    return KnownScene(
        Calibration(camera, Pose(LOOKING_DOWN, eye), float(ground), lights, unit="scene"),
        rgb_paths=None,
        shadow_paths=shadow,
        mask_path=None if is_blank else mask,
        photos=usable,
        mask_is_grey=True,
        ground_known=False,
    )


IMPORTER = Importer("DeepShadow (all_object_lights.txt)", _recognised, lambda folder, _: load_deepshadow(folder))
