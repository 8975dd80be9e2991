"""How sharp each photo's edges are: shake shows without texture, too, on plain tables and along the grain of wood."""

import cv2
import numpy as np
from jaxtyping import Float

from capture.checks.robust import column_quantile

SIDE = 640  # px: the long side of the pictures that are looked at; those much smaller than that show no shake
LEAST_SIDE = 480
WAYS = ((0, 1), (1, 1), (1, 0), (1, -1))  # in the picture, rows and columns of a step along each
STRAIGHT, OBLIQUE = 6, 4  # such steps to both sides of an edge, between which all of it lies
EDGE = 0.35  # log brightness across an edge, from which it counts
DARKEST = 0.03  # of white, in the picture: darker regions are noise
FEWEST = 0.001  # of the picture: pixels at edges across one way that tell how sharp these are
SHARPEST = 95  # percentile of these: shadows' edges are soft, the object's are not
SOFTEST = 2  # ways that are asked: shake smears the edges across one way, and some across the next
SMEARED = 0.76  # of the usual; shaken photos gave 0.58 to 0.75 (32 of 32), good ones 0.77 and more (all but 4 of 327)


def edge_sharpness(brightness: list[Float[np.ndarray, "height width"]]) -> Float[np.ndarray, " photos"]:
    """Return how steep the sharpest edges of each photo are, over the usual, across the ways in which they are softest.

    Steep: the step of log brightness over two pixels, as a share of that across the whole edge. NaN where too few edges
    lie across two ways, and for pictures too small to show it.

    Args:
        brightness: linear, of photos by one camera.
    """
    size = max(brightness[0].shape)
    if size < LEAST_SIDE:
        return np.full(len(brightness), np.nan)
    steep = np.array([_steepness(one, min(SIDE / size, 1.0)) for one in brightness])
    relative = steep / column_quantile(steep, 0.5)
    return np.sort(relative, axis=1)[:, :SOFTEST].mean(1)


def _steepness(brightness: Float[np.ndarray, "height width"], scale: float) -> Float[np.ndarray, " ways"]:
    """Return the steepness of the sharpest edges across each way; NaN where there are too few."""
    grey = cv2.resize(brightness.astype(np.float32), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    grey = np.maximum(grey, 0) / max(float(np.percentile(grey, 99)), 1e-9)
    picture = np.log(grey ** (1 / 2.2) + DARKEST)
    inner = tuple(slice(STRAIGHT + 1, n - STRAIGHT - 1) for n in picture.shape)

    def step(way: tuple[int, int], n: int) -> Float[np.ndarray, "rows columns"]:
        ahead, behind = (np.roll(picture, (sign * n * way[0], sign * n * way[1]), (0, 1))[inner] for sign in (-1, 1))
        return np.abs(ahead - behind)

    whole = np.array([step(way, OBLIQUE if way[0] * way[1] else STRAIGHT) for way in WAYS])
    across, found = whole.argmax(0), np.full(len(WAYS), np.nan)
    for number, way in enumerate(WAYS):
        edge = (across == number) & (whole[number] > EDGE)
        if edge.sum() >= FEWEST * picture.size:
            found[number] = np.percentile(step(way, 1)[edge] / whole[number][edge], SHARPEST)
    return found
