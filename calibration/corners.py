"""The corners of a printed board in one photo, to a fraction of a pixel."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from calibration.board import Board

Grey = UInt8[np.ndarray, "_ _"]  # height, width; a reduced copy may stand beside the photo in one signature

FEWEST_CORNERS = 6  # four fix the plane's eight numbers exactly; below two more, a wrong corner goes unnoticed
QUICK_SIZE = 1000  # px: the classic checkerboard search takes < 0.2 s at this size
THOROUGH_SIZE = 1500  # px: the sector search takes minutes at 12 MP, seconds at this size
EXHAUSTIVE_SIZE = 800  # px: and the exhaustive one a few seconds at this size
WINDOW_SHARE = 0.25  # of the spacing: refinement looks at one corner, well clear of its neighbours
SMALLEST_WINDOW, LARGEST_WINDOW = 2, 20  # px, half sides
SADDLE_SHARE, SADDLE_SMALLEST = 0.1, 3.0  # half window of the saddle fit: of the spacing (markers begin there), and px
BLUR_SHARE, BLUR_SMALLEST = 0.025, 1.0  # sigma of the blur before it: of the spacing, and px
SADDLE_SAMPLES = 21  # along the window: two and a half in one sigma of the blur, so nothing falls between them
WEIGHT_WIDTH = 1 / 1.5  # sigma of the weights in half windows: what lies at its edge hardly counts
NEWTON_STEPS = 5  # to the saddle point; the last moves it by less than 0.001 px
FARTHEST_SADDLE = 0.5  # half windows between the corner and its saddle point: beyond, it belongs to something else
SMOOTH_FROM = 20  # corners: from here on lens distortion can be told from a wrong corner
STRAY_SMOOTH, STRAY_PLAIN = 0.08, 0.25  # of the spacing: the same with and without a model of the distortion


@dataclass(frozen=True)
class Corners:
    """Where corners of a board were seen: pixels[i] is the photo's view of points[i]."""

    pixels: Float[np.ndarray, "n 2"]
    points: Float[np.ndarray, "n 3"]  # world, mm: on the printed side, z = 0
    board: Board  # as matched: columns and rows may be exchanged against the request

    def __post_init__(self):
        if len(self.pixels) != len(self.points):
            raise ValueError("corners need one point per pixel")


def find_board(grey: Grey, board: Board) -> Corners | None:
    """The corners of this board in a photo; None where it is not seen, or too little of it.

    ChArUco: either pattern generation and either order of columns and rows is tried, parts of the board will do.
    Checkerboard: all inner corners must be seen. They are numbered so that the board is not mirrored and, where the
    print tells its two ends apart (columns + rows odd), so that the first corner is the same in every photo.
    Corners that do not fit the rest are left out.
    """
    found = _find_charuco(grey, board) if board.kind == "charuco" else _find_checkerboard(grey, board)
    if found is None:
        return None
    good = _fits_the_rest(found.pixels, found.points[:, :2], board.square_mm)
    if good.sum() < max(FEWEST_CORNERS, len(good) / 2) or _is_line(found.points[good]):
        return None
    pixels, points = found.pixels[good], found.points[good]
    view = _flat_view(pixels, points[:, :2], board.square_mm)
    return replace(found, pixels=pixels if view is None else _saddles(grey, pixels, view[1]), points=points)


# --- ChArUco ---------------------------------------------------------------------------------------------------------


def _find_charuco(grey: Grey, board: Board) -> Corners | None:
    best: Corners | None = None
    for image, scale in ((grey, 1.0), reduced(grey, THOROUGH_SIZE)):
        for variant in (board, board.transposed()):
            for is_legacy in (False, True):
                found = _detect_charuco(image, variant, is_legacy)
                if found is not None and (best is None or len(found.pixels) > len(best.pixels)):
                    best = replace(found, pixels=(found.pixels + 0.5) / scale - 0.5)
        if scale == 1.0 and best is not None:
            return best
    return best


def _detect_charuco(image: Grey, board: Board, is_legacy: bool) -> Corners | None:
    pixels, ids, _, _ = cv2.aruco.CharucoDetector(board.opencv(is_legacy)).detectBoard(image)
    if ids is None or len(ids) < FEWEST_CORNERS:
        return None
    pixels = np.asarray(pixels, np.float64).reshape(-1, 2)
    return Corners(pixels, board.points()[np.asarray(ids).ravel()], board)


# --- checkerboard ----------------------------------------------------------------------------------------------------


