"""Find a blank sheet or card in one photo, and points on its edges with subpixel accuracy.

Regions that stand out from the table give quadrilaterals. Along each side of one, the brightness across the edge is
read at many places; a line through its steepest points, robust against outliers, gives one point per stretch of edge.
No corner is measured: corners are worn, rounded or curled, and an edge has a hundred times as many pixels.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from scipy import ndimage

from calibration.board.board import Blank
from capture.checks.robust import cauchy, reweighted_fit
from capture.decode.exif import ORDINARY_FOCAL_35MM, focal_in_pixels
from capture.photos.photo import decode_srgb, smaller

Light = Float32[np.ndarray, "height width"]
Quad = Float[np.ndarray, "4 2"]
SEARCH_PX = 1000  # longer side of the copy in which the sheet is searched
SMALLEST = 0.004  # of the picture: a card among the things on a table
LEVELS = np.linspace(0.1, 0.9, 13)  # of the brightness, between its 1st and 99th percentile
CANNY = (20, 60)  # low: a white card on a pale table
STRAIGHT = 0.02  # of the circumference: how far an outline may leave its quadrilateral
FILLS = 0.94  # of its quadrilateral, which the hull of a region takes
FRAME_PX = 3  # a region so near to the frame may go on outside
ACROSS_PX = 12.0  # to either side of the edge of a quadrilateral, where the real edge is searched
FINE_PX = 2.5  # to either side of an edge that was found, in px of the copy
STEP_PX = 0.5  # of the samples across an edge
SLOPE_PX = 1.0  # sigma of the blur before the slope is taken
MARGIN_PX = 3.0  # that this blur needs
PLACES = 24  # on the stretch of edge around each point
STRETCH = 0.42  # of the spacing, to either side of a point
OFF_LINE_PX = 0.7  # places farther off the line through the others do not count
AGREEING = 0.6  # of the places
LEAST_STEP = 0.02  # of white: less is no edge
LINE_ROUNDS = 6
WELL_SEEN = 0.6  # of the points of the edges
PER_SIDE = 3  # points, at least: less of a side is no line
FOCALS_35MM = np.geomspace(18.0, 80.0, 24)
FOCAL_SIGMA = 0.5  # of the log
RATIO_SIGMA, SQUARE_SIGMA = 0.05, 0.03  # of the log of the sides' ratio, and of the cosine between the sides
MISFIT = 20.0  # chi-square from which a quadrilateral is no view of the sheet, nor of another paper


@dataclass(frozen=True, eq=False)
class SheetEdges:
    """Points of a sheet's edges in a photo."""

    pixels: Float[np.ndarray, "n 2"]
    across: Float[np.ndarray, "n 2"]  # unit vectors out of the sheet, px
    points: Float[np.ndarray, "n 3"]  # world, mm
    reach: Float[np.ndarray, " n"]  # px, half the stretch of edge that each stands for

    def part(self, seen: Bool[np.ndarray, " n"]) -> "SheetEdges":
        """Return some of the points."""
        return SheetEdges(self.pixels[seen], self.across[seen], self.points[seen], self.reach[seen])

    def enlarged(self, scale: float) -> "SheetEdges":
        """Return the points in a photo `scale` times as large."""
        return SheetEdges((self.pixels + 0.5) * scale - 0.5, self.across, self.points, self.reach * scale)


def find_edges(grey: UInt8[np.ndarray, "height width"], blank: Blank) -> SheetEdges | None:
    """Find a blank sheet's edges in an sRGB-encoded photo; None if there is no such sheet.

    Its two ends look alike: the long side points to the right.
    """
    small = smaller(grey, SEARCH_PX)
    size = small.shape[::-1]
    light = decode_srgb(small)
    best: tuple[float, SheetEdges] | None = None
    for quad in _distinct(_quads(small)):
        misfit, turned = _as_sheet(quad, size, blank)
        if misfit > MISFIT:
            continue
        guess = _along_quad(turned, blank)
        wide = min(ACROSS_PX, float(np.linalg.norm(quad - np.roll(quad, 1, axis=0), axis=1).min()) / 8)
        found, _ = _on_edges(light, guess, wide)
        found, seen = _on_edges(light, found, wide / 3)
        score = seen.mean() - 0.3 * misfit / MISFIT
        if _is_enough(seen, blank) and (best is None or score > best[0]):
            best = score, found
    if best is None:
        return None
    enlarge = grey.shape[1] / size[0]
    light = decode_srgb(grey)
    found, _ = _on_edges(light, best[1].enlarged(enlarge), FINE_PX * enlarge)
    found, seen = _on_edges(light, found, FINE_PX + enlarge)
    return found.part(seen) if _is_enough(seen, blank) else None


