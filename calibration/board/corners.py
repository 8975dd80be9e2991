"""Find the corners of a printed board in one photo with subpixel accuracy."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from calibration.board.board import AnyBoard, Blank, Board, opencv_dictionary
from calibration.board.corner_fit import fitted_corners
from calibration.board.lattice import find_lattices, flat_view
from calibration.board.placement import place, placed_markers
from calibration.board.sheet_edges import find_edges
from capture.checks.robust import cauchy, reweighted_fit
from capture.photos.photo import Photo, encode_srgb, read_photo, smaller

Grey = UInt8[np.ndarray, "_ _"]  # height, width; a reduced copy may stand beside the photo in one signature
Markers = tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 4 2"]]

BRIGHT_SHARE = 99.5  # per cent of the values that may not exceed white when a dark photo is lifted
FEWEST_CORNERS = 6  # four fix the plane's eight numbers exactly; below two more, a wrong corner goes unnoticed
SEARCH_SIZES = (1000, 500, 2000)  # px, longer side: most boards; blurred ones; small ones in a large photo
MARKER_SIZE = 1500  # px, longer side: markers are read there, and in the whole photo
ENOUGH_OF_BOARD = 0.6  # of its corners: no further size is tried, and no marker read
MOSTLY_GOOD = 0.75  # of a lattice's corners fit the others; a lattice over clutter has half
TO_THE_MARKER = 0.8  # of the way from an edge of a square to its marker: blur brings that nearer
WIDEST_ARM = 0.2  # of a square: what is farther from an edge says nothing of it
SMOOTH_FROM = {3: 20, 2: 12}  # fewest corners for a cubic, a quadratic to separate lens distortion from wrong corners
STRAY = {3: 0.06, 2: 0.08, 0: 0.25}  # of the spacing: how far a corner may be off that, and off no model of distortion
SMOOTH_ROUNDS = 10  # of reweighting
MOST_PHOTOS = 8  # evenly chosen: each is read whole, and more change the median little
FEWEST_ALIKE = 3  # photos, whose median leaves out what one of them hides


@dataclass(frozen=True)
class Corners:
    """Where points of a board were seen: pixels[i] is the photo's view of points[i].

    Corners of its squares, and middles of markers, which are seen as precisely: nothing that follows tells them apart.
    """

    pixels: Float[np.ndarray, "n 2"]
    points: Float[np.ndarray, "n 3"]  # world, mm: on the printed side, z = 0
    board: AnyBoard  # as matched: columns and rows may be exchanged against the request
    is_placed: bool = True  # False: seen in part, and numbered from some corner; the plane is right, its origin is not
    across: Float[np.ndarray, "n 2"] | None = None  # unit vectors, px: points of edges were measured along these only

    def part(self, chosen: slice) -> "Corners":
        """Return some of the corners."""
        across = None if self.across is None else self.across[chosen]
        return replace(self, pixels=self.pixels[chosen], points=self.points[chosen], across=across)

    def measured(
        self, offsets: Float[np.ndarray, "n 2"], jacobian: Float[np.ndarray, "rows columns"]
    ) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "rows columns"]]:
        """Return of offsets (px) and their derivatives what was measured: that across the edge, of points of edges."""
        if self.across is None:
            return offsets, jacobian
        by_point = jacobian.reshape(len(offsets), 2, -1)
        slopes = self.across[..., None] * (self.across[..., None] * by_point).sum(1, keepdims=True)
        return self.across * (self.across * offsets).sum(1, keepdims=True), slopes.reshape(jacobian.shape)


def find_board(grey: Grey, board: AnyBoard, allow_part: bool = False) -> Corners | None:
    """Find the corners of this board in a photo, in its pixels; None if too little of the board is seen.

    Of a blank sheet or a card, points on its edges are found instead.

    Both orders of columns and rows and both generations of the ChArUco pattern are tried. A part of the board is
    enough, but a checkerboard with a whole row or column hidden cannot be numbered and needs allow_part. The numbering
    does not mirror the board. Where the print distinguishes its two ends, the first corner is the same in every photo.
    Corners that do not fit the others are left out. Where few corners of a ChArUco board are seen, the middles of its
    markers are points of the board too: something may cover all but a frame of it.
    """
    if isinstance(board, Blank):
        edges = find_edges(grey, board)
        return None if edges is None else Corners(edges.pixels, edges.points, board, True, edges.across)
    enough = len(board.points()) * ENOUGH_OF_BOARD
    best = _by_lattice(grey, board, allow_part, enough)
    is_enough = best is not None and best.is_placed and len(best.pixels) >= enough
    return best if is_enough or board.kind != "charuco" else _with_markers(best, grey, board)


def _by_lattice(grey: Grey, board: Board, allow_part: bool, enough: float) -> Corners | None:
    """Find corners of squares; no further size of the photo is searched once this many are found."""
    best: Corners | None = None
    for image, scale in _levels(grey):
        for found in _placed(image, scale, board, allow_part):
            if best is None or (found.is_placed, len(found.pixels)) > (best.is_placed, len(best.pixels)):
                best = found
        if best is not None and best.is_placed and len(best.pixels) >= enough:
            break
    if best is None:
        return None
    arm = min(WIDEST_ARM, TO_THE_MARKER * (1 - board.marker_mm / board.square_mm) / 2)
    return replace(best, pixels=fitted_corners(grey, best.pixels, best.points[:, :2] / board.square_mm, arm))


def grey_of(photo: Photo) -> Grey:
    """Return the photo as corner detectors need it: 8-bit, sRGB-encoded, a dark photo stretched to full range."""
    bright = float(np.percentile(photo.rgb[::8, ::8], BRIGHT_SHARE))
    lifted = photo.rgb / np.float32(min(max(bright, 1e-3), 1.0))
    return np.asarray(cv2.cvtColor(encode_srgb(lifted), cv2.COLOR_RGB2GRAY))


def _levels(grey: Grey) -> Iterator[tuple[Float32[np.ndarray, "height width"], float]]:
    """Yield the photo at each size of the corner search that it has, and the scale factor."""
    seen: set[float] = set()
    for size in SEARCH_SIZES:
        image, scale = reduced(grey, size)
        if scale not in seen:
            yield image.astype(np.float32), scale
        seen.add(scale)


def _placed(
    image: Float32[np.ndarray, "height width"], scale: float, board: Board, allow_part: bool
) -> Iterator[Corners]:
    """Yield every lattice that can be this board: its mutually consistent corners, in pixels of the full photo."""
    for lattice in find_lattices(image, FEWEST_CORNERS, len(board.points())):
        placement = place(lattice, image, board)
        if placement is None or not (placement.is_placed or allow_part):
            continue
        columns, _ = placement.board.corner_counts()
        index = placement.corners[:, 0] + columns * placement.corners[:, 1]
        order = np.argsort(index)
        points = placement.board.points()[index[order]]
        pixels = (lattice.pixels[placement.used[order]] + 0.5) / scale - 0.5
        good = _fits_the_rest(pixels, points[:, :2], board.square_mm)
        spans_plane = np.linalg.matrix_rank(points[good, :2] - points[good, :2].mean(0), tol=1e-6) == 2
        if good.sum() >= max(FEWEST_CORNERS, MOSTLY_GOOD * len(good)) and spans_plane:
            yield Corners(pixels[good], points[good], placement.board, placement.is_placed)


def _with_markers(found: Corners | None, grey: Grey, board: Board) -> Corners | None:
    """Return the corners with the middles of the markers that are read; as they were, if these are too few."""
    placed = placed_markers(*read_markers(grey, board.dictionary), board)
    if placed is None:
        return found
    variant, pixels, points = placed
    if found is not None and found.is_placed and found.board == variant:
        pixels, points = np.concatenate([found.pixels, pixels]), np.concatenate([found.points, points])
    good = _fits_the_rest(pixels, points[:, :2], board.square_mm)
    if good.sum() < MOSTLY_GOOD * len(good) or (found is not None and good.sum() <= len(found.pixels)):
        return found
    return Corners(pixels[good], points[good], variant)


def read_markers(grey: Grey, dictionary: str) -> Markers:
    """Return the number and the four corners (px) of every marker of this dictionary that OpenCV reads."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_CONTOUR  # .1 px; two to six times that without
    detector = cv2.aruco.ArucoDetector(opencv_dictionary(dictionary), parameters)
    whole = max(grey.shape)
    read: dict[int, Float[np.ndarray, "4 2"]] = {}
    for size in sorted({min(MARKER_SIZE, whole), whole}):
        image, scale = reduced(grey, size)
        quads, ids, _ = detector.detectMarkers(image)
        for number, quad in zip([] if ids is None else np.ravel(ids).tolist(), quads, strict=True):
            corners = np.asarray(quad, float).reshape(4, 2)
            outward = corners - corners.mean(0)  # OpenCV's outline runs through the outermost black pixels,
            corners += np.sqrt(0.5) * outward / np.linalg.norm(outward, axis=1, keepdims=True)  # half a pixel inside
            read[number] = (corners + 0.5) / scale - 0.5
    return np.array(list(read), int), np.array(list(read.values())).reshape(-1, 4, 2)


