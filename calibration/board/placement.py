"""Assign a lattice's corners to corners of the board: by extent on a checkerboard, by markers on a ChArUco board."""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int

from calibration.board.board import Board, opencv_dictionary
from calibration.board.lattice import Lattice, brightness

FRINGE, FRINGE_SHARE = 3, 1 / 3  # corners: an outer row with fewer than both belongs to something beside the board
PART_OF_BOARD = 0.5  # of the corners: less of an unplaced checkerboard may be a tablecloth
PLACED_BOARD = 0.5  # of the corners: fewer that span the whole of it are clutter
UNLIKELY = 6.0  # sigmas of chance agreement between what is printed and what is seen
CLEARLY_BETTER = 2.5  # sigmas above the second best place
LEAST_AGREEMENT = 0.2  # mean correlation of the bits: blurred markers have 0.4, others 0
FEWEST_MARKERS = 6  # four determine the view, two more reveal another board
ON_GRID = 0.15  # squares: how far lens distortion moves a marker from the flat grid
FLAT_SQUARE = 4.0  # grey levels, standard deviation: less is no marker, but something plain on the board
TURNS = np.array([[[1, 0], [0, 1]], [[0, -1], [1, 0]], [[-1, 0], [0, -1]], [[0, 1], [-1, 0]]])  # by quarters


@dataclass(frozen=True, eq=False)
class Placement:
    """Corners of a lattice with their column and row on the board."""

    board: Board  # columns and rows may be exchanged against the request
    used: Int[np.ndarray, " n"]  # indices of the lattice's corners
    corners: Int[np.ndarray, "n 2"]  # column and row among the board's inner corners
    is_placed: bool  # False: the origin may be some squares off, as on a part of a checkerboard


def place(lattice: Lattice, image: Float32[np.ndarray, "height width"], board: Board) -> Placement | None:
    """Return the place of the lattice on this board; None if it cannot be (part of) this board."""
    return _by_markers(lattice, image, board) if board.kind == "charuco" else _by_extent(lattice, board)


# --- checkerboard ----------------------------------------------------------------------------------------------------


def _by_extent(lattice: Lattice, board: Board) -> Placement | None:
    """Place a lattice as large as the board; where the print distinguishes its corners, the first cell is dark."""
    kept = trimmed(lattice.cells)
    if len(kept) == 0:
        return None
    counts = np.array(board.corner_counts())
    is_told = board.turns_alike() > (1 if board.columns == board.rows else 2)  # turns that fit differ in colour
    found: list[tuple[int, int, Placement]] = []  # corners, turn
    for turn in _turns_by_direction(lattice):
        cells = lattice.cells[kept] @ TURNS[turn].T
        first = cells.min(0)
        spare = cells.max(0) - first + 1 - counts
        if (spare < 0).any():
            continue
        for shift in np.ndindex(*(spare + 1).tolist()):
            corners = cells - first - shift
            if is_told and _is_light(lattice, turn, first + shift):
                continue
            inside = ((corners >= 0) & (corners < counts)).all(1)
            found.append((int(inside.sum()), turn, Placement(board, kept[inside], corners[inside], True)))
    if not found:
        return _part(lattice, kept, board)
    most, turn, best = max(found, key=lambda place: place[0])  # of equal ones the first, which stands upright
    if most < PLACED_BOARD * counts.prod():
        return None
    elsewhere = [place for place in found if place[0] == most and place[1] == turn]
    return best if len(elsewhere) == 1 else None


def _is_light(lattice: Lattice, turn: int, corner: Int[np.ndarray, "2"]) -> bool:
    """Return whether the cell that begins at this corner of the turned lattice is light."""
    cell = (corner + 0.5) @ TURNS[turn] - 0.5  # the inverse of a turn is its transpose
    return lattice.first_is_light != bool(round(cell.sum()) % 2)


def _turns_by_direction(lattice: Lattice) -> list[int]:
    """Return the four turns; the first is the one whose columns run most to the right of the picture."""
    right = [np.cov(lattice.cells @ turn[0], lattice.pixels[:, 0])[0, 1] for turn in TURNS]
    return np.argsort(right)[::-1].tolist()


def _part(lattice: Lattice, kept: Int[np.ndarray, " n"], board: Board) -> Placement | None:
    """Number a lattice smaller than the board from its own first corner."""
    counts = np.array(board.corner_counts())
    if len(kept) < PART_OF_BOARD * counts.prod():
        return None
    for turn in _turns_by_direction(lattice):
        cells = lattice.cells[kept] @ TURNS[turn].T
        cells = cells - cells.min(0)
        if (cells.max(0) < counts).all():
            return Placement(board, kept, cells, False)
    return None


