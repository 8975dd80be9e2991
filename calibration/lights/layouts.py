"""Convert light positions or directions in the layouts of other programs to the world frame of a capture.

The picture's frame: x right, y up, z towards the camera, origin where the middle of the photo shows the ground.
Scenes with a camera of their own (ShadowNeuS, S3-NeRF) are placed by it.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float
from msgspec import Meta, Struct, ValidationError, convert, structs

from calibration.light import Light
from calibration.pose import Pose
from calibration.posed_camera import PosedCamera
from capture.errors import CalibrationError
from capture.files.arrays import read_npz
from capture.files.schema import (
    EXPORT,
    MOST_ENTRIES,
    Matrix,
    NotNegative,
    Number,
    Text,
    Vector,
    as_type,
    read_scene,
    refused,
)

FROM_BLENDER = np.diag([1.0, -1.0, -1.0, 1.0])  # the same as a motion
BLENDER = FROM_BLENDER[:3, :3]  # OpenCV camera axes from those of Blender and OpenGL, and from the picture's
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
        """Return the light of each row, its photo as the file names it."""
        pairs = [(name or "", value) for name, value in zip(self.names, self.values, strict=True)]
        if self.kind == "point":
            return tuple(Light(name, "point", position=value) for name, value in pairs)
        return tuple(Light(name, "directional", direction=value / np.linalg.norm(value)) for name, value in pairs)


# --- over the picture ------------------------------------------------------------------------------------------------


def turned(values: Float[np.ndarray, "rows 3"], posed_camera: PosedCamera) -> Float[np.ndarray, "rows 3"]:
    """Rotate vectors of the picture's frame to the world."""
    return posed_camera.world_from_camera.rotate(values @ BLENDER)


def view_note(posed_camera: PosedCamera) -> str:
    """Return the note on directions over the picture."""
    tilt = float(np.degrees(np.arccos(np.clip(-posed_camera.world_from_camera.rotation[2, 2], -1, 1))))
    return f"lights: directions are read in the picture's axes; the camera looks {tilt:.0f} degrees off straight down"


class _Xyz(Struct):
    x: Number
    y: Number
    z: Number


Vectors = Annotated[tuple[Vector | _Xyz, ...], Meta(max_length=MOST_ENTRIES)]


class _Dome(Struct, rename="camel"):
    directions: Vectors = ()
    positions: Vectors = ()
    positions3d: Vectors = ()
    positions_sphere: Vectors = ()
    light_configuration: Text = "directional"
    image_width: NotNegative = 0.0


def dome_rows(content: Any, path: Path, posed_camera: PosedCamera) -> Rows:
    """Parse RelightLab's dome. Its lengths are cm or mm by version; over imageWidth they need no unit.

    Raises:
        CalibrationError: no lights, or places without a scale.
    """
    dome = as_type(content, _Dome, str(path), EXPORT)
    layout = {"spherical": dome.positions_sphere, "lights3d": dome.positions3d}
    places = layout.get(dome.light_configuration) or (dome.positions if dome.light_configuration in layout else ())
    is_point = bool(places) and dome.image_width > 0
    if not is_point and not dome.directions and (dome.positions or dome.positions3d or dome.positions_sphere):
        raise CalibrationError(f"{path}: positions without 'imageWidth' have no scale; it was needed.")
    given = places if is_point else dome.directions
    vectors = np.array([structs.astuple(one) if isinstance(one, _Xyz) else one for one in given])
    if not vectors.size or not np.linalg.norm(vectors, axis=1).all():
        raise CalibrationError(f"{path}: no direction or position per light, one for each photo was needed.")
    values = turned(vectors, posed_camera)
    if is_point:
        middle = posed_camera.looked_at()
        reach = float(np.linalg.norm(middle - posed_camera.centre))
        values = middle + values * (reach * posed_camera.camera.width / posed_camera.camera.fx / dome.image_width)
    kind = "point" if is_point else "directional"
    return Rows((None,) * len(values), values, kind, note=view_note(posed_camera))


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