# --- quadrilaterals ---------------------------------------------------------------------------------------------------


def _quads(small: UInt8[np.ndarray, "height width"]) -> Iterator[Quad]:
    """Yield quadrilaterals around regions that are brighter or darker than around, or enclosed by edges."""
    smooth = np.asarray(cv2.GaussianBlur(small, (0, 0), 1.5))
    low, high = np.percentile(smooth, (1, 99))
    for share in LEVELS:
        bright = (smooth > low + share * (high - low)).astype(np.uint8)
        for region in (bright, 1 - bright):
            yield from _around(region)
    edges = np.asarray(cv2.dilate(cv2.Canny(smooth, *CANNY), np.ones((3, 3), np.uint8)))
    yield from _around(edges)
    yield from _around((edges == 0).astype(np.uint8))


def _around(region: UInt8[np.ndarray, "height width"]) -> Iterator[Quad]:
    height, width = region.shape
    for outline in cv2.findContours(region, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]:
        left, top, wide, high = cv2.boundingRect(outline)
        if wide * high < SMALLEST * width * height or min(left, top) < FRAME_PX:
            continue
        if left + wide > width - FRAME_PX or top + high > height - FRAME_PX:
            continue
        hull = cv2.convexHull(outline)
        quad = cv2.approxPolyDP(hull, STRAIGHT * cv2.arcLength(hull, True), True)[:, 0].astype(float)
        area = cv2.contourArea(hull)
        if len(quad) != 4 or area < SMALLEST * width * height:
            continue
        if area >= FILLS * cv2.contourArea(quad.astype(np.float32)):
            yield quad


def _distinct(quads: Iterator[Quad]) -> list[Quad]:
    """Return the quadrilaterals clockwise as seen, each once."""
    kept: list[Quad] = []
    for quad in quads:
        turn = np.cross(np.append(quad[1] - quad[0], 0), np.append(quad[2] - quad[1], 0))[2]
        ordered = quad if turn > 0 else quad[::-1]
        ordered = np.roll(ordered, -int(np.argmin(ordered.sum(1))), axis=0)
        if all(np.abs(ordered - other).max() > ACROSS_PX / 4 for other in kept):
            kept.append(ordered)
    return kept


def _as_sheet(quad: Quad, size: tuple[int, int], blank: Blank) -> tuple[float, Quad]:
    """Return how badly a quadrilateral is a view of the sheet (chi-square), and its corners in the sheet's order.

    For each focal length that lenses have, the columns of the homography give the ratio of the sides and the angle
    between them (Zhang 2000, section 2.2).
    """
    middle = (np.array(size, float) - 1) / 2
    prior = (np.log(FOCALS_35MM / ORDINARY_FOCAL_35MM) / FOCAL_SIGMA) ** 2
    shrink = np.stack([1 / (FOCALS_35MM * focal_in_pixels(1.0, *size))] * 2 + [np.ones(len(FOCALS_35MM))], 1)
    options: list[tuple[float, Quad]] = []
    for turn in range(4):
        turned = np.roll(quad, -turn, axis=0)
        x, y = (shrink * axis for axis in _plane_to_photo(blank, turned - middle)[:, :2].T)
        long, short = np.linalg.norm(x, axis=1), np.linalg.norm(y, axis=1)
        cosine = (x * y).sum(1) / (long * short)
        cost = prior + (np.log(long / short) / RATIO_SIGMA) ** 2 + (cosine / SQUARE_SIGMA) ** 2
        to_the_left = 1e-6 * (turned[1, 0] < turned[0, 0])  # decides between the two ends
        options.append((float(cost.min()) + to_the_left, turned))
    return min(options, key=lambda option: option[0])


