"""A board to print: a page at true scale as vectors (PDF) and as pixels (PNG), with a ruler to check the print by."""

import io
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image
from reportlab.lib.units import mm
from reportlab.pdfgen.canvas import Canvas

from calibration.board.board import Board, opencv_dictionary
from capture.errors import CalibrationError
from capture.files.atomic import atomic_file

PAPERS = {"a4": (210.0, 297.0), "letter": (215.9, 279.4)}  # mm, upright
UNPRINTABLE_MM = 6.0  # at each edge: what home printers leave white, and a little more
QUIET_SHARE = 0.25  # of a square, white, around the print: the outer squares have to end on white
RULER_MM = 14.0  # strip below the print: ruler and text
RULER_BOTTOM_MM = 10.0  # of its line above the page's lower edge
LINE_MM = 0.2
RULER_LENGTH_MM = 100.0
TICKS = ((10, 4.0), (5, 2.8), (1, 1.8))  # every so many mm, tick length in mm
TEXT_POINTS = 7.0
DEFAULT_BOARDS = {"charuco": "charuco:7x9:25:18:DICT_4X4_50", "checkerboard": "checkerboard:9x6:24"}  # on A4 and Letter
OVERSAMPLING = 4
PNG_TEXT = 0.9  # of OpenCV's font: as large as the PDF's
PNG_DPI = 300  # a dot is 0.085 mm: sharper than most home printers
MM_PER_INCH = 25.4


@dataclass(frozen=True)
class Rectangle:
    """A black (or, on black, white) rectangle of the page: mm from the page's lower left corner."""

    x: float
    y: float
    width: float
    height: float
    is_black: bool = True


@dataclass(frozen=True)
class BoardPage:
    """A page with a board on it."""

    board: Board
    width_mm: float
    height_mm: float
    rectangles: tuple[Rectangle, ...]  # in drawing order


def lay_out(board: Board, paper: str) -> BoardPage:
    """Centre the board on a sheet of this paper; the sheet is turned only if the board fits no other way.

    Raises:
        CalibrationError: it does not fit between the margins that printers need.
    """
    if paper not in PAPERS:
        raise ValueError(f"paper is {paper!r}, one of {', '.join(PAPERS)} is needed")
    less = 0 if board.kind == "charuco" else 1  # a checkerboard counts inner corners
    width, height = (board.columns + less) * board.square_mm, (board.rows + less) * board.square_mm
    needed = (
        width + 2 * (UNPRINTABLE_MM + QUIET_SHARE * board.square_mm),
        height + 2 * (UNPRINTABLE_MM + QUIET_SHARE * board.square_mm) + RULER_MM,
    )
    sheet = PAPERS[paper]
    fitting = [page for page in (sheet, sheet[::-1]) if needed[0] <= page[0] and needed[1] <= page[1]]
    if not fitting:
        raise CalibrationError(
            f"board {board.spec()} needs {needed[0]:.0f} x {needed[1]:.0f} mm with its margins and ruler, "
            f"{paper.upper() if paper == 'a4' else paper.title()} has {sheet[0]:g} x {sheet[1]:g}. "
            "Take smaller squares or fewer of them."
        )
    page_width, page_height = fitting[0]
    left = (page_width - width) / 2
    bottom = RULER_MM + (page_height - RULER_MM - height) / 2
    rectangles = (*_squares(board, left, bottom + height), *_ruler((page_width - RULER_LENGTH_MM) / 2))
    return BoardPage(board, page_width, page_height, rectangles)


def save_board(page: BoardPage, pdf: Path, png: Path) -> None:
    """Write the page as PDF (vectors, true scale) and as PNG (300 dpi, as stated in the file)."""
    with atomic_file(pdf) as file:
        file.write_bytes(draw_pdf(page))
    with atomic_file(png) as file:
        Image.fromarray(draw_picture(page)).save(file, dpi=(PNG_DPI, PNG_DPI))


