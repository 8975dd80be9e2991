"""Everything calibration found, in one value that can be saved and read back as JSON."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calibration.board import Board, parse_board
from calibration.camera import Camera
from calibration.checked_json import UNIT_ATOL, Field
from calibration.corners import Corners, Grey, find_board
from calibration.ground import fit_ground
from calibration.guess import guess_board
from calibration.lens import fit_camera
from calibration.light import Light, Vector
from calibration.pose import ROTATION_ATOL, Pose
from capture.atomic import read_json, write_json
from capture.errors import CalibrationError
from capture.photo import Photo, encode_srgb, read_photo
from capture.session import Session

FORMAT = 1
BRIGHT_SHARE = 99.5  # per cent of the values that may not exceed white when a dark photo is lifted
UNITS = ("mm", "scene")


@dataclass(frozen=True, eq=False)
class Calibration:
    """Camera, ground and lights in one world frame: right-handed, z up."""

    camera: Camera
    world_from_camera: Pose
    ground_height: float  # the ground is world z = ground_height
    lights: tuple[Light, ...]
    unit: str = "mm"  # "mm" | "scene"
    lobe: tuple[float, ...] = ()  # shared flashlight profile, see calibration.light.lobe_gain
    ambient: Vector = field(default_factory=lambda: np.zeros(3))  # irradiance of everything but the flashlight
    residuals: dict[str, Any] = field(default_factory=dict)  # named numbers for the report: reprojection_rms_px, ...

    def __eq__(self, other: object) -> bool:
        """Equal if they would be saved alike."""
        return isinstance(other, Calibration) and json.dumps(_document(self)) == json.dumps(_document(other))

    def looked_at(self) -> Vector:
        """Where the camera looks at the ground, world; as far away as the ground is below it where it does not."""
        eye, forward = self.world_from_camera.translation, self.world_from_camera.rotation[:, 2]
        drop = self.ground_height - eye[2]
        return eye + forward * (drop / forward[2] if forward[2] < 0 else -drop)

    __hash__ = None  # type: ignore[assignment]  # holds arrays


def save_calibration(calibration: Calibration, path: Path) -> None:
    """Writes the calibration as JSON, whole or not at all.

    Raises:
        CalibrationError: load_calibration would refuse it; names the field. Nothing is written.
    """
    document = _document(calibration)
    _calibration(Field(document, str(path)))
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
    return _calibration(Field(document, str(path)))


# --- the board -------------------------------------------------------------------------------------------------------


def calibrate_board(session: Session, board_spec: str | None = None) -> tuple[Camera, Pose, dict[str, Any]]:
    """The tripod's camera, its world_from_camera and the residuals, from the session's photos of the board.

    The first board photo is the tripod's and gives the ground; the others only help the lens. Photos of another pixel
    size than the tripod's are left out: whether they were cropped or turned cannot be told.

    Args:
        board_spec: as parse_board reads it; None: what session.toml says, or else the board is recognised.

    Raises:
        CalibrationError: no board in the tripod's photo, or its pose is ambiguous.
    """
    greys, focal = _read_board_photos(session)
    names = [path.name for path in session.board]
    board, notes = _named_board(list(greys), board_spec or session.settings.board, names)
    found: list[Corners | None] = []
    reasons = []
    for grey in greys:
        same = grey.shape == greys[0].shape
        may_be_part = bool(found) or not session.light  # where the origin is matters between two phones only
        found.append(find_board(grey, board, may_be_part) if same else None)
        reasons.append("" if found[-1] else "no board found" if same else "another pixel size than the tripod's photo")
    if found[0] is None:
        raise _no_board(names[0], board, greys)
    seen = [index for index, corners in enumerate(found) if corners is not None]
    size = (greys[0].shape[1], greys[0].shape[0])
    fit = fit_camera([corners for corners in found if corners is not None], size, focal)
    ground = fit_ground(found[0], fit.camera)
    photos: list[dict[str, Any]] = [
        {"photo": name, "used": False, "reason": reason} for name, reason in zip(names, reasons, strict=True)
    ]
    for index, rms, used in zip(seen, fit.photo_rms_px, fit.used, strict=True):
        photos[index] |= {"used": used, "rms_px": rms, "reason": "" if used else "does not fit the other photos"}
    residuals = {
        "board": found[0].board.spec(),
        "board_photos": photos,
        "reprojection_rms_px": fit.rms_px,
        "ground_rms_px": ground.rms_px,
        "focal_sigma_percent": 100 * fit.camera.sigmas["fx"] / fit.camera.fx,
        "ground_normal_sigma_deg": float(np.degrees(ground.normal_sigma_rad)),
        "camera_height_sigma_mm": ground.height_sigma_mm,
        "notes": [*notes, *_partly_seen(found[0]), *fit.notes],
    }
    return fit.camera, ground.world_from_camera, residuals


def _partly_seen(corners: Corners) -> list[str]:
    if corners.is_placed:
        return []
    return ["The tripod's photo shows part of the board only: ground and scale are right, the origin is some corner."]


def _read_board_photos(session: Session) -> tuple[list[Grey], float | None]:
    """Every board photo for the detector, and the tripod photo's focal length; one full photo in memory at a time."""
    if not session.board:
        raise CalibrationError(f"no photo of the board in {session.folder}, 1 needed. Put one into its folder board/.")
    greys, focal = [], None
    for index, path in enumerate(session.board):
        photo = read_photo(path)
        focal = photo.focal_35mm if index == 0 else focal
        greys.append(grey_of(photo))
    return greys, focal


