"""The board: its pattern and the places of its corners in the world frame (mm).

A blank sheet of paper or a bank card instead of a printed board: its size, and the points of its edges.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import cv2
import numpy as np
from jaxtyping import Float, Int

from calibration.pose import Pose
from capture.errors import CalibrationError

LONG_POINTS, SHORT_POINTS = 12, 8  # per side: far enough apart that neighbours share little of their errors
CLEAR_OF_CORNER = 0.05  # of a side: creases and rounding
CLEAR_OF_ROUNDING = 1.3  # radii
EXAMPLES = (
    "charuco:5x7:30:22:DICT_4X4_50 (squares, square mm, marker mm, dictionary) "
    "or checkerboard:9x6:24.25 (inner corners, square mm); without a printer paper:A4, paper:letter or card"
)
BLANK_KINDS = ("paper", "card")
PAPER_THICKNESS = 0.1  # mm: office paper of 80 g/m2
LARGEST_SIDE = 100  # squares: more than any printer resolves in a photo, so a slip of the finger
WORLD_FROM_OPENCV_BOARD = Pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3))  # OpenCV's z points into the table


@dataclass(frozen=True)
class Blank:
    """A rectangle without print. World frame: origin at one corner, x along a long side, y from it to the outside.

    Nothing tells its two ends apart: after half a turn it looks the same.
    """

    name: str  # as parse_board reads it
    long_mm: float
    short_mm: float
    radius_mm: float  # of its rounded corners
    sigma_mm: float  # one sigma of each side: how well such sheets are cut
    curl_mm: float  # one sigma of how far its edges lie above the table
    thickness_mm: float  # from the table to its upper side; 0: the object stands on it

    def spec(self) -> str:
        """The board as the text that parse_board reads."""
        return self.name

    def turns_alike(self) -> int:
        """Return the number of quarter turns after which it looks the same."""
        return 2

    def ratio(self) -> float:
        """Long over short side."""
        return self.long_mm / self.short_mm

    def corners(self) -> Float[np.ndarray, "4 2"]:
        """Return the corners of its sides, not rounded, x and y of the world: clockwise as one looks down on it."""
        w, h = self.long_mm, self.short_mm
        return np.array([[0.0, 0.0], [w, 0.0], [w, -h], [0.0, -h]])

    def points(self) -> Float[np.ndarray, "points 3"]:
        """Return points on its edges, world, mm: side by side, in the order of the corners."""
        return np.concatenate([part for part, _ in self._sides()])

    def outward(self) -> Float[np.ndarray, "points 2"]:
        """Return the direction away from the sheet at each of the points, x and y of the world."""
        return np.concatenate([np.broadcast_to(away, (len(part), 2)) for part, away in self._sides()])

    def side_of_points(self) -> Int[np.ndarray, " points"]:
        """Return on which side each of the points lies, 0 to 3."""
        return np.repeat(np.arange(4), [len(part) for part, _ in self._sides()])

    def spacing(self) -> float:
        """Return the smallest distance of two neighbouring points on one side, mm."""
        return min(float(np.linalg.norm(part[1] - part[0])) for part, _ in self._sides())

    def _sides(self) -> list[tuple[Float[np.ndarray, "side 3"], Float[np.ndarray, "2"]]]:
        """Points on each side, and the direction out of the sheet there."""
        sides = []
        for k, start in enumerate(corners := self.corners()):
            along = corners[(k + 1) % 4] - start
            length = float(np.linalg.norm(along))
            clear = max(CLEAR_OF_CORNER, CLEAR_OF_ROUNDING * self.radius_mm / length)
            share = np.linspace(clear, 1 - clear, LONG_POINTS if k % 2 == 0 else SHORT_POINTS)
            flat = start + share[:, None] * along
            sides.append((np.column_stack([flat, np.zeros(len(flat))]), np.array([-along[1], along[0]]) / length))
        return sides


# ISO 216 admits 2 mm on the sides of A4, but machines cut within half a millimetre; ISO/IEC 7810 gives a card 0.13,
# and a thickness of 0.76.
BLANKS = {
    "paper:a4": Blank("paper:A4", 297.0, 210.0, 0.0, 0.4, 0.4, 0.0),
    "paper:letter": Blank("paper:letter", 279.4, 215.9, 0.0, 0.4, 0.4, 0.0),
    "card": Blank("card", 85.60, 53.98, 3.18, 0.06, 0.2, 0.76),
}


@dataclass(frozen=True)
class Board:
    """A board. ChArUco counts squares, a checkerboard counts inner corners, both columns x rows; lengths in mm."""

    kind: str  # "charuco" | "checkerboard"
    columns: int
    rows: int
    square_mm: float
    marker_mm: float = 0.0  # ChArUco only
    dictionary: str = ""  # ChArUco only, OpenCV's name
    thickness_mm: ClassVar[float] = PAPER_THICKNESS  # from the table to its printed side, unless session.toml says it

    def spec(self) -> str:
        """The board as the text that parse_board reads."""
        text = f"{self.kind}:{self.columns}x{self.rows}:{_number(self.square_mm)}"
        return f"{text}:{_number(self.marker_mm)}:{self.dictionary}" if self.kind == "charuco" else text

    def transposed(self) -> "Board":
        """Return the board with columns and rows exchanged: users may write 7x5 for a 5x7 board."""
        return replace(self, columns=self.rows, rows=self.columns)

    def corner_counts(self) -> tuple[int, int]:
        """Columns and rows of the corners that are measured: the inner ones."""
        less = 1 if self.kind == "charuco" else 0
        return self.columns - less, self.rows - less

    def turns_alike(self) -> int:
        """Return the number of quarter turns after which the print looks the same.

        4 in general; 2 if both ends of a checkerboard are alike; 1 if all four corners of a square one are alike.
        """
        if self.kind == "charuco" or (self.columns + self.rows) % 2 == 1:
            return 4
        return 1 if self.columns == self.rows and self.columns % 2 == 0 else 2

    def points(self) -> Float[np.ndarray, "corners 3"]:
        """Return every inner corner in the world frame, row by row, mm: right-handed, z up out of the printed side.

        World = diag(1, -1, -1) times OpenCV's board frame, same origin: the outer corner of the first square
        (ChArUco) or the first inner corner (checkerboard).
        """
        columns, rows = self.corner_counts()
        first = 1 if self.kind == "charuco" else 0
        u, v = np.meshgrid(np.arange(columns) + first, np.arange(rows) + first)
        board = np.stack([u.ravel(), v.ravel(), np.zeros(u.size)], -1) * self.square_mm
        return WORLD_FROM_OPENCV_BOARD.apply(board)

    def opencv(self, is_legacy: bool = False) -> cv2.aruco.CharucoBoard:
        """OpenCV's object of a ChArUco board; legacy: the pattern before OpenCV 4.6, which differs for even rows."""
        assert self.kind == "charuco"
        size, dictionary = (self.columns, self.rows), opencv_dictionary(self.dictionary)
        board = cv2.aruco.CharucoBoard(size, self.square_mm, self.marker_mm, dictionary)
        board.setLegacyPattern(is_legacy)
        return board


