"""Long thin lines across the picture that are unlike the ground: a wall's foot, a table's far edge."""

import cv2
import numpy as np
from jaxtyping import Bool
from scipy.ndimage import label

LINE_GAP = 5  # px: shorter gaps in a line across the picture are closed
SEAM_LENGTH, SEAM_WIDTH = 0.12, 0.025  # of the picture's long side: a line this long and thin may be a wall's foot


def without_seams(likely: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """Remove long thin lines across the picture where they stick out of what is not thin.

    A wall's foot and a table's far edge are no ground, and an object in front of them becomes one part with them. A
    rail or a beam of the object ends within the object's own width, and stays. What goes on to the picture's border is
    no part of the object, and is removed beside the object, too.
    """
    whole, side = likely.astype(np.uint8), max(likely.shape)
    long, thick = round(SEAM_LENGTH * side), round(SEAM_WIDTH * side)
    seam = cv2.morphologyEx(whole, cv2.MORPH_OPEN, np.ones((1, long), np.uint8)) > 0
    seam &= cv2.morphologyEx(whole, cv2.MORPH_OPEN, np.ones((thick, 1), np.uint8)) == 0
    parts, rest = np.empty(likely.shape, np.int32), likely & ~seam
    label(rest, output=parts)
    if not seam.any() or not rest.any():
        return likely
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    columns = np.flatnonzero((parts == int(sizes.argmax())).any(0))
    inside = np.zeros(likely.shape, bool)
    inside[:, max(columns[0] - thick, 0) : columns[-1] + thick + 1] = True
    return likely & (inside | ~seam) & ~_to_the_border(seam, likely, thick)


def _to_the_border(
    seam: Bool[np.ndarray, "height width"], likely: Bool[np.ndarray, "height width"], thick: int
) -> Bool[np.ndarray, "height width"]:
    """Return the thin likely pixels along seams that reach the left or right border: a seam's edges are ragged."""
    joined = cv2.morphologyEx(seam.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((LINE_GAP, thick), np.uint8))
    parts = np.empty(seam.shape, np.int32)
    label(joined, output=parts)
    ends = np.setdiff1d(parts[:, [0, -1]], [0])
    along = cv2.dilate(np.isin(parts, ends).astype(np.uint8), np.ones((thick, 1), np.uint8)) > 0
    bulk = cv2.morphologyEx(likely.astype(np.uint8), cv2.MORPH_OPEN, np.ones((thick, 1), np.uint8)) > 0
    return along & ~bulk