# --- common ----------------------------------------------------------------------------------------------------------


def reduced(grey: Grey, size: int) -> tuple[Grey, float]:
    """Shrink the photo to a longer side of at most `size`; return it and the factor.

    Pixel centres map as (p + 0.5) * factor - 0.5.
    """
    image = smaller(grey, size)
    return image, image.shape[1] / grey.shape[1]


def _fits_the_rest(
    pixels: Float[np.ndarray, "n 2"], plane: Float[np.ndarray, "n 2"], square: float
) -> Bool[np.ndarray, " n"]:
    """Return which corners agree with a robustly fitted view of a flat board through a smoothly distorting lens."""
    view = _flat_view(pixels, plane, square)
    if view is None:
        return np.zeros(len(pixels), bool)
    off = (pixels - view[0]) / view[1][:, None]
    degree = next((degree for degree, fewest in SMOOTH_FROM.items() if len(pixels) >= fewest), 0)
    if degree:
        off = off - _smooth(off, plane, degree)
    return np.linalg.norm(off, axis=1) < STRAY[degree]


def _flat_view(
    pixels: Float[np.ndarray, "n 2"], plane: Float[np.ndarray, "n 2"], square: float
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]] | None:
    """Return the corners as seen without distortion, and the distance to the nearer of their neighbours, px."""
    matrix = flat_view(plane, pixels)
    if matrix is None:
        return None
    view, beside, below = (
        cv2.perspectiveTransform(plane[:, None] + [np.multiply(step, square)], matrix)[:, 0]
        for step in ((0, 0), (1, 0), (0, 1))
    )
    return view, np.minimum(np.linalg.norm(beside - view, axis=1), np.linalg.norm(below - view, axis=1))