def read_params(
    path: Path, *more: str
) -> tuple[Float[np.ndarray, "photos 3"], Pose, float, dict[str, Float[np.ndarray, "..."]]]:
    """Return the lights' places, the camera (OpenCV axes) and the floor's height of ShadowNeuS' params.npz.

    Args:
        more: further arrays that are needed; all are returned by name.

    Raises:
        CalibrationError: an array is missing, of the wrong shape, or too large.
    """
    content = read_npz(path, ("light_pose", "camera_pose", "floor_height", *more))
    light, floor = content["light_pose"], content["floor_height"]
    if light.ndim != 3 or light.shape[1:] != (4, 4) or not np.isfinite(light).all():
        raise CalibrationError(f"{path}: light_pose has the shape {light.shape}, N x 4 x 4 finite numbers were needed.")
    if floor.size != 1 or not np.isfinite(floor).all():
        raise CalibrationError(f"{path}: floor_height holds {floor.size} numbers, one finite one was needed.")
    return light[:, :3, 3], rigid(content["camera_pose"], str(path), "camera_pose"), float(floor.reshape(())), content


def shadowneus_real_rows(path: Path, posed_camera: PosedCamera) -> Rows:
    """ShadowNeuS' params.npz of real photos.

    Raises:
        CalibrationError: as read_params.
    """
    places, pose, height, _ = read_params(path)
    values = _placed(places, pose, height, posed_camera, str(path))
    return Rows((None,) * len(values), values, "point", first=0)


class Frame(Struct):
    """A photo in ShadowNeuS' transforms_*.json."""

    file_path: Text
    transform_matrix: Matrix
    transform_matrix_sun: list[Any]  # a matrix; after reading the list of them, because a photo may have several lights

    def __post_init__(self) -> None:
        given = self.transform_matrix_sun
        is_list = bool(given) and isinstance(given[0], list) and bool(given[0]) and isinstance(given[0][0], list)
        try:
            self.transform_matrix_sun = convert(given if is_list else [given], list[Matrix])
        except ValidationError:
            raise refused("transform_matrix_sun", given, "4 rows of 4 numbers") from None


class Frames(Struct, kw_only=True):
    """The content of transforms_*.json."""

    frames: Annotated[list[Frame], Meta(min_length=1, max_length=MOST_ENTRIES)]
    light_type: Literal["point", "directional"] | None = None


class _FloorFrame(Struct):
    transform_ground: Matrix


class Floor(Struct):
    """The content of transforms_floor.json."""

    frames: Annotated[list[_FloorFrame], Meta(min_length=1, description="one entry with transform_ground")]


def shadowneus_rows(content: Any, path: Path, posed_camera: PosedCamera) -> Rows:
    """Parse ShadowNeuS' transforms_*.json; transforms_floor.json beside it gives the scale.

    Raises:
        CalibrationError: a field is missing or impossible.
    """
    given = as_type(content, Frames, str(path), EXPORT)
    suns = [(frame.file_path, sun) for frame in given.frames for sun in frame.transform_matrix_sun]
    names, matrices = tuple(name for name, _ in suns), np.array([sun for _, sun in suns])
    pose = rigid(np.array(given.frames[0].transform_matrix) @ FROM_BLENDER, str(path), "transform_matrix")
    if given.light_type == "directional":
        towards = matrices[:, :3, 2]
        if not np.linalg.norm(towards, axis=1).all():
            raise CalibrationError(f"{path}: a 'transform_matrix_sun' has no direction; export it again.")
        turned = posed_camera.world_from_camera.rotate(pose.inverse().rotate(towards))
        return Rows(names, turned, "directional", first=0)
    floor_file = path.with_name("transforms_floor.json")
    floor = None
    if floor_file.is_file():
        floor = read_scene(floor_file, Floor).frames[0].transform_ground[2][3]
    values = _placed(matrices[:, :3, 3], pose, floor, posed_camera, str(floor_file))
    return Rows(names, values, "point", first=0)


class _Lamps(Struct):
    pose_c2w: Matrix
    light_pos: Annotated[list[Vector], Meta(min_length=1, description="one place for each photo")]


def s3nerf_rows(content: Any, path: Path, posed_camera: PosedCamera) -> Rows:
    """S3-NeRF's params.json: light_pos in a world whose camera pose_c2w looks along its -z.

    Raises:
        CalibrationError: a field is missing or impossible.
    """
    pose, places = lamps(content, path)
    note = "lights: the file gives no height of its camera, so its lengths are read in the unit of this capture"
    return Rows((None,) * len(places), _placed(places, pose, None, posed_camera, str(path)), "point", note=note)


def lamps(content: Any, path: Path) -> tuple[Pose, Float[np.ndarray, "rows 3"]]:
    """Return the camera's pose (OpenCV axes) and the lights' places in S3-NeRF's params.json.

    Raises:
        CalibrationError: a field is missing or impossible.
    """
    given = as_type(content, _Lamps, str(path), EXPORT)
    return rigid(np.array(given.pose_c2w) @ FROM_BLENDER, str(path), "pose_c2w"), np.array(given.light_pos)