def _plane_to_photo(blank: Blank, quad: Quad) -> Float[np.ndarray, "3 3"]:
    corners = blank.corners().astype(np.float32)
    return np.asarray(cv2.getPerspectiveTransform(corners, quad.astype(np.float32)), float)


# --- edges ------------------------------------------------------------------------------------------------------------


def _along_quad(quad: Quad, blank: Blank) -> SheetEdges:
    """Return where the points of the edges lie if the sheet is this quadrilateral."""
    matrix, points, outward = _plane_to_photo(blank, quad), blank.points(), blank.outward()
    half = STRETCH * blank.spacing() * np.stack([-outward[:, 1], outward[:, 0]], 1)
    at, first, last, outside = (
        np.asarray(cv2.perspectiveTransform((points[:, :2] + step)[:, None], matrix))[:, 0]
        for step in (np.zeros(2), -half, half, outward)
    )
    along = last - first
    length = np.linalg.norm(along, axis=1)
    across = np.stack([along[:, 1], -along[:, 0]], 1) / length[:, None]
    across *= np.sign((across * (outside - at)).sum(1, keepdims=True))
    return SheetEdges(at, across, points, length / 2)


def _on_edges(light: Light, guess: SheetEdges, wide: float) -> tuple[SheetEdges, Bool[np.ndarray, " n"]]:
    """Move points to the edge within `wide` px across it; also return which of them have an edge there."""
    steps = np.arange(-wide - MARGIN_PX, wide + MARGIN_PX + STEP_PX, STEP_PX)
    shares = np.linspace(-1, 1, PLACES)
    along = np.stack([-guess.across[:, 1], guess.across[:, 0]], 1) * guess.reach[:, None]
    places = guess.pixels[:, None] + shares[:, None] * along[:, None]
    samples = (places[:, :, None] + steps[:, None] * guess.across[:, None, None]).astype(np.float32)
    u, v = (samples[..., k].reshape(len(samples), -1) for k in (0, 1))
    values = np.asarray(cv2.remap(light, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
    values = values.reshape(samples.shape[:3]).astype(np.float64)
    slope = ndimage.gaussian_filter1d(values, SLOPE_PX / STEP_PX, axis=-1, order=1)
    slope = slope[..., round(MARGIN_PX / STEP_PX) : -round(MARGIN_PX / STEP_PX)]
    is_bright = -slope.min(-1).mean() > slope.max(-1).mean()
    height = np.sqrt(2 * np.pi) * SLOPE_PX / STEP_PX * (-slope if is_bright else slope)  # of a step with this slope
    top = np.clip(height.argmax(-1), 1, height.shape[-1] - 2)[..., None]
    left, peak, right = (np.take_along_axis(height, top + k, -1)[..., 0] for k in (-1, 0, 1))
    bend = np.minimum(left - 2 * peak + right, -1e-9)
    offsets = steps[round(MARGIN_PX / STEP_PX) :][top[..., 0]] + STEP_PX * np.clip(0.5 * (left - right) / bend, -1, 1)
    level, slant, agrees = _lines(offsets, shares)
    seen = (agrees & (peak > LEAST_STEP)).mean(1) >= AGREEING
    turned = guess.across - (slant / guess.reach)[:, None] * along / guess.reach[:, None]
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    return SheetEdges(guess.pixels + level[:, None] * guess.across, turned, guess.points, guess.reach), seen


def _lines(
    offsets: Float[np.ndarray, "n places"], shares: Float[np.ndarray, " places"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Bool[np.ndarray, "n places"]]:
    """Fit a line to each row (weights of Cauchy's loss); return its level, its slope and which places agree."""
    basis = np.stack([np.ones_like(shares), shares], 1)
    start = np.broadcast_to(np.median(offsets, axis=1, keepdims=True), offsets.shape)
    lines = reweighted_fit(basis, offsets, lambda off: cauchy((off / OFF_LINE_PX) ** 2), LINE_ROUNDS, start)
    return lines[:, 0], lines[:, 1], np.abs(offsets - lines @ basis.T) < OFF_LINE_PX


def _is_enough(seen: Bool[np.ndarray, " n"], blank: Blank) -> bool:
    sides = np.array([np.count_nonzero(seen[blank.side_of_points() == k]) for k in range(4)])
    return bool(seen.mean() >= WELL_SEEN and sides.min() >= PER_SIDE)
