"""Refine the corners of printed squares: fit the blurred picture of two crossing edges to the pixels around each."""

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from scipy.special import ndtr

from capture.checks.robust import cauchy, spread

ROUNDS = 10  # at most; four to six are usual
STILL = 0.003  # px: a round that moves no corner farther is the last
WINDOW, LONGEST = 0.7, 48.0  # of a square, and px, to each side: clear of the next corner, and long enough
NEIGHBOURS = 16  # corners that tell how the board lies around one: a lens bends little over so few
FIRST_BLUR = 1.0  # px, sigma: as far as corners are off at first; then the picture tells its own
SHARPEST = 0.3  # px, sigma: a pixel is as wide
NEAR, EDGE = 2.0, 4.0  # px, and sigmas of the blur: pixels farther from both edges say nothing of them
CUT = 3.0  # robust standard deviations from which a pixel counts less
FARTHEST = 0.25  # of a square, in all rounds: beyond, it is something else
NARROWEST = 3.0  # px beside an edge: a blurred edge takes this much room, whatever the squares' size
FEWEST = 60  # pixels, for ten unknowns
SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])

Pixels = Float[np.ndarray, " pixels"]


def fitted_corners(
    grey: UInt8[np.ndarray, "height width"],
    pixels: Float[np.ndarray, "n 2"],
    squares: Float[np.ndarray, "n 2"],
    arm: float,
) -> Float[np.ndarray, "n 2"]:
    """Return the corners (px) as the pixels within most of a square show them; one that they do not show stays.

    A corner is where two edges between light and dark cross. Both, blurred by a Gaussian, are fitted by least squares:
    place, contrast, a gradient of the light, how far the dark squares reach beyond their edges (ink, tone curve), and
    the blur, which the corners share. Long edges tell more than the few pixels about the corner.

    Args:
        pixels: where the corners are within two pixels or so.
        squares: the same on the board, in squares.
        arm: of a square: what lies within it of an edge shows the two squares alone, no marker.
    """
    apart = np.linalg.norm(squares[:, None] - squares, axis=-1)
    apart[np.diag_indices(len(apart))] = np.inf
    beside = apart.argmin(1)
    side = np.linalg.norm(pixels[beside] - pixels, axis=1) / apart.min(1)
    windows, blur, found = np.minimum(WINDOW, LONGEST / side), FIRST_BLUR, pixels
    for _ in range(ROUNDS):
        before, found, blurs = found, found.copy(), []
        for k, window in enumerate(windows):
            near = np.append(k, apart[k].argsort(kind="stable")[: NEIGHBOURS - 1])
            view = cv2.findHomography(before[near], squares[near] - squares[k], 0)[0]
            fit = None if view is None else _fit_corner(grey, view, float(window), arm, blur)
            if fit is not None:
                found[k], own = fit
                blurs.append(own)
        blur = float(np.median(blurs)) if blurs else blur
        if np.abs(found - before).max() < STILL:
            break
    strayed = np.linalg.norm(found - pixels, axis=1) > FARTHEST * side
    return np.where(strayed[:, None], pixels, found)


def _fit_corner(
    grey: UInt8[np.ndarray, "height width"], view: Float[np.ndarray, "3 3"], window: float, arm: float, blur: float
) -> tuple[Float[np.ndarray, "2"], float] | None:
    """Return where a corner is and how wide the blur is there, px; None where too few pixels show it.

    Args:
        view: homography from pixels to squares beside the corner.
    """
    around = cv2.perspectiveTransform(window * SQUARE[None], np.linalg.inv(view))[0]
    low, high = np.maximum(np.floor(around.min(0)), 0).astype(int), np.ceil(around.max(0)).astype(int) + 1
    part = grey[low[1] : high[1], low[0] : high[0]]
    y, x = np.indices(part.shape).reshape(2, -1)
    at = np.stack([x + low[0], y + low[1], np.ones_like(x)], 1)
    seen = at @ view.T
    place = seen[:, :2] / seen[:, 2:]
    lines = view[:2] / np.linalg.norm(view[:2, :2], axis=1, keepdims=True)
    offset = at @ lines.T  # px from either edge
    beside = np.abs(offset).min(1)
    chosen = (np.abs(place).max(1) < window) & (seen[:, 2] > 0) & (beside < NEAR + EDGE * blur)
    chosen &= (np.abs(place).min(1) < arm) | (beside < NARROWEST)
    if chosen.sum() < FEWEST:
        return None
    values, (first, second) = part.ravel()[chosen].astype(float), offset[chosen].T
    by_first, by_second, wider = _fit_edges(
        values, first, second, float(lines[0, :2] @ lines[1, :2]), blur, place[chosen]
    )
    corner = np.linalg.solve(lines[:, :2], [by_first, by_second] - lines[:, 2])
    return corner, max(blur + wider, blur / 2, SHARPEST)


def _fit_edges(
    values: Pixels, first: Pixels, second: Pixels, together: float, blur: float, place: Float[np.ndarray, "pixels 2"]
) -> Float[np.ndarray, "3"]:
    """Return how far the two edges have to move (px, along their normals), and what the blur has to grow (px)."""
    picture, by_first, by_second = _crossing_edges(first / blur, second / blur, together)
    wider = -(first * by_first + second * by_second) / blur**2
    by = [-by_first / blur, -by_second / blur, wider]
    ink = by[0] * np.sign(second) + by[1] * np.sign(first)
    light = np.column_stack([np.ones_like(values), place])
    terms = np.column_stack([*by, ink, picture[:, None] * light, light])
    found, weight = np.zeros(terms.shape[1]), np.ones_like(values)
    for _ in range(2):
        weighted = (terms * weight[:, None]).T
        found = np.linalg.lstsq(weighted @ terms, weighted @ values, rcond=None)[0]
        off = values - terms @ found
        weight = cauchy((off / (CUT * max(spread(off), 1e-6))) ** 2)
    return found[:3] / found[4]


def _crossing_edges(first: Pixels, second: Pixels, together: float) -> tuple[Pixels, Pixels, Pixels]:
    """Return the product of two blurred steps from -1 to 1, and its derivatives by both distances.

    E[sign(a) sign(b)] of normal a, b of unit variance about these distances, whose correlation is `together`: Mehler's
    series, to its fourth term.

    Args:
        first, second: distances from the edges in sigmas of the blur.
    """
    bell, other = (2 * np.exp(-(d**2) / 2) / np.sqrt(2 * np.pi) for d in (first, second))
    third = (first**3 - 3 * first) * (second**3 - 3 * second) / 24
    series = (1.0, first * second / 2, (first**2 - 1) * (second**2 - 1) / 6, third)
    product = (2 * ndtr(first) - 1) * (2 * ndtr(second) - 1)
    product = product + bell * other * sum(together ** (n + 1) * term for n, term in enumerate(series))
    rest = np.sqrt(1 - together**2)
    by_first = bell * (2 * ndtr((second - together * first) / rest) - 1)
    return product, by_first, other * (2 * ndtr((first - together * second) / rest) - 1)
