"""Declarations in session.toml: solids whose shadows locate the light, light, phone's back, height."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct

from capture.errors import CaptureError
from capture.files.schema import LARGEST_NUMBER, NotNegative, Number, Positive

MOST_LIGHTS = 4  # at once
PHONE_THICKNESS = 8.5  # mm: phones have 7 to 10
HEIGHT_SIGMA = 0.01  # share of a height measured with a ruler, unless its error is given
THICKEST_BOARD = 100.0  # mm: on a book
LEAST_HEIGHT_SIGMA = 0.5  # mm: a ruler's division, and where the highest point is

Length = Annotated[Positive, Meta(description="a length in millimetres")]
OnBoard = Annotated[tuple[Number, Number], Meta(description="x and y on the board in millimetres")]
_FROM_TABLE = f"millimetres from the table to the board's printed side, 0 to {THICKEST_BOARD:g}"
Thickness = Annotated[float, Meta(ge=0, le=THICKEST_BOARD, description=_FROM_TABLE)]
Pixel = Annotated[tuple[Number, Number], Meta(description="two numbers in pixels")]


@dataclass(frozen=True)
class Solid:
    """An upright peg or box on the ground; frame of the board (world), mm."""

    x: float  # centre of its base
    y: float
    height: float
    width: float  # diameter of a peg, side of a cube
    turn: float = 0.0  # of a box about the vertical, radians, from world x
    is_round: bool = True


class PhoneBack(Struct, frozen=True, forbid_unknown_fields=True):
    """Known facts about the photo of the flashlight phone's back; the program finds those that are None."""

    led_px: Pixel | None = None  # pixels of the photo as stored, x to the right and y down
    lens_px: Pixel | None = None
    thickness_mm: Annotated[NotNegative, Meta(description="a length in millimetres")] = PHONE_THICKNESS


@dataclass(frozen=True)
class Height:
    """The object's highest point above the table as measured by the user, and one sigma; mm."""

    mm: float
    sigma: float


def parse_height(value: Any, path: Path) -> Height:
    """Parse the entry `height` of session.toml: millimetres (120), or with one sigma ("120 +- 2").

    Raises:
        CaptureError: the value is neither, or not positive.
    """
    parts = value.replace("±", "+-").split("+-") if isinstance(value, str) else [value]
    try:
        numbers = [float(part) for part in parts] if not isinstance(value, bool) else []
    except (TypeError, ValueError):
        numbers = []
    if len(numbers) not in (1, 2) or not all(0 < number <= LARGEST_NUMBER for number in numbers):
        raise CaptureError(
            f'{path}: height is {value!r}, millimetres above the table (120), or with one sigma ("120 +- 2"), are '
            "needed. Measure the object's highest point with a ruler."
        )
    sigma = numbers[1] if len(numbers) == 2 else max(HEIGHT_SIGMA * numbers[0], LEAST_HEIGHT_SIGMA)
    return Height(numbers[0], sigma)


class Peg(Struct, frozen=True, forbid_unknown_fields=True):
    """One of [[pegs]] in session.toml."""

    at_mm: OnBoard
    height_mm: Length
    diameter_mm: Length

    def solid(self) -> Solid:
        """Return it as what casts a shadow."""
        return Solid(*self.at_mm, self.height_mm, self.diameter_mm)


class Cube(Struct, frozen=True, forbid_unknown_fields=True):
    """One of [[cubes]] in session.toml; at_mm is its middle."""

    at_mm: OnBoard
    side_mm: Length
    turn_deg: Annotated[Number, Meta(description="an angle in degrees")] = 0.0

    def solid(self) -> Solid:
        """Return it as what casts a shadow."""
        return Solid(*self.at_mm, self.side_mm, self.side_mm, float(np.radians(self.turn_deg)), is_round=False)
