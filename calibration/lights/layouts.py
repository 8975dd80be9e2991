"""Convert light positions or directions in the layouts of other programs to the world frame of a capture.

The picture's frame: x right, y up, z towards the camera, origin where the middle of the photo shows the ground.
Scenes with a camera of their own (ShadowNeuS, S3-NeRF) are placed by it.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from calibration.light import Light, Vector
from calibration.pose import Pose
from calibration.posed_camera import PosedCamera
from capture.errors import CalibrationError
from capture.files.arrays import read_npz
from capture.files.json_field import JsonField, read_json

PLACE_KEYS = ("positions3d", "positionsSphere", "positions")  # of a dome
BLENDER = np.diag([1.0, -1.0, -1.0])  # OpenCV camera axes from those of Blender and OpenGL, and from the picture's
ROTATION_ERROR = 1e-3  # exporters round to six digits, or write float32


@dataclass(frozen=True)
class Rows:
    """The content of a file without powers: per light a name (or none) and a position or direction; how it was read."""

    names: tuple[str | None, ...]
    values: Float[np.ndarray, "rows 3"]  # world
    kind: str  # "point" | "directional"
    first: int = 1  # number in the name of the photo that belongs to the first row
    note: str = ""
    unit: str = ""  # of places, where the file names one

    def lights(self) -> tuple[Light, ...]:
        """Return the light of each row, without a photo."""
        if self.kind == "point":
            return tuple(Light("", "point", position=value) for value in self.values)
        return tuple(Light("", "directional", direction=value / np.linalg.norm(value)) for value in self.values)


# --- over the picture ------------------------------------------------------------------------------------------------


def turned(values: Float[np.ndarray, "rows 3"], posed_camera: PosedCamera) -> Float[np.ndarray, "rows 3"]:
    """Rotate vectors of the picture's frame to the world."""
    return posed_camera.world_from_camera.rotate(values @ BLENDER)


def view_note(posed_camera: PosedCamera) -> str:
    """Return the note on directions over the picture."""
    tilt = float(np.degrees(np.arccos(np.clip(-posed_camera.world_from_camera.rotation[2, 2], -1, 1))))
    return f"lights: directions are read in the picture's axes; the camera looks {tilt:.0f} degrees off straight down"


def dome_rows(document: JsonField, posed_camera: PosedCamera) -> Rows:
    """Parse RelightLab's dome. Its lengths are cm or mm by version; over imageWidth they need no unit.

    Raises:
        CalibrationError: no lights, or places without a scale.
    """
    content = document.value
    layout = document["lightConfiguration"].text() if "lightConfiguration" in content else "directional"
    key = {"spherical": "positionsSphere", "lights3d": "positions3d"}.get(layout, "directions")
    key = "positions" if key != "directions" and key not in content and "positions" in content else key
    width = document["imageWidth"].number() if "imageWidth" in content else 0.0
    is_point = key != "directions" and width > 0 and bool(content.get(key))
    if not is_point and not content.get("directions") and any(content.get(n) for n in PLACE_KEYS):
        raise CalibrationError(f"{document.file}: positions without 'imageWidth' have no scale; it was needed.")
    vectors = np.array([_xyz(entry) for entry in document[key if is_point else "directions"].entries()])
    if not vectors.size or not np.linalg.norm(vectors, axis=1).all():
        raise CalibrationError(f"{document.file}: no direction or position per light, one for each photo was needed.")
    values = turned(vectors, posed_camera)
    if is_point:
        middle = posed_camera.looked_at()
        reach = float(np.linalg.norm(middle - posed_camera.centre))
        values = middle + values * (reach * posed_camera.camera.width / posed_camera.camera.fx / width)
    kind = "point" if is_point else "directional"
    return Rows((None,) * len(values), values, kind, note=view_note(posed_camera))


def _xyz(entry: JsonField) -> Vector:
    if isinstance(entry.value, dict):
        return np.array([entry[axis].number() for axis in "xyz"])
    return entry.vector()


# --- scenes with a camera of their own -------------------------------------------------------------------------------


def _placed(
    places: Float[np.ndarray, "rows 3"], camera: Pose, floor: float | None, posed_camera: PosedCamera, file: str
) -> Float[np.ndarray, "rows 3"]:
    """Transform places of another world to ours through its camera, scaled by the cameras' heights above the ground.

    Raises:
        CalibrationError: that camera does not stand above its floor.
    """
    scale = 1.0
    if floor is not None:
        if not camera.translation[2] > floor:
            raise CalibrationError(f"{file}: the floor, {floor:g}, lies above the camera; one below it was needed.")
        scale = (posed_camera.centre[2] - posed_camera.ground_height) / (camera.translation[2] - floor)
    return posed_camera.world_from_camera.apply(scale * camera.inverse().apply(places))