def trimmed(cells: Int[np.ndarray, "n 2"]) -> Int[np.ndarray, " kept"]:
    """Return the indices of the cells without outer rows and columns that hold few corners."""
    kept = np.arange(len(cells))
    while len(kept):
        before = len(kept)
        for axis in (0, 1):
            for is_last in (False, True):
                if len(kept) == 0:
                    return kept
                edge = cells[kept, axis].max() if is_last else cells[kept, axis].min()
                on_edge = cells[kept, axis] == edge
                across = np.ptp(cells[kept, 1 - axis]) + 1
                if on_edge.sum() < min(FRINGE, FRINGE_SHARE * across):
                    kept = kept[~on_edge]
        if len(kept) == before:
            break
    return kept


# --- ChArUco ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Print:
    """The marker bits of a ChArUco board."""

    board: Board
    cells: Int[np.ndarray, "markers 2"]  # column and row of the squares that hold them
    bits: Float[np.ndarray, "turns markers bits"]  # of each as seen by a lattice turned so; mean 0, variance 1


_Score = tuple[float, int, int, np.ndarray, Board]  # summed correlation, squares compared, turn, shift, board


def _by_markers(lattice: Lattice, image: Float32[np.ndarray, "height width"], board: Board) -> Placement | None:
    """Return the place where the squares look most like the board's markers, if it clearly beats the second best.

    The score is the correlation of seen and printed bits, both with mean 0 and variance 1. By chance it is 0 with
    variance one over the number of bits. No marker has to be readable: blurred and oblique ones still correlate.
    """
    n_bits = opencv_dictionary(board.dictionary).markerSize
    squares, seen = _seen_bits(lattice, image, board, n_bits)
    if len(squares) == 0:
        return None
    scores: list[_Score] = []
    for printed in _prints(board):
        agreement = np.einsum("sb,tmb->tsm", seen, printed.bits) / n_bits**2
        table = np.full((printed.board.columns, printed.board.rows), -1)
        table[tuple(printed.cells.T)] = np.arange(len(printed.cells))
        for turn in range(4):
            scores += _best_shifts(squares, agreement[turn], table, turn, printed.board)
    scores.sort(key=lambda score: score[0] / np.sqrt(score[1]), reverse=True)
    best = scores[0]
    sigma = np.sqrt(best[1]) / n_bits  # of the sum over this many squares, by chance
    if best[0] < UNLIKELY * sigma or best[0] < LEAST_AGREEMENT * best[1]:
        return None
    rivals = [score for score in scores[1:] if best[0] - score[0] < CLEARLY_BETTER * sigma]
    if any(rival[2] != best[2] for rival in rivals):
        return None  # another turn would be another ground; another shift is only another origin
    _, _, turn, shift, variant = best
    corners = lattice.cells @ TURNS[turn].T + shift - 1  # inner corners begin one square inside
    inside = ((corners >= 0) & (corners < variant.corner_counts())).all(1)
    return Placement(variant, np.nonzero(inside)[0], corners[inside], not rivals)


def placed_markers(
    ids: Int[np.ndarray, " n"], quads: Float[np.ndarray, "n 4 2"], board: Board
) -> tuple[Board, Float[np.ndarray, "used 2"], Float[np.ndarray, "used 3"]] | None:
    """Return the middles of the markers (px) that lie as on this board, and where they are on it (world, mm).

    The board's columns and rows come as they are. None where fewer than FEWEST_MARKERS lie so.
    """
    best: tuple[int, float, Board, np.ndarray, np.ndarray] | None = None
    share = board.marker_mm / board.square_mm * (np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) - 0.5)
    for printed in _prints(board):
        known = np.flatnonzero(ids < len(printed.cells))
        cells = printed.cells[ids[known]].astype(float)
        flat = on_cells(quads[known], cells)
        if flat is None:
            continue
        off = np.linalg.norm(flat - cells[:, None] - share, axis=2).max(1)  # of its worst corner: it may be turned
        good = off < ON_GRID
        if good.sum() >= FEWEST_MARKERS and (best is None or (good.sum(), -off[good].mean()) > best[:2]):
            best = int(good.sum()), -float(off[good].mean()), printed.board, middles(quads[known[good]]), cells[good]
    if best is None:
        return None
    _, _, variant, pixels, cells = best
    return variant, pixels, np.column_stack([cells + 0.5, np.zeros(len(cells))]) * variant.square_mm * [1, -1, 1]


