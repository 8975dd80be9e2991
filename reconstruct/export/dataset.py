"""A finished run as a data set for other programs: pictures of one size from each camera, and a light for each."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from calibration.calibration import Calibration
from calibration.camera import Camera
from calibration.light import Light
from calibration.pose import Pose
from calibration.posed_camera import PosedCamera
from capture.errors import ReconstructionError
from capture.files.names import stored_file
from capture.photos.photo import read_photo
from reconstruct.fields import SolvedScene
from reconstruct.render.g_buffer import look
from reconstruct.render.relight import relight
from reconstruct.stored_run.stored_run import StoredRun

UNSAFE = re.compile(r"[^A-Za-z0-9_.-]+")  # in file names of lists that are split at spaces, or on other systems
PHOTO_FOLDERS = ("", "photos", "train", "image", "rgb", "jpeg-exports")  # of a capture or scene, where photos may lie


@dataclass(frozen=True)
class Dataset:
    """One picture per light, in order. World frame and unit of the run."""

    run: StoredRun
    lights: tuple[Light, ...]  # those that were used; `photo` is the capture's file name
    camera: Camera  # of the pictures
    photos: tuple[Path, ...] | None  # the capture's; None: the surface is relit
    calibration: Calibration  # of the view
    fields: SolvedScene  # as the view saw them, in the world of its object pose
    view: str

    @property
    def posed_camera(self) -> PosedCamera:
        """The camera of the pictures above its ground, or above the flat base where no ground is known."""
        return PosedCamera(self.camera, self.calibration.world_from_camera, self.fields.ground_height)

    def in_common(self, matrix: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
        """Return world_from_something in the world of the first view: not its own for another object pose."""
        motion = self.fields.object_from_world
        return matrix if motion is None else motion.matrix() @ matrix

    @cached_property
    def stems(self) -> tuple[str, ...]:
        """Return a unique file name for each picture, without ending: letters, digits and _.- only."""
        found: list[str] = []
        for light in self.lights:
            name = f"{self.view}_{Path(light.photo).stem}" if self.view else Path(light.photo).stem
            stem = UNSAFE.sub("_", name) or "photo"
            found.append(stem if stem not in found else f"{stem}_{len(found)}")
        return tuple(found)

    def pictures(self, camera: Camera) -> Iterator[Float[np.ndarray, "height width 3"]]:
        """Yield the picture (linear colour) under each light, as `camera` sees it from the same place."""
        if self.photos is not None:
            yield from (_seen_by(camera, self.camera, read_photo(path).rgb) for path in self.photos)
            return
        view = look(self.fields, posed_camera=replace(self.posed_camera, camera=camera))
        for light in self.lights:
            yield relight(view, light, self.calibration.beam, self.calibration.ambient).numpy()


def open_datasets(run: StoredRun, photos: Path | None) -> tuple[Dataset, ...]:
    """Return camera and lights of each view of a run, with the capture's photos or pictures of the relit surface.

    Args:
        photos: folder of the capture, or of its photos; None: relit, at the size the solver worked at.

    Raises:
        ReconstructionError: no light was used, or a photo is missing, of another size, or lit by several lights.
    """
    return tuple(_of_view(run, photos, *view) for view in run.views)


def _of_view(run: StoredRun, photos: Path | None, view: str, calibration: Calibration, fields: SolvedScene) -> Dataset:
    used = tuple(light for light in calibration.lights if light.used)
    if not used:
        raise ReconstructionError(
            f"{run.run_dir} has no light that was used; at least one was needed. Calibrate again."
        )
    if photos is None:
        return Dataset(run, used, fields.camera, None, calibration, fields, view)
    names = [light.photo for light in used]
    if len(set(names)) < len(names):
        raise ReconstructionError(
            f"{names[0]} or another photo is lit by several lights at once; a picture for each light was needed. Leave "
            "--photos out: the surface is relit by one light each."
        )
    paths = tuple(_photo(photos / view, name) for name in names)
    camera = calibration.camera
    height, width = read_photo(paths[0]).rgb.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise ReconstructionError(
            f"{paths[0]} is {width} x {height} pixels, {camera.width} x {camera.height} as in the run was needed. Give "
            "the capture that the run was made from."
        )
    return Dataset(run, used, camera, paths, calibration, fields, view)


def centred(camera: Camera) -> Camera:
    """Return a camera without distortion, with square pixels and the principal point in the middle, of the same size.

    It sees nothing beyond the given camera's picture. A camera that already is like this is returned unchanged.
    """
    middle = ((camera.width - 1) / 2, (camera.height - 1) / 2)
    plain = replace(camera, distortion=(0.0,) * 5, fisheye=False, sigmas={})
    if not any(camera.distortion) and (camera.cx, camera.cy) == middle and camera.fx == camera.fy:
        return plain
    u, v = np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float)
    left, right = (camera.unproject(np.stack([np.full_like(v, x), v], -1))[:, 0] for x in (0.0, camera.width - 1.0))
    top, bottom = (camera.unproject(np.stack([u, np.full_like(u, y)], -1))[:, 1] for y in (0.0, camera.height - 1.0))
    half_width, half_height = min(-left.max(), right.min()), min(-top.max(), bottom.min())
    focal = float(max(middle[0] / half_width, middle[1] / half_height))
    return replace(plain, fx=focal, fy=focal, cx=middle[0], cy=middle[1])


def opengl(pose: Pose) -> Float[np.ndarray, "4 4"]:
    """Return the 4x4 matrix world_from_camera for programs whose cameras look along -z, with y up."""
    return pose.matrix() @ np.diag([1.0, -1.0, -1.0, 1.0])


def light_matrix(light: Light, posed_camera: PosedCamera) -> Float[np.ndarray, "4 4"]:
    """Return the 4x4 matrix world_from_light. The light shines along its -z at the middle.

    A directional light is placed far away.
    """
    middle = posed_camera.looked_at()
    back, distance = light.seen_from(middle)
    if light.position is None:
        distance = float(np.linalg.norm(middle - posed_camera.centre))
    out = np.eye(4)
    out[:3, :3] = Rotation.align_vectors([back], [[0.0, 0.0, 1.0]])[0].as_matrix()
    out[:3, 2], out[:3, 3] = back, middle + distance * back
    return out


def kind_of(lights: tuple[Light, ...], layout: str) -> str:
    """Return the kind of all lights, "point" or "directional".

    Raises:
        ReconstructionError: the lights are of both kinds, and the layout has only one.
    """
    kinds = {light.kind for light in lights}
    if len(kinds) > 1:
        raise ReconstructionError(f"the run has point and directional lights; {layout} needs one kind for all.")
    return kinds.pop()


def _photo(folder: Path, name: str) -> Path:
    for place in PHOTO_FOLDERS:
        path = folder / place / name
        if stored_file(path).is_file():
            return path
    raise ReconstructionError(
        f"{folder} holds no {name}, which the run was made from; looked in it and in its "
        f"{', '.join(PHOTO_FOLDERS[1:])}. Give the folder of the capture with --photos, or leave it out."
    )


def _seen_by(
    camera: Camera, from_camera: Camera, rgb: Float[np.ndarray, "height width 3"]
) -> Float[np.ndarray, "rows columns 3"]:
    """Resample a picture of one camera as another camera at the same place sees it."""
    if camera == from_camera:
        return rgb
    at = from_camera.project(camera.unproject(camera.pixel_grid())).astype(np.float32)
    return cv2.remap(rgb, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
