"""Saddle points of brightness: where four squares of a print meet."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32

BLUR = 1.5  # px: sigma before second derivatives; noise of 3 % leaves, squares of 7 px remain
SURROUNDINGS = 31  # px: contrast is judged against the spread of brightness in a square this wide
FAINTEST = 1.0  # grey levels: strength of a corner of 5 levels of contrast
ABOVE_NOISE = 6.0  # times the spread of the second derivatives over the photo, of which most is flat
MEDIAN_OF_NORMAL = 0.6745  # of its absolute value, in sigmas
WEAKEST = 0.1  # strength in units of that spread: 99 of 100 corners of hard photos have 0.16 or more
RINGS, RING_SAMPLES = (2.5, 4.0), 16  # px, around a point: there a corner looks the same turned by half
SYMMETRY = 3.0  # what stays under that turn, over what does not: 19 of 20 corners have 8, edges and noise 1.6
LONGEST_STEP = 1.5  # px, from the strongest pixel to the saddle
MOST_POINTS = 800  # the strongest; a cluttered photo of 1000 px has some hundreds
REMAP_ROW = 1024  # places per row of a table: OpenCV looks up no more than 32 767 rows or columns


@dataclass(frozen=True, eq=False)
class SaddlePoints:
    """Points where brightness has a saddle."""

    pixels: Float[np.ndarray, "n 2"]
    strength: Float[np.ndarray, " n"]  # in units of the spread of brightness around
    light: Float[np.ndarray, "n 2"]  # unit direction towards the two light squares


def saddle_points(image: Float32[np.ndarray, "height width"]) -> SaddlePoints:
    """Find saddles of the slightly blurred brightness that stand out from their surroundings.

    Strength is sqrt(-det Hessian) sigma^2; an ideal corner of contrast C has C / pi.
    """
    blurred = cv2.GaussianBlur(image, (0, 0), BLUR)
    xx, yy, xy = (cv2.Sobel(blurred, cv2.CV_32F, i, j, ksize=3, scale=0.25) for i, j in ((2, 0), (0, 2), (1, 1)))
    response = np.sqrt(np.maximum(xy * xy - xx * yy, 0)) * np.float32(BLUR**2)
    window = (SURROUNDINGS, SURROUNDINGS)
    mean, square = cv2.blur(blurred, window), cv2.blur(blurred * blurred, window)
    strength = response / (np.sqrt(np.maximum(square - mean * mean, 0)) + FAINTEST)
    faintest = max(FAINTEST, ABOVE_NOISE * BLUR**2 * float(np.median(np.abs(xy[::4, ::4]))) / MEDIAN_OF_NORMAL)
    peak = (response == cv2.dilate(response, np.ones((5, 5), np.uint8))) & (response > faintest) & (strength > WEAKEST)
    peak[:2], peak[-2:], peak[:, :2], peak[:, -2:] = False, False, False, False
    v, u = np.nonzero(peak)
    hessian = np.stack([xx[v, u], xy[v, u], xy[v, u], yy[v, u]], -1).astype(float).reshape(-1, 2, 2)
    gradient = np.stack([blurred[v, u + 1] - blurred[v, u - 1], blurred[v + 1, u] - blurred[v - 1, u]], -1) / 2.0
    step = -np.linalg.solve(hessian, gradient[..., None].astype(float))[..., 0]
    pixels = np.stack([u, v], -1) + np.clip(step, -LONGEST_STEP, LONGEST_STEP)
    is_corner = np.nonzero(_symmetry(blurred, pixels) > SYMMETRY)[0]
    best = is_corner[np.argsort(-strength[v, u][is_corner], kind="stable")[:MOST_POINTS]]
    pixels, hessian, strength = pixels[best], hessian[best], strength[v, u][best].astype(float)
    vectors = np.linalg.eigh(hessian)[1]
    light = vectors[:, :, 1]  # brightness curves up along it
    return SaddlePoints(pixels, strength, light)


def brightness(
    image: Float32[np.ndarray, "height width"], pixels: Float[np.ndarray, "*places 2"]
) -> Float[np.ndarray, "*places"]:
    """Return brightness at these pixels by bilinear interpolation; beyond the photo's edge, that of the edge."""
    n = pixels.size // 2
    if n == 0:  # which OpenCV refuses
        return np.zeros(pixels.shape[:-1])
    flat = np.zeros((-(-n // REMAP_ROW), REMAP_ROW, 2), np.float32)
    flat.reshape(-1, 2)[:n] = pixels.reshape(-1, 2)
    values = cv2.remap(image, flat, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values, float).ravel()[:n].reshape(pixels.shape[:-1])


def _symmetry(
    blurred: Float32[np.ndarray, "height width"], pixels: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, " n"]:
    """Return the ratio of symmetric to antisymmetric variation of brightness on a ring around each point."""
    turn = 2 * np.pi * np.arange(RING_SAMPLES) / RING_SAMPLES
    best = np.zeros(len(pixels))
    for radius in RINGS:
        where = pixels[:, None] + radius * np.stack([np.cos(turn), np.sin(turn)], 1)
        one, other = np.split(brightness(blurred, where), 2, axis=1)
        best = np.maximum(best, (one + other).std(1) / (np.sqrt(((one - other) ** 2).mean(1)) + FAINTEST))
    return best
