"""The complete result of a calibration in one value that can be saved and read back as JSON."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from calibration.camera import Camera
from calibration.light import Light, Vector
from calibration.pose import ROTATION_ATOL, Pose
from calibration.posed_camera import PosedCamera
from calibration.side_view import SideView, from_run_lengths, run_lengths
from capture.errors import CalibrationError
from capture.files.atomic import read_json, write_json
from capture.files.json_field import UNIT_ATOL, JsonField

FORMAT = 1
UNITS = ("mm", "scene")


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
        return isinstance(other, Calibration) and json.dumps(_document(self)) == json.dumps(_document(other))

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
    document = _document(calibration)
    _calibration(JsonField(document, str(path)))
    write_json(path, document)


def load_calibration(path: Path) -> Calibration:
    """The calibration in a JSON file written by save_calibration.

    Raises:
        CalibrationError: no such file, or a field is missing, of the wrong kind, or impossible; names the field.
    """
    try:
        document = read_json(path)
    except (OSError, ValueError) as error:
        raise CalibrationError(f"{path} cannot be read as JSON ({error}). Calibrate again.") from error
    return _calibration(JsonField(document, str(path)))


# --- writing ---------------------------------------------------------------------------------------------------------


def _document(calibration: Calibration) -> dict[str, Any]:
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


def _calibration(document: JsonField) -> Calibration:
    version = document["format"]
    if version.value != FORMAT:
        raise version.refuse(f"{FORMAT} was")
    height = _ground_height(document["ground"])
    pose = document["camera"]["world_from_camera"]
    world_from_camera = _pose(pose)
    if world_from_camera.translation[2] <= height:
        raise pose.refuse("a camera above the ground was")
    return Calibration(
        camera=_camera(document["camera"]),
        world_from_camera=world_from_camera,
        ground_height=height,
        lights=tuple(_light(light, height) for light in document["lights"].entries()),
        unit=document["units"].text(*UNITS),
        beam=tuple(document["lobe"].numbers()),
        ambient=document["ambient"].not_negative(),
        residuals=document["residuals"].any_numbers(),
        side_views=_side_views(document, height),
    )


def _side_views(document: JsonField, ground_height: float) -> tuple[SideView, ...]:
    if "side_views" not in document.value:
        return ()
    return tuple(_side_view(one, ground_height) for one in document["side_views"].entries())


def _side_view(one: JsonField, ground_height: float) -> SideView:
    pose = _pose(one["camera"]["world_from_camera"])
    width, height = (entry.count() for entry in one["size"].entries()[:2])
    masks = []
    for name in ("object", "sure"):
        runs = [int(number) for number in one[name].numbers()]
        try:
            masks.append(from_run_lengths(runs, (height, width)))
        except ValueError as error:
            raise one[name].refuse(f"{error} were") from None
    left, top, wide, high = (int(number) for number in one["window"].numbers(4))
    camera = PosedCamera(_camera(one["camera"]), pose, ground_height)
    if not (0 <= left < left + wide <= camera.camera.width and 0 <= top < top + high <= camera.camera.height):
        raise one["window"].refuse("left, top, width and height inside the photo were")
    sigma = one["sigma_px"].number(above=0.0)
    return SideView(one["photo"].text(), camera, (left, top, wide, high), masks[0], masks[1], sigma)


def _ground_height(ground: JsonField) -> float:
    if np.abs(ground["normal"].unit_vector() - [0, 0, 1]).max() > UNIT_ATOL:
        raise ground["normal"].refuse("[0, 0, 1] (the world's z is up) was")
    return ground["offset"].number()


def _pose(field: JsonField) -> Pose:
    rows = field.entries()
    if len(rows) != 4:
        raise field.refuse("4 rows of 4 numbers were")
    matrix = np.array([row.numbers(4) for row in rows])
    rotation = matrix[:3, :3]
    is_rotation = np.abs(rotation @ rotation.T - np.eye(3)).max() <= ROTATION_ATOL and np.linalg.det(rotation) > 0
    if not is_rotation or (matrix[3] != [0, 0, 0, 1]).any():
        raise field.refuse("a rotation and translation, last row 0 0 0 1, were")
    return Pose.from_matrix(matrix)


def _camera(field: JsonField) -> Camera:
    k1, k2, p1, p2, k3 = field["distortion"].numbers(5)
    sigmas = field["sigmas"]
    if not isinstance(sigmas.value, dict):
        raise sigmas.refuse("an object was")
    for name, value in sigmas.value.items():
        if sigmas[name].number() < 0:
            raise sigmas[name].refuse(f"a number from 0, not {value}, was")
    return Camera(
        field["width"].count(),
        field["height"].count(),
        field["fx"].number(above=0.0),
        field["fy"].number(above=0.0),
        field["cx"].number(),
        field["cy"].number(),
        (k1, k2, p1, p2, k3),
        {name: float(value) for name, value in sigmas.value.items()},
        "lens" in field.value and field["lens"].text("pinhole", "fisheye") == "fisheye",
    )


def _light(field: JsonField, ground_height: float) -> Light:
    kind = field["kind"].text("point", "directional")
    if type(field["used"].value) is not bool:
        raise field["used"].refuse("true or false was")
    place = field["position"] if kind == "point" else field["direction"]
    vector = place.vector() if kind == "point" else place.unit_vector()
    lowest = ground_height if kind == "point" else 0.0
    if field["used"].value and vector[2] <= lowest:
        raise place.refuse("a light above the ground was")
    axis = field["axis"]
    return Light(
        photo=field["photo"].text(),
        kind=kind,
        position=vector if kind == "point" else None,
        direction=vector if kind == "directional" else None,
        power=field["power"].not_negative(),
        axis=None if axis.value is None else axis.unit_vector(),
        sigma=field["sigma"].not_negative(),
        used=field["used"].value,
        reason=field["reason"].text(),
    )