def _find_checkerboard(grey: Grey, board: Board) -> Corners | None:
    grid = _search_checkerboard(grey, board.corner_counts())
    if grid is None:
        return None
    grid = numbered(grey, _refined(grey, grid))
    return Corners(grid.reshape(-1, 2), board.points(), board)


def _search_checkerboard(grey: Grey, counts: tuple[int, int]) -> Float[np.ndarray, "rows columns 2"] | None:
    columns, rows = counts
    classic = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    sectors = cv2.CALIB_CB_NORMALIZE_IMAGE
    for search, size, flags in (
        (cv2.findChessboardCorners, QUICK_SIZE, classic),
        (cv2.findChessboardCornersSB, THOROUGH_SIZE, sectors),
        (cv2.findChessboardCornersSB, EXHAUSTIVE_SIZE, sectors | cv2.CALIB_CB_EXHAUSTIVE),
    ):
        image, scale = reduced(grey, size)
        found, corners = search(image, counts, flags=flags)
        if found:
            return (np.asarray(corners, np.float64).reshape(rows, columns, 2) + 0.5) / scale - 0.5
    return None


def _refined(grey: Grey, grid: Float[np.ndarray, "rows columns 2"]) -> Float[np.ndarray, "rows columns 2"]:
    """The corners moved to the saddle points of the full photo."""
    spacing = min(np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1))
    half = int(np.clip(round(WINDOW_SHARE * spacing), SMALLEST_WINDOW, LARGEST_WINDOW))
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-4)
    start = grid.reshape(-1, 1, 2).astype(np.float32)
    return np.asarray(cv2.cornerSubPix(grey, start, (half, half), (-1, -1), stop), np.float64).reshape(grid.shape)


def numbered(grey: Grey, grid: Float[np.ndarray, "rows columns 2"]) -> Float[np.ndarray, "rows columns 2"]:
    """The grid in the order of the print: seen from its front, first cell dark where that tells its two ends apart."""
    along, down = grid[:, -1].mean(0) - grid[:, 0].mean(0), grid[-1].mean(0) - grid[0].mean(0)
    if along[0] * down[1] - along[1] * down[0] < 0:
        grid = grid[:, ::-1]
    if sum(grid.shape[:2]) % 2 == 1 and _first_cell_is_light(grey, grid):
        grid = grid[::-1, ::-1]
    return np.ascontiguousarray(grid)


def _first_cell_is_light(grey: Grey, grid: Float[np.ndarray, "rows columns 2"]) -> bool:
    """Whether the square between the first four corners is one of the light ones."""
    centres = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    u, v = (np.clip(np.round(centres[..., k]).astype(int), 0, grey.shape[1 - k] - 1) for k in (0, 1))
    levels = cv2.blur(grey, (3, 3))[v, u].astype(float)
    like_first = np.add.outer(np.arange(levels.shape[0]), np.arange(levels.shape[1])) % 2 == 0
    return bool(levels[like_first].mean() > levels[~like_first].mean())


# --- saddle points ---------------------------------------------------------------------------------------------------