def _smooth(values: Float[np.ndarray, "n 2"], plane: Float[np.ndarray, "n 2"], degree: int) -> Float[np.ndarray, "n 2"]:
    """Fit a polynomial in board coordinates to offsets (squares) with a few outliers (weights of Cauchy's loss).

    A wide lens bends a board by a square: what the other corners leave open, a stray one does not decide.
    """
    x, y = ((plane - plane.mean(0)) / plane.std(0).max()).T
    terms = np.stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)], 1)

    def weigh(off: Float[np.ndarray, "2 n"]) -> Float[np.ndarray, " n"]:
        distance = np.linalg.norm(off, axis=0)  # at first from the flat view, which no stray corner bends
        return cauchy((distance / max(2 * np.median(distance), 1e-6)) ** 2)

    start = np.zeros(values.T.shape)
    return terms @ reweighted_fit(terms, values.T, weigh, SMOOTH_ROUNDS, start, STRAY[degree] ** 2).T


def under_the_flashlight(lit: Sequence[Path], board: AnyBoard) -> tuple[Grey, float | None, Corners] | None:
    """Return what photos under the flashlight usually show, a focal length by EXIF, and the corners seen in it.

    For a tripod without a photo of the board in room light. All photos are from one place: shadows and occluders move,
    and the median over the photos has none.

    None where there are fewer than FEWEST_ALIKE photos, or they do not show the board.
    """
    chosen = [lit[i] for i in np.unique(np.linspace(0, len(lit) - 1, MOST_PHOTOS).round().astype(int))] if lit else []
    if len(chosen) < FEWEST_ALIKE:
        return None
    greys, focal = [], None
    for path in chosen:
        photo = read_photo(path)
        greys.append(grey_of(photo))
        focal = focal or photo.focal_35mm
    stack = np.stack(greys)
    stack.partition(len(stack) // 2, axis=0)
    usual = stack[len(stack) // 2]
    corners = find_board(usual, board)
    if corners is None or not corners.is_placed or corners.across is not None:
        return None
    return usual, focal, corners
