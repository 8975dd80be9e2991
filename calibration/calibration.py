"""The complete result of a calibration in one value that can be saved and read back as JSON."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Bool, Float
from msgspec import Meta, Struct, structs

from calibration.camera import Camera
from calibration.light import Light
from calibration.pose import ROTATION_ATOL, Pose
from calibration.posed_camera import PosedCamera
from calibration.side_view import LARGEST, SideView, from_run_lengths, run_lengths
from capture.decode.limits import PIXEL_CAP
from capture.files.atomic import write_json
from capture.files.schema import (
    FileName,
    Matrix,
    Number,
    Positive,
    Power,
    Text,
    Vector,
    as_type,
    check_numbers,
    read_as,
    refused,
)

FORMAT = 1
UNIT_ATOL = 1e-6  # of a direction's length: directions are computed in float64 and written in full
PLACES = {"point": "position", "directional": "direction"}
MOST_LIGHTS = 5000  # far more than anybody photographs; the page draws each
MOST_SIDE_VIEWS = 64
MOST_BEAM_TERMS = 32
LARGEST_LENGTH = 1e12  # of the world: beyond, a float32 has lost the object


@dataclass(frozen=True, eq=False)
class Calibration:
    """Camera, ground and lights in one world frame: right-handed, z up."""

    camera: Camera
    world_from_camera: Pose
    ground_height: float  # the ground is world z = ground_height
    lights: tuple[Light, ...]
    unit: str = "mm"  # "mm" | "scene"
    beam: tuple[float, ...] = ()  # profile of the flashlight, see calibration.light.beam_gain; "lobe" in the file
    ambient: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))  # irradiance of all but the flashlight
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
    check_numbers(document, str(path))
    as_type(document, CalibrationFile, str(path))
    write_json(path, document)


def load_calibration(path: Path) -> Calibration:
    """The calibration in a JSON file written by save_calibration; of several views, the first one's.

    Raises:
        CalibrationError: no such file, or a field is missing, of the wrong kind, or impossible; names the field.
    """
    found, document = read_as(path, CalibrationFile)
    return found.calibration(document)


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
    names = ("photo", "kind", PLACES[light.kind], "sigma", "power", "used", "reason", "axis")
    return {name: getattr(light, name) for name in names}


def _plain(value: Any) -> Any:
    """Return the value in JSON's own types."""
    if isinstance(value, dict):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


# --- reading ---------------------------------------------------------------------------------------------------------

Length = Annotated[float, Meta(ge=-LARGEST_LENGTH, le=LARGEST_LENGTH)]
Place = Annotated[tuple[Length, Length, Length], Meta(description=f"a place within {LARGEST_LENGTH:g} of the origin")]
Pixel = Annotated[int, Meta(ge=0, le=PIXEL_CAP)]
Side = Annotated[int, Meta(ge=1, le=LARGEST)]
Runs = Annotated[list[Annotated[int, Meta(ge=0, le=LARGEST**2)]], Meta(max_length=LARGEST**2)]


@dataclass(frozen=True, kw_only=True)
class _PosedCamera(Camera):
    world_from_camera: Matrix
    lens: Literal["pinhole", "fisheye"] = "pinhole"

    def __post_init__(self) -> None:
        Camera.__post_init__(self)
        if not is_rigid(np.array(self.world_from_camera)):
            needed = "a rotation and translation, last row 0 0 0 1"
            raise refused("world_from_camera", self.world_from_camera, needed)

    def posed(self, ground_height: float) -> PosedCamera:
        """Return the camera above its ground."""
        own = {one.name: getattr(self, one.name) for one in fields(Camera)}
        camera = Camera(**own | {"fisheye": self.lens == "fisheye"})
        return PosedCamera(camera, Pose.from_matrix(np.array(self.world_from_camera)), ground_height)


class _Ground(Struct):
    normal: Vector
    offset: Length

    def __post_init__(self) -> None:
        if np.abs(np.subtract(self.normal, (0, 0, 1))).max() > UNIT_ATOL:
            raise refused("normal", self.normal, "[0, 0, 1] (the world's z is up)")