def _saddles(
    grey: Grey, pixels: Float[np.ndarray, "n 2"], spacing: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 2"]:
    """Each corner moved to the saddle point of the brightness around it; left as it is where there is none nearby.

    The standard saddle-point fit: a quadratic through the slightly blurred brightness by least squares with Gaussian
    weights, then Newton's step to where its gradient is zero, with the window carried along. The brightness stays as
    the file encodes it: a corner looks the same turned by half, whatever the curve.
    """
    reach = np.maximum(SADDLE_SHARE * spacing, SADDLE_SMALLEST)
    window, corner = _blurred_part(
        grey, pixels, 2 * reach.max(), max(BLUR_SHARE * float(np.median(spacing)), BLUR_SMALLEST)
    )
    steps = np.linspace(-1, 1, SADDLE_SAMPLES)
    x, y = (axis.ravel() for axis in np.meshgrid(steps, steps))
    weight = np.exp(-(x**2 + y**2) / (2 * WEIGHT_WIDTH**2))
    terms = np.stack([x**2, x * y, y**2, x, y, np.ones_like(x)], 1)
    inverse = np.linalg.pinv(terms * weight[:, None]) * weight  # from the samples in the window to the six terms
    at, is_saddle = pixels - corner, np.ones(len(pixels), bool)
    for _ in range(NEWTON_STEPS):
        u, v = ((at[:, k, None] + reach[:, None] * axis).astype(np.float32) for k, axis in enumerate((x, y)))
        values = cv2.remap(window, u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        xx, xy, yy, by_x, by_y, _ = inverse @ np.asarray(values, np.float64).T
        determinant = 4 * xx * yy - xy**2
        is_saddle &= determinant < 0
        step = np.stack([xy * by_y - 2 * yy * by_x, xy * by_x - 2 * xx * by_y], 1)
        step /= np.where(is_saddle, determinant, 1.0)[:, None]
        is_saddle &= np.abs(step).max(1) < 1  # beyond, the quadratic says nothing
        at = at + np.where(is_saddle[:, None], step * reach[:, None], 0.0)
    is_saddle &= np.linalg.norm(at + corner - pixels, axis=1) < reach * FARTHEST_SADDLE
    return np.where(is_saddle[:, None], at + corner, pixels)


def _blurred_part(
    grey: Grey, pixels: Float[np.ndarray, "n 2"], margin: float, blur: float
) -> tuple[Float32[np.ndarray, "rows columns"], Float[np.ndarray, "2"]]:
    """Blurred brightness around the corners, and the pixel where that part begins."""
    first = np.maximum(np.floor(pixels.min(0) - margin - 4 * blur), 0).astype(int)
    last = np.ceil(pixels.max(0) + margin + 4 * blur).astype(int) + 1
    part = grey[first[1] : last[1], first[0] : last[0]].astype(np.float32)
    return np.asarray(cv2.GaussianBlur(part, (0, 0), blur)), first.astype(np.float64)


# --- common ----------------------------------------------------------------------------------------------------------


def reduced(grey: Grey, size: int) -> tuple[Grey, float]:
    """The photo with its longer side at most `size`, and the factor: pixel centres map as (p + 0.5) * factor - 0.5."""
    factor = min(1.0, size / max(grey.shape))
    if factor == 1.0:
        return grey, 1.0
    shape = (round(grey.shape[1] * factor), round(grey.shape[0] * factor))
    return np.asarray(cv2.resize(grey, shape, interpolation=cv2.INTER_AREA)), shape[0] / grey.shape[1]


def _is_line(points: Float[np.ndarray, "n 3"]) -> bool:
    return bool(np.linalg.matrix_rank(points[:, :2] - points[:, :2].mean(0), tol=1e-6) < 2)


def _fits_the_rest(
    pixels: Float[np.ndarray, "n 2"], plane: Float[np.ndarray, "n 2"], square: float
) -> Bool[np.ndarray, " n"]:
    """Which corners agree with a view of a flat board through a smoothly distorting lens, by those that do."""
    view = _flat_view(pixels, plane, square)
    if view is None:
        return np.zeros(len(pixels), bool)
    off = (pixels - view[0]) / view[1][:, None]
    limit = STRAY_PLAIN
    if len(pixels) >= SMOOTH_FROM:
        off, limit = off - _smooth(off, plane), STRAY_SMOOTH
    return np.linalg.norm(off, axis=1) < limit


def _flat_view(
    pixels: Float[np.ndarray, "n 2"], plane: Float[np.ndarray, "n 2"], square: float
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]] | None:
    """The corners as a lens without distortion sees them, and how far the nearer of their neighbours is there, px."""
    matrix, _ = cv2.findHomography(plane, pixels, cv2.LMEDS)
    if matrix is None:
        return None
    view, beside, below = (
        cv2.perspectiveTransform(plane[:, None] + [np.multiply(step, square)], matrix)[:, 0]
        for step in ((0, 0), (1, 0), (0, 1))
    )
    return view, np.minimum(np.linalg.norm(beside - view, axis=1), np.linalg.norm(below - view, axis=1))


def _smooth(values: Float[np.ndarray, "n 2"], plane: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """A cubic in board coordinates through the values, few of which may be wild (weights of Cauchy's loss)."""
    x, y = ((plane - plane.mean(0)) / plane.std(0).max()).T
    terms = np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], 1)
    weights = np.ones(len(values))
    fitted = np.zeros_like(values)
    for _ in range(10):
        root = np.sqrt(weights)[:, None]
        fitted = terms @ np.linalg.lstsq(terms * root, values * root, rcond=None)[0]
        distance = np.linalg.norm(values - fitted, axis=1)
        weights = 1 / (1 + (distance / max(2 * np.median(distance), 1e-6)) ** 2)
    return fitted
