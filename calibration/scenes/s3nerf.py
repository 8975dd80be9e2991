"""Scenes in the layout of S3-NeRF: params.json and rgb/, one camera, point lights.

params.json holds `imhw`, `K` (pixel centres at +0.5), and either `pose_c2w` (OpenGL axes: looks along -z) with
`light_pos` (world), or, for photographs, `n_light`. Photographs have light_direction_sdps.npy beside it (camera axes
of OpenGL) and lights at a distance that the layout does not hold: the authors' default is the camera's,
4 K[0][0] / height. Row i belongs to the photo whose name ends in i + 1. Pixel values are linear. World z is up; the
ground is not given, and is estimated.
"""

import re
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Float
from msgspec import Meta, Struct

from calibration.calibration import Calibration
from calibration.camera import Camera
from calibration.known_scene import Importer, KnownScene
from calibration.light import Light
from calibration.lights.layouts import lamps
from calibration.lights.photo_lists import photos_in
from calibration.lights.power import find_ground_height, preview, with_common_power
from calibration.pose import Pose
from calibration.posed_camera import PosedCamera
from calibration.scenes.distant_camera import LOOKING_DOWN
from capture.decode.formats import read_size
from capture.errors import CalibrationError
from capture.files.arrays import read_npy
from capture.files.schema import EXPORT, Count, Vector, as_type, read_json
from capture.session.sorting import scene_photos

PARAMETERS, PHOTOS, SHADOWS, MASK = "params.json", "rgb", "visibility", "mask_obj.png"
DIRECTIONS = "light_direction_sdps.npy"
CAMERA_DISTANCE = 4.0  # of K[0][0] / height: the authors' default where it is not measured


class _Parameters(Struct):
    imhw: Annotated[tuple[int, int], Meta(description="height and width")]
    K: Annotated[tuple[Vector, Vector, Vector], Meta(description="three rows of three numbers")]
    n_light: Count = 0

    def __post_init__(self) -> None:
        self.camera()

    def camera(self) -> Camera:
        """Return the camera."""
        (fx, _, cx), (_, fy, cy), _ = self.K
        return Camera(self.imhw[1], self.imhw[0], fx, fy, cx - 0.5, cy - 0.5)


def _recognised(folder: Path) -> str | None:
    """Look for params.json beside rgb/; DeepShadow has the file, but not the folder."""
    is_one = (folder / PARAMETERS).is_file() and bool(photos_in(folder / PHOTOS))
    return f"{PARAMETERS} and {PHOTOS}/" if is_one else None


def _load(folder: Path, split: str) -> KnownScene:
    """Load camera, point lights, photos, and the ground if shading gives its height; else in the picture's frame.

    Raises:
        CalibrationError, CaptureError: a file or field is missing or impossible; the message names both.
    """
    source = folder / PARAMETERS
    content = read_json(source)
    parameters = as_type(content, _Parameters, str(source), EXPORT)
    is_captured = "light_pos" not in content
    camera = parameters.camera()
    pose, places, note = _captured(camera, parameters.n_light, folder) if is_captured else (*lamps(content, source), "")
    found_photos, rows = _numbered(folder / PHOTOS, len(places), source)
    shadows = [folder / SHADOWS / path.name for path in found_photos]
    has_shadows = all(path.is_file() for path in shadows)
    usable = scene_photos(found_photos, *([shadows] if has_shadows else []))
    photos, rows = usable.paths, [rows[row] for row in usable.rows]
    size = read_size(photos[0])
    if size != (camera.width, camera.height):
        raise CalibrationError(
            f"{source}: 'imhw' is {camera.height} x {camera.width} and {photos[0].name} is {size[1]} x "
            f"{size[0]} (rows x columns); equal sizes were needed. Use the photos that the file describes."
        )
    calibration, found = _grounded(PosedCamera(camera, pose, 0.0), places[rows], photos, is_captured)
    mask = folder / MASK
    return KnownScene(
        with_common_power(calibration, preview(photos, is_linear=True)),
        tuple(photos),
        tuple(folder / SHADOWS / path.name for path in photos) if has_shadows else None,
        mask if mask.is_file() else None,
        mask_is_grey=True,
        ground_known=found is not None,
        is_linear=True,
        notes=tuple(filter(None, (note, found, "photos: pixel values are linear, as in this layout"))),
        photos=usable,
    )


def _grounded(
    posed_camera: PosedCamera, places: Float[np.ndarray, "lights 3"], photos: list[Path], is_captured: bool
) -> tuple[Calibration, str | None]:
    """Return the scene on the ground estimated from shading, with a sentence; without one, in the picture's frame."""
    names = [path.name for path in photos]
    lights = tuple(Light(n, "point", position=place) for n, place in zip(names, places, strict=True))
    scene = Calibration.of(posed_camera, lights, unit="scene")
    found = None if is_captured else find_ground_height(preview(photos, is_linear=True), scene)
    if found is not None:
        height, share = found
        note = f"ground: found at z = {height:.4g} from its shading, in {share:.0%} of the picture"
        return replace(scene, ground_height=height), note
    eye = posed_camera.centre
    away = float(np.median(np.linalg.norm(places - eye, axis=1)))
    camera_from_world = posed_camera.world_from_camera.inverse()
    pose = Pose(LOOKING_DOWN, np.array([0.0, 0.0, float(np.linalg.norm(eye)) or away]))
    places = pose.apply(camera_from_world.apply(places))
    ground = min(0.0, float(places[:, 2].min()) - 0.1 * away)
    lights = tuple(replace(light, position=place) for light, place in zip(lights, places, strict=True))
    return Calibration.of(PosedCamera(posed_camera.camera, pose, ground), lights, unit="scene"), None


def _captured(camera: Camera, count: int, folder: Path) -> tuple[Pose, Float[np.ndarray, "lights 3"], str]:
    """The camera's pose and the lights of photographs: at an assumed distance from the point looked at; with a note."""
    towards = read_npy(folder / DIRECTIONS)
    towards = towards[0] if towards.ndim == 3 else towards
    if towards.shape != (count, 3) or not np.isfinite(towards).all():
        raise CalibrationError(
            f"{folder / DIRECTIONS} has the shape {towards.shape}, {count} x 3 finite numbers ('n_light' of "
            f"{folder / PARAMETERS}) were needed."
        )
    away = CAMERA_DISTANCE * camera.fx / camera.height
    pose = Pose(LOOKING_DOWN, np.array([0.0, 0.0, away]))
    note = f"lights: directions only; they and the camera were assumed {away:.3g} units away, the layout's default"
    return pose, away * towards, note


def _numbered(folder: Path, n_rows: int, source: Path) -> tuple[list[Path], list[int]]:
    """Return the photos, and for each the row that its number gives."""
    photos = photos_in(folder)
    numbers = [re.findall(r"[0-9]{1,9}", path.stem) for path in photos]
    rows = [int(found[-1]) - 1 if found else -1 for found in numbers]
    wrong = [path.name for path, row in zip(photos, rows, strict=True) if not 0 <= row < n_rows]
    if wrong or len(set(rows)) < len(rows):
        which = wrong[0] if wrong else "two photos with one number"
        raise CalibrationError(
            f"{folder} holds {which}, and {source} gives {n_rows} lights; names that end in numbers from 1 to "
            f"{n_rows}, each once, were needed."
        )
    return photos, rows


IMPORTER = Importer("S3-NeRF (params.json with K)", _recognised, _load)