AnyBoard = Board | Blank


def opencv_dictionary(name: str) -> cv2.aruco.Dictionary:
    """OpenCV's predefined marker dictionary of this name, such as DICT_4X4_50."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def parse_board(spec: str) -> AnyBoard:
    """Parse a board from text such as charuco:5x7:30:22:DICT_4X4_50, checkerboard:9x6:24.25, paper:A4 or card.

    Raises:
        CalibrationError: names the part that cannot be understood.
    """
    kind, *parts = spec.strip().split(":")
    if kind.lower() in BLANK_KINDS:
        return _blank(spec)
    expected = {"charuco": 4, "checkerboard": 2}.get(kind)
    if expected is None:
        raise _bad(spec, f"{kind!r} is no kind of board")
    if len(parts) != expected:
        raise _bad(spec, f"{kind} has {expected} parts after its name, here are {len(parts)}")
    columns, rows = _size(spec, parts[0], smallest=2 if kind == "checkerboard" else 3)
    square = _length(spec, parts[1], "square")
    if kind == "checkerboard":
        return Board(kind, columns, rows, square)
    marker = _length(spec, parts[2], "marker")
    if marker >= square:
        raise _bad(spec, f"the marker ({_number(marker)} mm) must be smaller than the square ({_number(square)} mm)")
    dictionary = parts[3].strip().upper()
    if not dictionary.startswith("DICT_") or not hasattr(cv2.aruco, dictionary):
        raise _bad(spec, f"{parts[3]!r} is no dictionary of OpenCV")
    needed, held = columns * rows // 2, len(opencv_dictionary(dictionary).bytesList)
    if needed > held:
        raise _bad(spec, f"{columns}x{rows} squares need {needed} markers, {dictionary} has {held}")
    return Board(kind, columns, rows, square, marker, dictionary)


def parse_print(spec: str) -> Board:
    """Parse a board that is printed.

    Raises:
        CalibrationError: as parse_board, and for a blank sheet or a card.
    """
    board = parse_board(spec)
    if isinstance(board, Blank):
        raise _bad(spec, "a blank sheet or card has nothing to print; lay it on the table as it is")
    return board


def _blank(spec: str) -> Blank:
    found = BLANKS.get(spec.strip().lower())
    if found is None:
        known = ", ".join(blank.name for blank in BLANKS.values())
        raise _bad(spec, f"no such blank sheet is known ({known} are)")
    return found


def _bad(spec: str, why: str) -> CalibrationError:
    return CalibrationError(f"board {spec!r}: {why}. Write {EXAMPLES}.")


def _size(spec: str, text: str, smallest: int) -> tuple[int, int]:
    sides = text.lower().split("x")
    if len(sides) != 2 or not all(side.strip().isdecimal() for side in sides):
        raise _bad(spec, f"{text!r} is no size such as 9x6")
    columns, rows = int(sides[0]), int(sides[1])
    if min(columns, rows) < smallest or max(columns, rows) > LARGEST_SIDE:
        raise _bad(spec, f"the size {text} is outside {smallest} to {LARGEST_SIDE} on a side")
    return columns, rows


def _length(spec: str, text: str, what: str) -> float:
    try:
        length = float(text)
    except ValueError:
        raise _bad(spec, f"the {what} {text!r} is no length in mm") from None
    if not (np.isfinite(length) and length > 0):
        raise _bad(spec, f"the {what} must be a positive length in mm, not {text}")
    return length


def _number(value: float) -> str:
    return repr(int(value)) if value == int(value) else repr(value)