class _Light(Struct):
    photo: FileName
    kind: Literal["point", "directional"]
    sigma: Power
    power: Power
    used: bool
    reason: Text
    axis: Vector | None
    position: Place | None = None
    direction: Vector | None = None

    def __post_init__(self) -> None:
        if self.place() is None:
            raise ValueError(f".{PLACES[self.kind]} is missing")
        for name in ("axis",) if self.kind == "point" else ("axis", "direction"):
            vector = getattr(self, name)
            if vector is not None and abs(np.linalg.norm(vector) - 1) > UNIT_ATOL:
                raise refused(name, vector, "a direction of length 1")

    def place(self) -> Any:
        """Return its position or direction."""
        return getattr(self, PLACES[self.kind])

    def light(self) -> Light:
        """Return the light."""
        given = structs.asdict(self) | {"position": None, "direction": None, PLACES[self.kind]: self.place()}
        return Light(**{name: np.array(one, float) if isinstance(one, tuple) else one for name, one in given.items()})


class _SideView(Struct):
    photo: FileName
    camera: _PosedCamera
    window: Annotated[tuple[Pixel, Pixel, Pixel, Pixel], Meta(description="left, top, width and height")]
    size: Annotated[tuple[Side, Side], Meta(description="width and height")]
    object: Runs
    sure: Runs
    sigma_px: Positive

    def __post_init__(self) -> None:
        left, top, wide, high = self.window
        if not (0 < wide <= self.camera.width - left and 0 < high <= self.camera.height - top):
            raise refused("window", self.window, "left, top, width and height inside the photo")
        for name in ("object", "sure"):
            try:
                self.mask(name)
            except ValueError as error:
                raise refused(name, getattr(self, name), str(error)) from None

    def mask(self, name: str) -> Bool[np.ndarray, "height width"]:
        """Return one of its masks."""
        return from_run_lengths(getattr(self, name), self.size[::-1])

    def view(self, ground_height: float) -> SideView:
        """Return the view."""
        posed = self.camera.posed(ground_height)
        return SideView(self.photo, posed, self.window, self.mask("object"), self.mask("sure"), self.sigma_px)


class _BoardPhoto(Struct):
    photo: FileName
    used: bool
    reason: Text | None = None


class _LeftOutPhoto(Struct):
    photo: FileName
    role: Text
    reason: Text


class _Residuals(Struct):  # what is read as lists, tables or numbers; the rest is kept as it is
    notes: list[Text] | None = None
    warnings: list[Text] | None = None
    shading_rms_by_photo: dict[Text, Number] | None = None
    camera_height_sigma_mm: Number | None = None
    given_lights_misfit: Number | None = None
    board_photos: list[_BoardPhoto] | None = None
    left_out_photos: list[_LeftOutPhoto] | None = None


class CalibrationFile(Struct):
    """The content of calibration.json, of one view."""

    format: Literal[1]
    units: Literal["mm", "scene"]
    camera: _PosedCamera
    ground: _Ground
    lights: Annotated[list[_Light], Meta(max_length=MOST_LIGHTS)]
    lobe: Annotated[tuple[Number, ...], Meta(max_length=MOST_BEAM_TERMS)]
    ambient: Power
    residuals: _Residuals
    side_views: Annotated[tuple[_SideView, ...], Meta(max_length=MOST_SIDE_VIEWS)] = ()

    def __post_init__(self) -> None:
        if self.camera.world_from_camera[2][3] <= self.ground.offset:
            raise refused("camera.world_from_camera", self.camera.world_from_camera, "a camera above the ground")
        for k, light in enumerate(self.lights):
            if light.used and light.place()[2] <= (self.ground.offset if light.kind == "point" else 0.0):
                raise refused(f"lights[{k}].{PLACES[light.kind]}", light.place(), "a light above the ground")

    def calibration(self, document: Mapping[str, Any]) -> Calibration:
        """Return the calibration; `document` is the same content in JSON's types, whose residuals are kept whole."""
        return Calibration.of(
            self.camera.posed(self.ground.offset),
            [light.light() for light in self.lights],
            unit=self.units,
            beam=self.lobe,
            ambient=np.array(self.ambient),
            residuals=document["residuals"],
            side_views=tuple(view.view(self.ground.offset) for view in self.side_views),
        )


def is_rigid(matrix: Float[np.ndarray, "4 4"]) -> bool:
    """Return whether a matrix is a rotation and a translation of a length that a world has; last row 0 0 0 1."""
    if not np.isfinite(matrix).all() or np.abs(matrix).max() > LARGEST_LENGTH or (matrix[3] != [0, 0, 0, 1]).any():
        return False
    rotation = matrix[:3, :3]
    return bool(np.abs(rotation @ rotation.T - np.eye(3)).max() <= ROTATION_ATOL and np.linalg.det(rotation) > 0)
