"""Declarations in session.toml: solids whose shadows locate the light, light, phone's back, height."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from capture.errors import CaptureError

LIGHT_KINDS = ("flashlight", "sun")
MOST_LIGHTS = 4  # at once
PHONE_THICKNESS = 8.5  # mm: phones have 7 to 10
HEIGHT_SIGMA = 0.01  # share of a height measured with a ruler, unless its error is given
THICKEST_BOARD = 100.0  # mm: on a book
LEAST_HEIGHT_SIGMA = 0.5  # mm: a ruler's division, and where the highest point is


@dataclass(frozen=True)
class Solid:
    """An upright peg or box on the ground; frame of the board (world), mm."""

    x: float  # centre of its base
    y: float
    height: float
    width: float  # diameter of a peg, side of a cube
    turn: float = 0.0  # of a box about the vertical, radians, from world x
    is_round: bool = True


@dataclass(frozen=True)
class DeclaredObjects:
    """Solids and lights as the user declares them; defaults for entries that session.toml lacks."""

    solids: tuple[Solid, ...] = ()
    light_kind: str = "flashlight"  # "sun": from one direction, the same for the whole scene
    lights_at_once: int = 1


@dataclass(frozen=True)
class PhoneBack:
    """Known facts about the photo of the flashlight phone's back; the program finds those that are None."""

    led_px: tuple[float, float] | None = None  # pixels of the photo as stored, x to the right and y down
    lens_px: tuple[float, float] | None = None
    thickness_mm: float = PHONE_THICKNESS


@dataclass(frozen=True)
class Height:
    """The object's highest point above the table as measured by the user, and one sigma; mm."""

    mm: float
    sigma: float


def parse_height(value: Any, path: Path) -> Height | None:
    """Parse the entry `height` of session.toml: millimetres (120), or with one sigma ("120 +- 2").

    Raises:
        CaptureError: the value is neither, or not positive.
    """
    if value is None:
        return None
    parts = value.replace("±", "+-").split("+-") if isinstance(value, str) else [value]
    try:
        numbers = [float(part) for part in parts] if not isinstance(value, bool) else []
    except (TypeError, ValueError):
        numbers = []
    if len(numbers) not in (1, 2) or not all(0 < number < sys.float_info.max for number in numbers):
        raise CaptureError(
            f'{path}: height is {value!r}, millimetres above the table (120), or with one sigma ("120 +- 2"), are '
            "needed. Measure the object's highest point with a ruler."
        )
    sigma = numbers[1] if len(numbers) == 2 else max(HEIGHT_SIGMA * numbers[0], LEAST_HEIGHT_SIGMA)
    return Height(numbers[0], sigma)


def parse_thickness(value: Any, path: Path) -> float | None:
    """Parse the entry `board_thickness_mm` of session.toml: from the table to the board's printed side, mm.

    Raises:
        CaptureError: the value is no length from 0 to THICKEST_BOARD.
    """
    if value is not None and (not is_number(value) or not 0 <= value <= THICKEST_BOARD):
        raise CaptureError(
            f"{path}: board_thickness_mm is {value!r}, millimetres from the table to the board's printed side, 0 to "
            f"{THICKEST_BOARD:g}, are needed. Measure the board with what it is glued to; 0: the object stands on it."
        )
    return None if value is None else float(value)