def grey_of(photo: Photo) -> Grey:
    """The photo as the corner detectors want it: 8-bit, sRGB-encoded, a dark photo lifted to full range."""
    bright = float(np.percentile(photo.rgb[::8, ::8], BRIGHT_SHARE))
    lifted = photo.rgb / np.float32(min(max(bright, 1e-3), 1.0))
    return np.asarray(cv2.cvtColor(encode_srgb(lifted), cv2.COLOR_RGB2GRAY))


def _named_board(greys: list[Grey], spec: str | None, names: list[str]) -> tuple[Board, list[str]]:
    if spec is not None:
        return parse_board(spec), []
    guess = guess_board(greys)
    if guess is None:
        raise CalibrationError(
            f"no common board recognised in {len(greys)} photos ({', '.join(names[:3])}). Name it with --board, as "
            "checkerboard:9x6:24.25, and keep it whole, flat and in focus in the tripod's photo."
        )
    return guess.board, [guess.note]


def _no_board(name: str, board: Board, greys: list[Grey]) -> CalibrationError:
    guess = guess_board(greys[:1])
    hint = f" The photo rather shows {guess.board.spec()} (millimetres unknown)." if guess else ""
    return CalibrationError(
        f"board {board.spec()} not found in {name}, the tripod's photo.{hint} "
        "Check the board's description, and keep all of it in view, flat, in focus and evenly lit."
    )


# --- writing ---------------------------------------------------------------------------------------------------------


def _document(calibration: Calibration) -> dict[str, Any]:
    camera = calibration.camera
    return _plain(
        {
            "format": FORMAT,
            "units": calibration.unit,
            "camera": {
                **{name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy", "distortion")},
                "world_from_camera": calibration.world_from_camera.matrix(),
                "sigmas": camera.sigmas,
                "lens": "fisheye" if camera.fisheye else "pinhole",
            },
            "ground": {"normal": [0.0, 0.0, 1.0], "offset": float(calibration.ground_height)},
            "lights": [_light_document(light) for light in calibration.lights],
            "lobe": calibration.lobe,
            "ambient": calibration.ambient,
            "residuals": calibration.residuals,
        }
    )


def _light_document(light: Light) -> dict[str, Any]:
    place = "position" if light.kind == "point" else "direction"
    names = ("photo", "kind", place, "sigma", "power", "used", "reason", "axis")
    return {name: getattr(light, name) for name in names}


def _plain(value: Any) -> Any:
    """The value in JSON's own types."""
    if isinstance(value, dict):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


# --- reading ---------------------------------------------------------------------------------------------------------


def _calibration(document: Field) -> Calibration:
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
        lobe=tuple(document["lobe"].numbers()),
        ambient=document["ambient"].not_negative(),
        residuals=document["residuals"].any_numbers(),
    )


def _ground_height(ground: Field) -> float:
    if np.abs(ground["normal"].unit_vector() - [0, 0, 1]).max() > UNIT_ATOL:
        raise ground["normal"].refuse("[0, 0, 1] (the world's z is up) was")
    return ground["offset"].number()


def _pose(field: Field) -> Pose:
    rows = field.entries()
    if len(rows) != 4:
        raise field.refuse("4 rows of 4 numbers were")
    matrix = np.array([row.numbers(4) for row in rows])
    rotation = matrix[:3, :3]
    is_rotation = np.abs(rotation @ rotation.T - np.eye(3)).max() <= ROTATION_ATOL and np.linalg.det(rotation) > 0
    if not is_rotation or (matrix[3] != [0, 0, 0, 1]).any():
        raise field.refuse("a rotation and translation, last row 0 0 0 1, were")
    return Pose.from_matrix(matrix)


def _camera(field: Field) -> Camera:
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


def _light(field: Field, ground_height: float) -> Light:
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