def rigid(matrix: Any, file: str, name: str) -> Pose:
    """Return the pose of a 4 x 4 matrix that exporters rounded.

    Raises:
        CalibrationError: not a rotation and translation; names file and field.
    """
    matrix = np.array(matrix, dtype=float)
    if matrix.shape == (4, 4) and np.isfinite(matrix).all():
        left, size, right = np.linalg.svd(matrix[:3, :3])
        if np.abs(size - 1).max() < ROTATION_ERROR and np.linalg.det(left @ right) > 0:
            return Pose(left @ right, matrix[:3, 3])
    raise CalibrationError(f"{file}: {name} is not a 4 x 4 matrix of rotation and translation; export it again.")


def _matrix(field: JsonField) -> Float[np.ndarray, "4 4"]:
    """Four rows of four numbers.

    Raises:
        CalibrationError: names the field.
    """
    rows = field.entries()
    if len(rows) != 4:
        raise field.refuse("4 rows of 4 numbers were")
    return np.array([row.numbers(4) for row in rows])


def shadowneus_real_rows(path: Path, posed_camera: PosedCamera) -> Rows:
    """ShadowNeuS' params.npz of real photos: light_pose, camera_pose (OpenCV axes), floor_height.

    Raises:
        CalibrationError: a member is missing, of the wrong shape, or too large.
    """
    content = read_npz(path, ("light_pose", "camera_pose", "floor_height"))
    light, camera, floor = content["light_pose"], content["camera_pose"], content["floor_height"]
    if light.ndim != 3 or light.shape[1:] != (4, 4) or not np.isfinite(light).all() or floor.size != 1:
        raise CalibrationError(f"{path}: light_pose has the shape {light.shape}, N x 4 x 4 finite numbers were needed.")
    pose, height = rigid(camera, str(path), "camera_pose"), float(floor.reshape(()))
    values = _placed(light[:, :3, 3], pose, height, posed_camera, str(path))
    return Rows((None,) * len(values), values, "point", first=0)


def shadowneus_rows(document: JsonField, path: Path, posed_camera: PosedCamera) -> Rows:
    """Parse ShadowNeuS' transforms_*.json; transforms_floor.json beside it gives the scale.

    Raises:
        CalibrationError: a field is missing or impossible.
    """
    frames = document["frames"].entries()
    if not frames:
        raise document["frames"].refuse("one entry for each photo was")
    matrices = [_matrix(frame["transform_matrix_sun"]) for frame in frames]
    pose = rigid(
        _matrix(frames[0]["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0]), str(path), "transform_matrix"
    )
    names = tuple(frame["file_path"].text() for frame in frames)
    if document.value.get("light_type") == "directional":
        towards = np.stack([matrix[:3, 2] for matrix in matrices])
        if not np.linalg.norm(towards, axis=1).all():
            raise CalibrationError(f"{path}: a 'transform_matrix_sun' has no direction; export it again.")
        turned = posed_camera.world_from_camera.rotate(pose.inverse().rotate(towards))
        return Rows(names, turned, "directional", first=0)
    floor_file = path.with_name("transforms_floor.json")
    floor = None
    if floor_file.is_file():
        grounds = JsonField(read_json(floor_file), str(floor_file))["frames"]
        if not grounds.entries():
            raise grounds.refuse("one entry with transform_ground was")
        floor = float(_matrix(grounds.entries()[0]["transform_ground"])[2, 3])
    values = _placed(np.stack([matrix[:3, 3] for matrix in matrices]), pose, floor, posed_camera, str(floor_file))
    return Rows(names, values, "point", first=0)


def s3nerf_rows(document: JsonField, posed_camera: PosedCamera) -> Rows:
    """S3-NeRF's params.json: light_pos in a world whose camera pose_c2w looks along its -z.

    Raises:
        CalibrationError: a field is missing or impossible.
    """
    places = np.array([entry.numbers(3) for entry in document["light_pos"].entries()])
    if not len(places):
        raise document["light_pos"].refuse("one place for each photo was")
    pose = rigid(_matrix(document["pose_c2w"]) @ np.diag([1.0, -1.0, -1.0, 1.0]), document.file, "pose_c2w")
    values = _placed(places, pose, None, posed_camera, document.file)
    note = "lights: the file gives no height of its camera, so its lengths are read in the unit of this capture"
    return Rows((None,) * len(values), values, "point", note=note)
