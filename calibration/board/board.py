"""The board: its pattern and the places of its corners in the world frame (mm)."""

from dataclasses import dataclass, replace
from typing import ClassVar

import cv2
import numpy as np
from jaxtyping import Float

from calibration.board.blank import BLANKS, Blank
from calibration.pose import Pose
from capture.errors import CalibrationError

EXAMPLES = (
    "charuco:5x7:30:22:DICT_4X4_50 (squares, square mm, marker mm, dictionary) "
    "or checkerboard:9x6:24.25 (inner corners, square mm); without a printer paper:A4, paper:letter or card"
)
BLANK_KINDS = ("paper", "card")
PAPER_THICKNESS = 0.1  # mm: office paper of 80 g/m2
LARGEST_SIDE = 100  # squares: more than any printer resolves in a photo, so a slip of the finger
WORLD_FROM_OPENCV_BOARD = Pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3))  # OpenCV's z points into the table


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

    def __post_init__(self):
        if self.kind not in ("charuco", "checkerboard"):
            raise ValueError(f"unknown kind of board {self.kind!r}")
        if min(self.columns, self.rows) < 2 or not self.square_mm > 0:
            raise ValueError("a board needs at least 2 x 2 and a positive square")
        if self.kind == "charuco" and not 0 < self.marker_mm < self.square_mm:
            raise ValueError("a ChArUco marker is smaller than its square")

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
