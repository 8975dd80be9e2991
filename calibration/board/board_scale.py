"""What every length of a capture rests on: the size of its board, who said it, and whether the photo contradicts it.

No picture tells a small board near by from a large one far away. But a lens is not sharp at any distance, a file may
say at which one it was focused, and boards are neither as small as a stamp nor larger than paper.
"""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from calibration.board.board import AnyBoard, Blank, Board
from calibration.board.corners import Corners, Grey, read_markers
from calibration.board.printing import DEFAULT_BOARDS
from capture.decode.exif import Optics

STAMP_MM = 40.0  # longer side of a large stamp; a bank card, the smallest board that is offered, has 85.6
LARGEST_MM = 1189.0  # longer side of A0, the largest sheet that printers take
# Between where EXIF says that the focus is and where the board is: nearer to a slip of the unit, which is 10 or more,
# than to none. A Pixel XL stated 0.29 m for boards at 0.34, 0.38 and 0.59 m.
FOCUS_OFF = 10**0.5
MARKER_OFF = 0.05  # of a square: a millimetre of twenty; blur and lens change a marker's width by less than half of it
UNITS = {"centimetres": 10.0, "inches": 25.4, "metres": 1000.0}
AS_TYPED, AS_PRINTED, AS_CUT, ASSUMED = (
    "as you typed it",
    "from the board's print, if it was printed at 100 %",
    "as such sheets and cards are cut",
    "which is assumed, as nobody said it",
)


def scale_of(board: AnyBoard, is_named: bool) -> dict[str, str]:
    """Return what every length rests on, as the entry of Calibration.residuals: `length`, and where it is `from`."""
    if isinstance(board, Blank):
        return {"length": f"{board.name} = {board.long_mm:g} x {board.short_mm:g} mm", "from": AS_CUT}
    said = AS_PRINTED if board.spec() in DEFAULT_BOARDS.values() else AS_TYPED
    return {"length": f"one square = {board.square_mm:g} mm", "from": said if is_named else ASSUMED}


def scale_parts(residuals: dict[str, Any]) -> tuple[str, str] | None:
    """Return a length and where it is from, of the residuals of a calibration, which may be a stranger's."""
    found = residuals.get("scale")
    if not isinstance(found, dict) or not all(isinstance(found.get(key), str) for key in ("length", "from")):
        return None
    return found["length"], found["from"]


def scale_sentence(residuals: dict[str, Any]) -> str:
    """Return what every length rests on; "" where no board gives the scale."""
    parts = scale_parts(residuals)
    return f"Every length rests on this: {parts[0]}, {parts[1]}. Measure it." if parts else ""


def scale_doubts(board: AnyBoard, away_mm: float, name: str, optics: Optics, marker_share: float | None) -> list[str]:
    """Return what contradicts the size of the board; each sentence says what was measured.

    Args:
        away_mm: from the camera to the middle of the board, if the board has that size.
        name: of the photo.
        marker_share: as marker_share.
    """
    doubts = []
    signs = _signs(board, away_mm, name, optics)
    if signs:
        doubts.append(f"{'; '.join(signs)}. {_advice(board, away_mm, name, optics)}")
    if isinstance(board, Board) and marker_share is not None:
        stated = board.marker_mm / board.square_mm
        if abs(marker_share - stated) > MARKER_OFF:
            doubts.append(
                f"in {name} a marker is {marker_share:.2f} of a square wide, and {board.marker_mm:g} of "
                f"{board.square_mm:g} mm is {stated:.2f}: one of the two is wrong. With markers of {board.marker_mm:g} "
                f"mm a square has about {board.marker_mm / marker_share:.2g} mm. Measure a square and name "
                "the board with it"
            )
    return doubts


def marker_share(grey: Grey, corners: Corners) -> float | None:
    """Return the width of the markers that a photo shows, in squares; None where it shows none."""
    board = corners.board
    if not isinstance(board, Board) or board.kind != "charuco":
        return None
    ids, quads = read_markers(grey, board.dictionary)
    flat, _ = cv2.findHomography(corners.pixels, corners.points[:, :2])
    if not len(ids) or flat is None:
        return None
    quads = cv2.perspectiveTransform(quads.reshape(-1, 1, 2), flat).reshape(-1, 4, 2)
    sides: Float[np.ndarray, "markers 4"] = np.linalg.norm(quads - np.roll(quads, 1, axis=1), axis=2)
    return float(np.median(sides) / board.square_mm)


def _extents(board: AnyBoard) -> tuple[float, float]:
    """Return the longer and the shorter side of the board's print, mm."""
    if isinstance(board, Blank):
        return board.long_mm, board.short_mm
    more = 0 if board.kind == "charuco" else 1
    sides = ((board.columns + more) * board.square_mm, (board.rows + more) * board.square_mm)
    return max(sides), min(sides)


def _signs(board: AnyBoard, away_mm: float, name: str, optics: Optics) -> list[str]:
    """Return what speaks against the size of the board."""
    longer, shorter = _extents(board)
    size, signs = f"the board would be {longer:.3g} x {shorter:.3g} mm", []
    if longer < STAMP_MM:
        signs.append(f"{size}, smaller than a stamp")
    if longer > LARGEST_MM:
        signs.append(f"{size}, larger than the largest sheet (A0: {LARGEST_MM:g} mm)")
    if away_mm < optics.closest_mm():
        signs.append(
            f"the camera would be {away_mm:.3g} mm from it, and {optics.words()} is not sharp nearer than about "
            f"{optics.closest_mm():.0f} mm"
        )
    if optics.focus_mm is not None and abs(np.log(optics.focus_mm / away_mm)) > np.log(FOCUS_OFF):
        signs.append(
            f"{name} was focused at {optics.focus_mm:.0f} mm (EXIF), and the board would be {away_mm:.3g} mm away"
        )
    return signs


def _advice(board: AnyBoard, away_mm: float, name: str, optics: Optics) -> str:
    """Return which unit would fit, and what to do."""
    if isinstance(board, Blank):
        return f"Look whether {board.spec()} is what lies there"
    fitting = []
    for unit, factor in UNITS.items():
        larger = replace(board, square_mm=factor * board.square_mm, marker_mm=factor * board.marker_mm)
        if not _signs(larger, factor * away_mm, name, optics):
            fitting.append(f"in {unit} it would be {larger.square_mm:.4g} mm")
    units = f" ({', '.join(fitting)})" if fitting else ""
    if not fitting and optics.focus_mm is not None:
        units = f" (squares of about {board.square_mm * optics.focus_mm / away_mm:.2g} mm would fit that focus)"
    return f"The board's {board.square_mm:g} is read as millimetres{units}. Measure a square and name the board with it"