def on_cells(quads: Float[np.ndarray, "n 4 2"], cells: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 4 2"] | None:
    """Return markers (px) on the board, in columns and rows, by a flat view that puts most middles into these cells."""
    if len(cells) < FEWEST_MARKERS or np.linalg.matrix_rank(cells - cells.mean(0)) < 2:
        return None
    matrix, _ = cv2.findHomography(middles(quads), cells, cv2.USAC_MAGSAC, ON_GRID)
    return None if matrix is None else cv2.perspectiveTransform(quads.reshape(-1, 1, 2), matrix).reshape(-1, 4, 2)


def middles(quads: Float[np.ndarray, "n 4 2"]) -> Float[np.ndarray, "n 2"]:
    """Return where the diagonals cross: the middle in any perspective, however blur and tone move the four edges."""
    homogeneous = np.concatenate([quads, np.ones((len(quads), 4, 1))], 2)
    one, other = (np.cross(homogeneous[:, k], homogeneous[:, k + 2]) for k in (0, 1))
    crossing = np.cross(one, other)
    return crossing[:, :2] / crossing[:, 2:]


def _best_shifts(
    squares: Int[np.ndarray, "squares 2"],
    agreement: Float[np.ndarray, "squares markers"],
    table: Int[np.ndarray, "columns rows"],
    turn: int,
    board: Board,
) -> list[_Score]:
    """The two best shifts from the turned lattice to the board."""
    turned = np.round((squares + 0.5) @ TURNS[turn].T - 0.5).astype(int)
    size = np.array(table.shape)
    low, high = -turned.max(0), size - turned.min(0)
    shifts = np.stack(np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]), indexing="ij"), -1)
    shifts = shifts.reshape(-1, 2)
    cells = turned + shifts[:, None]
    inside = ((cells >= 0) & (cells < size)).all(-1)
    marker = np.where(inside, table[tuple(np.where(inside[..., None], cells, 0).transpose(2, 0, 1))], -1)
    values = np.where(marker >= 0, agreement[np.arange(len(squares)), marker], 0.0)
    n_compared = np.maximum((marker >= 0).sum(1), 1)
    total = values.sum(1)
    best = np.argsort(-total / np.sqrt(n_compared))[:2]
    return [(float(total[k]), int(n_compared[k]), turn, shifts[k], board) for k in best]


def _seen_bits(
    lattice: Lattice, image: Float32[np.ndarray, "height width"], board: Board, n_bits: int
) -> tuple[Int[np.ndarray, "squares 2"], Float[np.ndarray, "squares bits"]]:
    """Return the standardised brightness at a marker's bits, in every light square of the lattice and around it."""
    first, size = lattice.cells.min(0) - 1, np.ptp(lattice.cells, axis=0) + 3
    corners = lattice.completed(first, size)
    i, j = (axis.ravel() for axis in np.meshgrid(*(np.arange(n - 1) for n in size), indexing="ij"))
    quads = np.stack([corners[i, j], corners[i + 1, j], corners[i, j + 1], corners[i + 1, j + 1]], 1)
    in_photo = ((quads >= 0) & (quads <= np.array(image.shape[::-1]) - 1)).all((1, 2))
    light = (i + j + first.sum()) % 2 == (0 if lattice.first_is_light else 1)
    squares, quads = np.stack([i, j], 1)[light & in_photo] + first, quads[light & in_photo]
    if len(squares) == 0:
        return squares, np.zeros((0, n_bits**2))
    share = board.marker_mm / board.square_mm
    steps = (1 - share) / 2 + share * (np.arange(n_bits) + 1.5) / (n_bits + 2)  # the marker's border is one bit wide
    y, x = (axis.ravel() for axis in np.meshgrid(steps, steps, indexing="ij"))
    where = np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], 1) @ quads
    levels = brightness(image, where)
    has_contrast = levels.std(1) > FLAT_SQUARE
    return squares[has_contrast], _standard(levels[has_contrast])


@lru_cache(maxsize=16)
def _prints(board: Board) -> list[_Print]:
    """Return the board and its possible variants: columns and rows exchanged, the older pattern."""
    prints: list[_Print] = []
    for variant in dict.fromkeys((board, board.transposed())):
        for is_legacy in (False, True):
            made = variant.opencv(is_legacy)
            middles = np.asarray(made.getObjPoints())[..., :2].mean(1)
            cells = np.floor(middles / board.square_mm).astype(int)
            if any(p.board == variant and np.array_equal(p.cells, cells) for p in prints):
                continue
            dictionary = opencv_dictionary(board.dictionary)
            n = dictionary.markerSize
            marks = [dictionary.generateImageMarker(int(i), n + 2)[1:-1, 1:-1] for i in np.ravel(made.getIds())]
            turned = [[np.rot90(mark, turn).ravel() for mark in marks] for turn in range(4)]
            prints.append(_Print(variant, cells, _standard(np.array(turned, float))))
    return prints


def _standard(values: Float[np.ndarray, "*batch n"]) -> Float[np.ndarray, "*batch n"]:
    """Values less their mean, over their standard deviation."""
    values = values - values.mean(-1, keepdims=True)
    return values / np.maximum(values.std(-1, keepdims=True), 1e-6)