def draw_pdf(page: BoardPage) -> bytes:
    """Return the page as PDF; the same page gives the same bytes."""
    target = io.BytesIO()
    canvas = Canvas(target, pagesize=(page.width_mm * mm, page.height_mm * mm), invariant=1)
    canvas.setTitle(f"Shadowgraph board {page.board.spec()}")
    canvas.setViewerPreference("PrintScaling", "None")
    for shape in page.rectangles:
        canvas.setFillGray(0.0 if shape.is_black else 1.0)
        canvas.rect(shape.x * mm, shape.y * mm, shape.width * mm, shape.height * mm, stroke=0, fill=1)
    canvas.setFillGray(0.0)
    canvas.setFont("Helvetica", TEXT_POINTS)
    for height, text in _texts(page):
        canvas.drawCentredString(page.width_mm / 2 * mm, height * mm, text)
    canvas.showPage()
    canvas.save()
    return target.getvalue()


def draw_picture(page: BoardPage) -> UInt8[np.ndarray, "height width"]:
    """Draw the page in grey levels at 300 dpi; edges can fall between dots, so a dot can be partly black."""
    dots = PNG_DPI / MM_PER_INCH
    size = round(page.width_mm * dots), round(page.height_mm * dots)
    art = np.full((size[1] * OVERSAMPLING, size[0] * OVERSAMPLING), 255, np.uint8)
    for shape in page.rectangles:
        scale = dots * OVERSAMPLING
        left, right = round(shape.x * scale), round((shape.x + shape.width) * scale)
        top = round((page.height_mm - shape.y - shape.height) * scale)
        art[top : round((page.height_mm - shape.y) * scale), left:right] = 0 if shape.is_black else 255
    picture = np.asarray(cv2.resize(art, size, interpolation=cv2.INTER_AREA))
    for height, text in _texts(page):
        (width, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, PNG_TEXT, 1)
        at = (size[0] - width) // 2, round((page.height_mm - height) * dots)
        cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, PNG_TEXT, 0, 1, cv2.LINE_AA)
    return picture


def _texts(page: BoardPage) -> tuple[tuple[float, str], ...]:
    """Lines of text and the height of their foot, mm."""
    return (
        (RULER_BOTTOM_MM + TICKS[0][1] + 1.5, f"{page.board.spec()}   print at 100 %, not fitted to the page"),
        (RULER_BOTTOM_MM - 3.0, f"this ruler is {RULER_LENGTH_MM:g} mm long"),
    )


def _squares(board: Board, left: float, top: float) -> list[Rectangle]:
    """The print: dark squares, and on a ChArUco board black markers with white bits."""
    side = board.square_mm
    less = 0 if board.kind == "charuco" else 1
    shapes = [
        Rectangle(left + column * side, top - (row + 1) * side, side, side)
        for row in range(board.rows + less)
        for column in range(board.columns + less)
        if (row + column) % 2 == 0
    ]
    if board.kind == "charuco":
        made, dictionary = board.opencv(), opencv_dictionary(board.dictionary)
        cells = dictionary.markerSize + 2  # with the border
        bit = board.marker_mm / cells
        for index, corners in zip(np.ravel(made.getIds()), np.asarray(made.getObjPoints()), strict=True):
            x, y = left + float(corners[:, 0].min()), top - float(corners[:, 1].min())
            shapes.append(Rectangle(x, y - board.marker_mm, board.marker_mm, board.marker_mm))
            picture = dictionary.generateImageMarker(int(index), cells)
            shapes += [
                Rectangle(x + column * bit, y - (row + 1) * bit, bit, bit, is_black=False)
                for row, column in np.argwhere(picture > 0).tolist()
            ]
    return shapes


def _ruler(left: float) -> list[Rectangle]:
    """Draw ticks every millimetre; the ruler ends at the middles of the first and last tick."""
    shapes = [Rectangle(left, RULER_BOTTOM_MM, RULER_LENGTH_MM, LINE_MM)]
    for at in range(round(RULER_LENGTH_MM) + 1):
        length = next(length for every, length in TICKS if at % every == 0)
        shapes.append(Rectangle(left + at - LINE_MM / 2, RULER_BOTTOM_MM, LINE_MM, length))
    return shapes