def parse_phone_back(value: Any, path: Path) -> PhoneBack:
    """Parse the entry `phone_back` of session.toml: a table with led_px, lens_px and thickness_mm, all optional.

    Raises:
        CaptureError: the value is no such table, or an entry is unknown or has the wrong type.
    """
    if value is None:
        return PhoneBack()
    if not isinstance(value, dict) or not set(value) <= {"led_px", "lens_px", "thickness_mm"}:
        raise CaptureError(f"{path}: phone_back is {value!r}, a table of led_px, lens_px and thickness_mm is needed.")
    for key in ("led_px", "lens_px"):
        pixel = value.get(key, [0, 0])
        if not isinstance(pixel, list) or len(pixel) != 2 or not all(is_number(v) for v in pixel):
            raise CaptureError(f"{path}: {key} of phone_back is {pixel!r}, two numbers in pixels are needed.")
    thickness = value.get("thickness_mm", PHONE_THICKNESS)
    if not is_number(thickness) or thickness < 0:
        raise CaptureError(f"{path}: thickness_mm of phone_back is {thickness!r}, a length in millimetres is needed.")
    led, lens = ((float(value[k][0]), float(value[k][1])) if k in value else None for k in ("led_px", "lens_px"))
    return PhoneBack(led, lens, float(thickness))


def parse_declared(entries: dict[str, Any], path: Path) -> DeclaredObjects:
    """Parse the entries `pegs`, `cubes`, `light` and `lights_at_once` of session.toml.

    [[pegs]] at_mm = [x, y], height_mm, diameter_mm; [[cubes]] at_mm = [x, y] (middle), side_mm, turn_deg.

    Raises:
        CaptureError: an entry is missing, unknown or no positive number; the message names it.
    """
    pegs = [_solid(row, "pegs", ("height_mm", "diameter_mm"), path) for row in _rows(entries.get("pegs"), "pegs", path)]
    cubes = [_solid(row, "cubes", ("side_mm",), path) for row in _rows(entries.get("cubes"), "cubes", path)]
    kind = entries.get("light", LIGHT_KINDS[0])
    if kind not in LIGHT_KINDS:
        raise CaptureError(f"{path}: light is {kind!r}, one of {' or '.join(LIGHT_KINDS)} is needed.")
    count = entries.get("lights_at_once", 1)
    if type(count) is not int or not 1 <= count <= MOST_LIGHTS:
        raise CaptureError(f"{path}: lights_at_once is {count!r}, a whole number from 1 to {MOST_LIGHTS} is needed.")
    return DeclaredObjects((*pegs, *cubes), kind, count)


def _rows(value: Any, name: str, path: Path) -> list[dict[str, Any]]:
    if value is None:
        return []
    if not isinstance(value, list) or not all(isinstance(row, dict) for row in value):
        raise CaptureError(f"{path}: {name} is {value!r}, tables [[{name}]] are needed.")
    return value


def _solid(row: dict[str, Any], name: str, lengths: tuple[str, ...], path: Path) -> Solid:
    known = {"at_mm", "turn_deg", *lengths} if name == "cubes" else {"at_mm", *lengths}
    unknown = sorted(set(row) - known)
    if unknown:
        names = ", ".join(sorted(known))
        raise CaptureError(f"{path}: [[{name}]] has the unknown entry '{unknown[0]}'; {names} are known.")
    at = row.get("at_mm")
    if not isinstance(at, list) or len(at) != 2 or not all(is_number(v) for v in at):
        raise CaptureError(f"{path}: at_mm of [[{name}]] is {at!r}, x and y on the board in millimetres are needed.")
    for key in lengths:
        if not is_number(row.get(key)) or row[key] <= 0:
            raise CaptureError(f"{path}: {key} of [[{name}]] is {row.get(key)!r}, a length in millimetres is needed.")
    if not is_number(row.get("turn_deg", 0.0)):
        raise CaptureError(f"{path}: turn_deg of [[{name}]] is {row['turn_deg']!r}, an angle in degrees is needed.")
    x, y = float(at[0]), float(at[1])
    if name == "pegs":
        return Solid(x, y, float(row["height_mm"]), float(row["diameter_mm"]))
    side = float(row["side_mm"])
    return Solid(x, y, side, side, float(np.radians(row.get("turn_deg", 0.0))), is_round=False)


def is_number(value: Any) -> bool:
    """Return whether an entry of session.toml is a finite number; TOML has nan, inf and unlimited whole numbers."""
    return type(value) in (int, float) and abs(value) <= sys.float_info.max
