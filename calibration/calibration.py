"""The complete result of a calibration in one value that can be saved and read back as JSON."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from calibration.camera import Camera
from calibration.light import Light, Vector
from calibration.pose import ROTATION_ATOL, Pose
from calibration.posed_camera import PosedCamera
from calibration.side_view import LARGEST, SideView, from_run_lengths, run_lengths
from capture.decode.limits import PIXEL_CAP
from capture.files.atomic import write_json
from capture.files.json_field import UNIT_ATOL, JsonField, read_document
from capture.files.schema import check_numbers

FORMAT = 1
UNITS = ("mm", "scene")
MOST_LIGHTS = 5000  # far more than anybody photographs; the page draws each
MOST_SIDE_VIEWS = 64
MOST_BEAM_TERMS = 32
LARGEST_LENGTH = 1e12  # of the world: beyond, a float32 has lost the object
LARGEST_FOCAL = 1e6  # focal length over the picture's longer side: its rays are parallel to a millionth
SMALLEST_FOCAL = 1e-3
LARGEST_DISTORTION = 1e6


@dataclass(frozen=True, eq=False)
class Calibration:
    """Camera, ground and lights in one world frame: right-handed, z up."""

    camera: Camera
    world_from_camera: Pose
    ground_height: float  # the ground is world z = ground_height
    lights: tuple[Light, ...]
    unit: str = "mm"  # "mm" | "scene"
    beam: tuple[float, ...] = ()  # profile of the flashlight, see calibration.light.beam_gain; "lobe" in the file
    ambient: Vector = field(default_factory=lambda: np.zeros(3))  # irradiance of everything but the flashlight
    residuals: dict[str, Any] = field(default_factory=dict)  # named numbers for the report: reprojection_rms_px, ...
    side_views: tuple[SideView, ...] = ()  # handheld photos in room light, with the object's silhouette

    def __repr__(self) -> str:
        used = sum(light.used for light in self.lights)
        size = f"{self.camera.width} x {self.camera.height} px"
        return f"Calibration({size}, {used} of {len(self.lights)} lights used, unit {self.unit!r})"

    def __eq__(self, other: object) -> bool:
        """Return whether both would be saved alike."""
        return isinstance(other, Calibration) and json.dumps(calibration_document(self)) == json.dumps(
            calibration_document(other)
        )

    @staticmethod
    def of(posed_camera: PosedCamera, lights: Sequence[Light], **rest: Any) -> "Calibration":
        """Return a calibration with this camera and ground; `rest`: further fields by their names."""
        pose, ground = posed_camera.world_from_camera, posed_camera.ground_height
        return Calibration(posed_camera.camera, pose, ground, tuple(lights), **rest)

    def scaled(self, factor: float, unit: str) -> "Calibration":
        """Return the same scene in another unit, of which `factor` are one of this one's.

        Powers of point lights grow by its square, so that every irradiance stays: E = power / d^2.
        """
        pose = Pose(self.world_from_camera.rotation, factor * self.world_from_camera.translation)
        lights = tuple(
            light
            if light.position is None
            else replace(
                light, position=factor * light.position, sigma=factor * light.sigma, power=factor**2 * light.power
            )
            for light in self.lights
        )
        height = factor * self.ground_height
        return replace(self, world_from_camera=pose, ground_height=height, lights=lights, unit=unit)

    def moved(self, motion: Pose) -> "Calibration":
        """Return the calibration in a world that was turned about the vertical and shifted along the ground."""
        turn = motion.rotation
        lights = tuple(
            replace(
                light,
                position=None if light.position is None else motion.apply(light.position),
                direction=None if light.direction is None else motion.rotate(light.direction),
                axis=None if light.axis is None else motion.rotate(light.axis),
                sigma=np.sqrt(turn**2 @ light.sigma**2),
            )
            for light in self.lights
        )
        sides = tuple(
            replace(
                side,
                posed_camera=replace(side.posed_camera, world_from_camera=motion @ side.posed_camera.world_from_camera),
            )
            for side in self.side_views
        )
        both = np.kron(np.eye(2), turn)
        known = self.residuals.get("pose_covariance")
        more = {} if known is None else {"pose_covariance": (both @ np.array(known) @ both.T).tolist()}
        pose, residuals = motion @ self.world_from_camera, self.residuals | more
        return replace(self, world_from_camera=pose, lights=lights, side_views=sides, residuals=residuals)

    @property
    def posed_camera(self) -> PosedCamera:
        """The camera above its ground."""
        return PosedCamera(self.camera, self.world_from_camera, self.ground_height)

    __hash__ = None  # type: ignore[assignment]  # holds arrays


def save_calibration(calibration: Calibration, path: Path) -> None:
    """Write the calibration as JSON, whole or not at all.

    Raises:
        CalibrationError: load_calibration would refuse it; names the field. Nothing is written.
    """
    document = calibration_document(calibration)
    calibration_of(JsonField(document, str(path)))
    write_json(path, document)


def load_calibration(path: Path) -> Calibration:
    """The calibration in a JSON file written by save_calibration; of several views, the first one's.

    Raises:
        CalibrationError: no such file, or a field is missing, of the wrong kind, or impossible; names the field.
    """
    return calibration_of(read_document(path))


# --- writing ---------------------------------------------------------------------------------------------------------


def calibration_document(calibration: Calibration) -> dict[str, Any]:
    """Return the calibration as JSON's types."""
    document = _plain(
        {
            "format": FORMAT,
            "units": calibration.unit,
            "camera": _camera_document(calibration.posed_camera),
            "ground": {"normal": [0.0, 0.0, 1.0], "offset": float(calibration.ground_height)},
            "lights": [_light_document(light) for light in calibration.lights],
            "lobe": calibration.beam,
            "ambient": calibration.ambient,
            "residuals": calibration.residuals,
        }
    )
    sides = [_side_document(view) for view in calibration.side_views]
    return document | ({"side_views": _plain(sides)} if sides else {})


