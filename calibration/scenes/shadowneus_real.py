"""Photographs in the layout of ShadowNeuS: params.npz, image/ and mask.png.

`light_pose` (N x 4 x 4, of the phone that held the light), `camera_pose` (OpenCV axes), `camera_intrinsics` (pixel
centres at +0.5), `floor_height`; world z is up. The lights stand where that phone's camera was. mask.png is white where
the object is or may be, so it is no silhouette: the outline is found from the photos.
"""

from pathlib import Path

import numpy as np

from calibration.calibration import Calibration
from calibration.camera import Camera
from calibration.known_scene import Importer, KnownScene
from calibration.light import Light
from calibration.lights.known_ground import preview
from calibration.lights.layouts import rigid
from calibration.lights.photo_lists import photos_in
from calibration.lights.power import with_common_power
from capture.decode.formats import read_size
from capture.errors import CalibrationError
from capture.files.arrays import read_npz
from capture.session.sorting import scene_photos

PHOTOS, MASK = "image", "mask.png"
ARRAYS = ("light_pose", "camera_pose", "camera_intrinsics", "floor_height")
TRAIN = "train"


def _recognised(folder: Path) -> str | None:
    files = sorted(folder.glob("params*.npz"))
    is_one = bool(files) and bool(photos_in(folder / PHOTOS))
    return f"{files[0].name} and {PHOTOS}/" if is_one else None


def _load(folder: Path, split: str) -> KnownScene:
    """Load camera, ground, point lights (world) and photos.

    Args:
        split: "train" reads params.npz where there is no params_train.npz.

    Raises:
        CalibrationError, CaptureError: an array is missing or impossible, or does not fit the photos.
    """
    source = folder / f"params_{split}.npz"
    if split == TRAIN and not source.is_file():
        source = folder / "params.npz"
    content = read_npz(source, ARRAYS)
    poses, floor = content["light_pose"], content["floor_height"]
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or not np.isfinite(poses).all():
        raise CalibrationError(f"{source}: light_pose has the shape {poses.shape}, N x 4 x 4 finite were needed.")
    if floor.size != 1 or not np.isfinite(floor).all():
        raise CalibrationError(f"{source}: floor_height holds {floor.size} numbers, one finite one was needed.")
    height, pose = float(floor.reshape(())), rigid(content["camera_pose"], str(source), "camera_pose")
    photos = photos_in(folder / PHOTOS)
    if len(photos) != len(poses):
        raise CalibrationError(
            f"{source}: light_pose gives {len(poses)} lights and {folder / PHOTOS} holds {len(photos)} photos; as "
            "many were needed, in the same order."
        )
    usable = scene_photos(photos)
    photos, poses = usable.paths, poses[usable.rows]
    camera = _camera(content["camera_intrinsics"], read_size(photos[0]), source)
    low = [path.name for path, place in zip(photos, poses[:, 2, 3], strict=True) if place <= height]
    if pose.translation[2] <= height or low:
        raise CalibrationError(
            f"{source}: floor_height {height:g} lies above {f'the light of {low[0]}' if low else 'the camera'}; a "
            "floor below it was needed (world z is up)."
        )
    lights = [Light(path.name, "point", position=m[:3, 3].copy()) for path, m in zip(photos, poses, strict=True)]
    calibration = Calibration(camera, pose, height, tuple(lights), unit="scene")
    notes = ["lights: assumed at the camera of the phone that held them"]
    if (folder / MASK).is_file():
        notes.append(f"{MASK}: not used, it marks all possible object pixels; the outline is found from the photos")
    return KnownScene(
        with_common_power(calibration, preview(photos)),
        tuple(photos),
        None,
        None,
        notes=tuple(notes),
        photos_left_out=usable.left_out,
        every_photo=usable.every,
    )


def _camera(intrinsics: np.ndarray, size: tuple[int, int], source: Path) -> Camera:
    is_matrix = intrinsics.shape in ((3, 3), (4, 4)) and np.isfinite(intrinsics).all()
    if not is_matrix or min(intrinsics[0, 0], intrinsics[1, 1]) <= 0:
        raise CalibrationError(
            f"{source}: camera_intrinsics has the shape {intrinsics.shape}, a 4 x 4 matrix with positive focal lengths "
            "was needed."
        )
    fx, fy, cx, cy = (float(intrinsics[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    if not (0 < cx < size[0] and 0 < cy < size[1]):
        raise CalibrationError(
            f"{source}: camera_intrinsics puts the optical axis at ({cx:g}, {cy:g}), outside the photos of {size[0]} x "
            f"{size[1]} pixels; the intrinsics of these photos were needed."
        )
    return Camera(*size, fx, fy, cx - 0.5, cy - 0.5)


IMPORTER = Importer("ShadowNeuS, photographs (params.npz)", _recognised, _load)
