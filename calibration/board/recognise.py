"""Recognise the board in the photos without a description, from marker numbers or from the grid of corners."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from calibration.board.board import Board, opencv_dictionary, parse_board
from calibration.board.corners import MARKER_SIZE, SEARCH_SIZES, Grey, find_board, grey_of, read_markers, reduced
from calibration.board.lattice import find_lattices
from calibration.board.placement import FEWEST_MARKERS, ON_GRID, on_cells, trimmed
from capture.photos.photo import read_small_photo

ASSUMED_SQUARE_MM = 30.0  # what fits five or six times across A4
FAMILIES = (  # by increasing size: the small ones are the beginnings of the large ones
    ("DICT_4X4_50", "DICT_4X4_100", "DICT_4X4_250", "DICT_4X4_1000"),
    ("DICT_5X5_50", "DICT_5X5_100", "DICT_5X5_250", "DICT_5X5_1000"),
    ("DICT_6X6_50", "DICT_6X6_100", "DICT_6X6_250", "DICT_6X6_1000"),
    ("DICT_7X7_50", "DICT_7X7_100", "DICT_7X7_250", "DICT_7X7_1000"),
    ("DICT_ARUCO_ORIGINAL",),
    ("DICT_APRILTAG_36h11",),
)
MOST_COLUMNS = 20  # squares
AGREEING = 0.7  # of the markers; the rest may be false detections
SURE_MARKERS = 10  # that lie on one board: no other dictionary reads so many by chance, so none is asked
FEWEST_CORNERS = 20  # inner corners, as of 5 x 4: smaller grids are found in tablecloths
MANY_CORNERS = 200  # ends the search: more than most prints have
ENOUGH_PHOTOS = 5  # looked at per question


def guess_board(photos: Sequence[Grey]) -> Board | None:
    """Return the board seen in these photos, with assumed lengths in mm; None if none is recognised."""
    photos = photos[:ENOUGH_PHOTOS]
    return _guess_charuco(photos) or _guess_checkerboard(photos)


def board_finder(spec: str | None) -> Callable[[Path], bool]:
    """Return a function that tells whether a photo shows this board, or a part of it; None: any printed one.

    A blank sheet is never found so: any sheet of paper would be one.

    Raises:
        CalibrationError: there is no such board.
    """
    board = parse_board(spec) if spec else None

    def shows_board(path: Path) -> bool:
        grey = grey_of(read_small_photo(path, MARKER_SIZE))
        if board is None:
            return guess_board([grey]) is not None
        return isinstance(board, Board) and find_board(grey, board, allow_part=True) is not None

    return shows_board


def is_mirrored(photos: Sequence[Grey]) -> bool:
    """Return whether markers are read in these photos only once they are turned over: they were stored mirrored."""
    photos = photos[:ENOUGH_PHOTOS]
    return _guess_charuco(photos) is None and _guess_charuco([np.fliplr(photo).copy() for photo in photos]) is not None


# --- ChArUco ---------------------------------------------------------------------------------------------------------


def _guess_charuco(photos: Sequence[Grey]) -> Board | None:
    small = [reduced(photo, MARKER_SIZE)[0] for photo in photos]
    best: tuple[int, Board] | None = None
    for family in FAMILIES:
        seen = [read_markers(photo, family[0]) for photo in small]
        if len(family) > 1 and max((len(ids) for ids, _ in seen), default=0) >= FEWEST_MARKERS:
            seen = [read_markers(photo, family[-1]) for photo in small]  # larger boards go on in larger ones
        layouts = [found for found in (_layout(*markers) for markers in seen) if found is not None]
        for columns, ratio, _, _ in sorted(layouts, key=lambda one: -one.n_markers)[:2]:
            top = max(one.top for one in layouts if one.columns == columns)
            board = _charuco(columns, top, ratio, family)
            found = [corners for photo in small if (corners := find_board(photo, board)) is not None]
            n_corners = sum(len(corners.points) for corners in found if corners.board == board)
            if n_corners and (best is None or n_corners > best[0]):
                best = n_corners, board
        if best and max((one.n_markers for one in layouts), default=0) >= SURE_MARKERS:
            break
    return best[1] if best else None


class _Layout(NamedTuple):
    """How the markers of a photo lie on a regular board."""

    columns: int  # of squares
    ratio: float  # marker / square
    n_markers: int  # that lie so
    top: int  # the largest number among these: false markers may have any


def _layout(ids: Int[np.ndarray, " n"], corners: Float[np.ndarray, "n 4 2"]) -> _Layout | None:
    """Return how consecutive markers lie on a board; None for no regular board."""
    if len(ids) < FEWEST_MARKERS:
        return None
    best: tuple[int, float, _Layout] | None = None
    for columns in range(3, MOST_COLUMNS + 1):
        for is_legacy in (False, True):
            cells = _cells(columns, int(ids.max()) + 1, is_legacy)[ids]
            flat = on_cells(corners, cells)
            if flat is None:
                continue
            off = np.linalg.norm(flat.mean(1) - cells, axis=1)
            good = off < ON_GRID
            if good.sum() < max(FEWEST_MARKERS, AGREEING * len(ids)):
                continue
            ratio = float(np.median(np.linalg.norm(flat - np.roll(flat, 1, axis=1), axis=2)[good]))
            layout = _Layout(columns, ratio, int(good.sum()), int(ids[good].max()))
            score = (layout.n_markers, -float(off[good].mean()), layout)
            if 0 < ratio < 1 and (best is None or score > best):
                best = score
    return best[2] if best else None


def _cells(columns: int, n_markers: int, is_legacy: bool) -> Float[np.ndarray, "n 2"]:
    """Column and row of each marker: on the light squares, numbered row by row."""
    rows = 2 * n_markers // columns + 2
    u, v = np.meshgrid(np.arange(columns), np.arange(rows))
    light = (u + v) % 2 == (0 if is_legacy else 1)
    return np.stack([u[light], v[light]], 1).astype(float)[:n_markers]


def _charuco(columns: int, top: int, ratio: float, family: tuple[str, ...]) -> Board:
    """Return the smallest board that has marker `top`."""
    rows = 3
    while columns * rows // 2 <= top:
        rows += 1
    dictionary = next((d for d in family if len(opencv_dictionary(d).bytesList) > top), family[-1])
    return Board("charuco", columns, rows, ASSUMED_SQUARE_MM, round(ratio * ASSUMED_SQUARE_MM, 1), dictionary)


# --- checkerboard ----------------------------------------------------------------------------------------------------


def _guess_checkerboard(photos: Sequence[Grey]) -> Board | None:
    """Return the board size that fits most photos, the largest of equals; candidates are the extents of lattices."""
    best: tuple[int, int, Board] | None = None
    for columns, rows in sorted({size for photo in photos if (size := _extent(photo)) is not None}):
        board = Board("checkerboard", columns, rows, ASSUMED_SQUARE_MM)
        n_found = sum(find_board(photo, board) is not None for photo in photos)
        if n_found and (best is None or (n_found, columns * rows) > best[:2]):
            best = n_found, columns * rows, board
    return best[2] if best else None


def _extent(photo: Grey) -> tuple[int, int] | None:
    """Inner corners along the sides of the largest lattice in the photo, the longer side first."""
    best, size = 0.0, None
    for longest in SEARCH_SIZES:
        for lattice in find_lattices(reduced(photo, longest)[0].astype(np.float32), FEWEST_CORNERS, MANY_CORNERS):
            kept = trimmed(lattice.cells)
            if len(kept) >= FEWEST_CORNERS:
                sides = np.ptp(lattice.cells[kept], axis=0) + 1
                score = len(kept) * (len(kept) / sides.prod()) ** 2  # large and without holes
                if score > best:
                    best, size = score, (int(sides.max()), int(sides.min()))
    return size
