"""The board of a capture: which ones there are, its page to print, and its picture at true scale for a screen."""

from dataclasses import replace
from typing import Any

from calibration.board.board import parse_board, parse_print
from calibration.board.printing import DEFAULT_BOARDS, PAPERS, BoardPage, lay_out
from capture.errors import CaptureError

CHOICES = (
    ("", "Find out from the photos", "Common printed boards are tried."),
    (DEFAULT_BOARDS["charuco"], "Our printed board", "Recognised from all sides and with parts of it hidden."),
    (DEFAULT_BOARDS["checkerboard"], "Our printed checkerboard", "Fewer fine details; for printers that smear."),
    ("paper:A4", "A blank sheet of A4", "No printer needed: a clean, flat sheet on a darker table."),
    ("paper:letter", "A blank sheet of US letter", "No printer needed: a clean, flat sheet on a darker table."),
    ("card", "A bank card", "No printer needed: for objects not much larger than a hand."),
)


def choices() -> list[dict[str, str]]:
    """Return the boards that the page offers."""
    return [{"spec": spec, "title": title, "about": about} for spec, title, about in CHOICES]


def checked_spec(spec: str) -> str:
    """Return a board's text after a check; "" stands for none.

    Raises:
        CalibrationError: it describes no board.
    """
    return parse_board(spec).spec() if spec else ""


def board_page(spec: str, paper: str) -> BoardPage:
    """Lay a board out on a sheet.

    Raises:
        CaptureError: there is no such paper.
        CalibrationError: the board cannot be printed, or does not fit.
    """
    if paper not in PAPERS:
        raise CaptureError(f"{paper!r:.40} is no paper; {' or '.join(PAPERS)} was needed.")
    return lay_out(parse_print(spec or DEFAULT_BOARDS["charuco"]), paper)


def board_shapes(spec: str) -> dict[str, Any]:
    """Return the board's rectangles in mm from the upper left corner of its sheet, with the sheet's size, to draw."""
    page = board_page(spec, "a4")
    upright = [replace(shape, y=page.height_mm - shape.y - shape.height) for shape in page.rectangles]
    rows = [[shape.x, shape.y, shape.width, shape.height, int(shape.is_black)] for shape in upright]
    return {"width": page.width_mm, "height": page.height_mm, "shapes": rows, "spec": page.board.spec()}