def _camera_document(posed_camera: PosedCamera) -> dict[str, Any]:
    camera = posed_camera.camera
    return {
        **{name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy", "distortion")},
        "world_from_camera": posed_camera.world_from_camera.matrix(),
        "sigmas": camera.sigmas,
        "lens": "fisheye" if camera.fisheye else "pinhole",
    }


def _side_document(view: SideView) -> dict[str, Any]:
    """Return a side view; masks as run lengths."""
    return {
        "photo": view.photo,
        "camera": _camera_document(view.posed_camera),
        "window": list(view.window),
        "size": list(view.mask.shape[::-1]),
        "object": run_lengths(view.mask),
        "sure": run_lengths(view.sure),
        "sigma_px": view.sigma_px,
    }


def _light_document(light: Light) -> dict[str, Any]:
    place = "position" if light.kind == "point" else "direction"
    names = ("photo", "kind", place, "sigma", "power", "used", "reason", "axis")
    return {name: getattr(light, name) for name in names}


def _plain(value: Any) -> Any:
    """Return the value in JSON's own types."""
    if isinstance(value, dict):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


# --- reading ---------------------------------------------------------------------------------------------------------


def calibration_of(document: JsonField) -> Calibration:
    """Return the calibration that a JSON object describes.

    Raises:
        CalibrationError: a field is missing, of the wrong kind, or impossible; names the field.
    """
    version = document["format"]
    if version.value != FORMAT:
        raise version.refuse(f"{FORMAT} was")
    height = _ground_height(document["ground"])
    pose = document["camera"]["world_from_camera"]
    world_from_camera = _pose(pose)
    if world_from_camera.translation[2] <= height:
        raise pose.refuse("a camera above the ground was")
    return Calibration(
        camera=camera_of(document["camera"], _is_fisheye(document["camera"])),
        world_from_camera=world_from_camera,
        ground_height=height,
        lights=tuple(_light(light, height) for light in document["lights"].entries(MOST_LIGHTS)),
        unit=document["units"].text(*UNITS),
        beam=tuple(term.number() for term in document["lobe"].entries(MOST_BEAM_TERMS)),
        ambient=document["ambient"].not_negative(),
        residuals=_residuals(document["residuals"]),
        side_views=_side_views(document, height),
    )


def _side_views(document: JsonField, ground_height: float) -> tuple[SideView, ...]:
    return tuple(_side_view(one, ground_height) for one in document.get("side_views", []).entries(MOST_SIDE_VIEWS))


def _side_view(one: JsonField, ground_height: float) -> SideView:
    pose = _pose(one["camera"]["world_from_camera"])
    size = one["size"].entries(2)
    if len(size) != 2:
        raise one["size"].refuse("width and height were")
    width, height = (entry.count(most=LARGEST) for entry in size)
    masks = []
    for name in ("object", "sure"):
        runs = [run.count(0, LARGEST**2) for run in one[name].entries(LARGEST**2)]
        try:
            masks.append(from_run_lengths(runs, (height, width)))
        except ValueError as error:
            raise one[name].refuse(f"{error} were") from None
    if len(one["window"].entries(4)) != 4:
        raise one["window"].refuse("left, top, width and height were")
    left, top, wide, high = (number.count(0, PIXEL_CAP) for number in one["window"].entries(4))
    camera = PosedCamera(camera_of(one["camera"], _is_fisheye(one["camera"])), pose, ground_height)
    if not (0 <= left < left + wide <= camera.camera.width and 0 <= top < top + high <= camera.camera.height):
        raise one["window"].refuse("left, top, width and height inside the photo were")
    sigma = one["sigma_px"].number(above=0.0)
    return SideView(one["photo"].file_name(), camera, (left, top, wide, high), masks[0], masks[1], sigma)


def _residuals(field: JsonField) -> dict[str, Any]:
    """Return the residuals after a check of those that are read as lists, tables or numbers."""
    field.items()
    check_numbers(field.value, field.file, field.advice, field.name)
    for name in ("notes", "warnings"):
        for line in field.get(name, []).entries():
            line.text()
    for value in field.get("shading_rms_by_photo", {}).items().values():
        value.number()
    for name in ("camera_height_sigma_mm", "given_lights_misfit"):
        field.get(name, 0.0).number()
    for row in field.get("board_photos", []).entries():
        row["photo"].file_name()
        row["used"].flag()
        row.get("reason", "").text()
    for row in field.get("left_out_photos", []).entries():
        row["photo"].file_name()
        for name in ("role", "reason"):
            row[name].text()
    return field.value


def _ground_height(ground: JsonField) -> float:
    if np.abs(ground["normal"].unit_vector() - [0, 0, 1]).max() > UNIT_ATOL:
        raise ground["normal"].refuse("[0, 0, 1] (the world's z is up) was")
    return ground["offset"].number(most=LARGEST_LENGTH)


def _pose(field: JsonField) -> Pose:
    rows = field.entries(4)
    if len(rows) != 4:
        raise field.refuse("4 rows of 4 numbers were")
    matrix = np.array([row.numbers(4) for row in rows])
    if not is_rigid(matrix):
        raise field.refuse("a rotation and translation, last row 0 0 0 1, were")
    return Pose.from_matrix(matrix)


def is_rigid(matrix: Float[np.ndarray, "4 4"]) -> bool:
    """Return whether a matrix is a rotation and a translation of a length that a world has; last row 0 0 0 1."""
    if not np.isfinite(matrix).all() or np.abs(matrix).max() > LARGEST_LENGTH or (matrix[3] != [0, 0, 0, 1]).any():
        return False
    rotation = matrix[:3, :3]
    return bool(np.abs(rotation @ rotation.T - np.eye(3)).max() <= ROTATION_ATOL and np.linalg.det(rotation) > 0)


def camera_of(field: JsonField, is_fisheye: bool) -> Camera:
    """Return the camera that a JSON object describes by the names of Camera's fields.

    Raises:
        CalibrationError: a number is missing, or is none that a camera has; names it.
    """
    width, height = field["width"].count(), field["height"].count()
    if width * height > PIXEL_CAP:
        raise field["width"].refuse(f"at most {PIXEL_CAP // 1_000_000} megapixels of {height} rows were")
    longer = max(width, height)
    fx, fy = (_focal(field[name], longer) for name in ("fx", "fy"))
    cx, cy = (field[name].number(most=LARGEST_FOCAL * longer) for name in ("cx", "cy"))
    k1, k2, p1, p2, k3 = (entry.number(most=LARGEST_DISTORTION) for entry in _five(field["distortion"]))
    sigmas = {name: entry.number() for name, entry in field["sigmas"].items().items()}
    for name, value in sigmas.items():
        if value < 0:
            raise field["sigmas"][name].refuse(f"a number from 0, not {value}, was")
    return Camera(width, height, fx, fy, cx, cy, (k1, k2, p1, p2, k3), sigmas, is_fisheye)


def _focal(field: JsonField, longer: int) -> float:
    value = field.number(above=0.0)
    if not SMALLEST_FOCAL * longer <= value <= LARGEST_FOCAL * longer:
        raise field.refuse(f"{SMALLEST_FOCAL:g} to {LARGEST_FOCAL:g} times the {longer} pixels of the picture were")
    return value


def _five(field: JsonField) -> list[JsonField]:
    entries = field.entries(5)
    if len(entries) != 5:
        raise field.refuse("a list of 5 numbers was")
    return entries


def _is_fisheye(camera: JsonField) -> bool:
    return "lens" in camera.value and camera["lens"].text("pinhole", "fisheye") == "fisheye"


def _light(field: JsonField, ground_height: float) -> Light:
    kind = field["kind"].text("point", "directional")
    if type(field["used"].value) is not bool:
        raise field["used"].refuse("true or false was")
    place = field["position"] if kind == "point" else field["direction"]
    vector = place.vector() if kind == "point" else place.unit_vector()
    if np.abs(vector).max() > LARGEST_LENGTH:
        raise place.refuse(f"a place within {LARGEST_LENGTH:g} of the origin was")
    lowest = ground_height if kind == "point" else 0.0
    if field["used"].value and vector[2] <= lowest:
        raise place.refuse("a light above the ground was")
    axis = field["axis"]
    return Light(
        photo=field["photo"].file_name(),
        kind=kind,
        position=vector if kind == "point" else None,
        direction=vector if kind == "directional" else None,
        power=field["power"].not_negative(),
        axis=None if axis.value is None else axis.unit_vector(),
        sigma=field["sigma"].not_negative(),
        used=field["used"].value,
        reason=field["reason"].text(),
    )
