"""Where a varnished or glossy table mirrors the flashlight: a round bright spot per photo on the ground.

A smooth table sends light on where the half vector between the directions to the light and to the eye is the ground's
normal [Blinn, Models of light reflection, SIGGRAPH 1977]. So the spot tells the light's direction as seen from there,
whatever the phone does to brightness: it is where the picture is brighter than its smooth field of light.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import label

from calibration.ground.ground_field import GroundField
from calibration.ground.ground_shadows import GROUND_LIKE, GroundShadows

BRIGHTEST = 1.0  # log units over the field: brighter counts as this, since the sensor clips there
DULLEST, SIGMAS = 0.12, 4.0  # a spot's least height, log units and sigmas of the field's noise
AS_HIGH = 0.5  # least height over that of the series' second highest: one table has one gloss
BLUR = 2.0  # px of the ground field: grain of wood is finer
LEVELS = (0.5, 0.65, 0.8, 0.9)  # of a spot's height, at the first of which the picture does not cut it
WHOLE = 0.05  # share of its rim there that may border on what is no ground or not in the picture
SMALLEST = 20  # px of the ground field
CUT = 0.3  # share of the rim of a saturated spot that may lie beyond the border, for an ellipse through the rest
OPEN = 0.5  # share of a spot's rim at half its height that shadow or the object may hide
SPOT_ERROR = 0.008  # radians of the half vector: as on six varnished tables with lights that are known
SQUARE = np.ones((3, 3), np.uint8)


@dataclass(frozen=True)
class MirrorHighlights:
    """Spots on the ground, at most one per photo."""

    photos: Int[np.ndarray, " spots"]
    points: Float[np.ndarray, "spots 3"]  # centroid of the excess brightness, world
    sigma: Float[np.ndarray, " spots"]  # of the half vector there, radians

    def __len__(self) -> int:
        return len(self.photos)


@dataclass(frozen=True)
class _Spot:
    middle: Float[np.ndarray, "2"]  # row and column
    height: float  # log units
    hidden: float  # share of its rim


def find_highlights(
    field: GroundField, shadows: GroundShadows, points: Float[np.ndarray, "height width 3"]
) -> MirrorHighlights:
    """Return the spots of all photos: of each the brightest, unless its middle is hidden or out of the picture.

    Args:
        points: of the ground in each pixel, world; nan where none is.
    """
    blocked = cv2.dilate(shadows.object_mask.astype(np.uint8), SQUARE) > 0
    bare = ~blocked & (shadows.likelihood < GROUND_LIKE) & np.isfinite(points).all(-1)
    if field.beyond is not None:
        bare &= ~field.beyond
    least = max(DULLEST, SIGMAS * field.noise())
    spots = {}
    for photo, (residual, visibility) in enumerate(zip(field.residual, shadows.visibility, strict=True)):
        valid = bare & ((visibility > 0.5) | (residual > 0))
        excess = np.where(valid, np.clip(residual, -0.3, BRIGHTEST), 0)
        spot = _brightest_spot(excess.astype(np.float32), valid, ~field.usable[photo], least)
        if spot is not None:
            spots[photo] = spot
    heights = sorted((spot.height for spot in spots.values()), reverse=True)
    usual = heights[1] if len(heights) > 1 else 0.0
    kept = {photo: spot for photo, spot in spots.items() if spot.height >= AS_HIGH * usual}
    rows, columns = np.rint([spot.middle for spot in kept.values()]).astype(int).reshape(-1, 2).T
    sigma = [SPOT_ERROR * (1 + 2 * spot.hidden) for spot in kept.values()]
    return MirrorHighlights(np.array(list(kept), int), points[rows, columns], np.array(sigma, float))


def _brightest_spot(
    excess: Float[np.ndarray, "height width"],
    valid: Bool[np.ndarray, "height width"],
    clipped: Bool[np.ndarray, "height width"],
    least: float,
) -> _Spot | None:
    """Return the spot with the largest sum; None where there is none, or its middle is out of sight."""
    known = cv2.GaussianBlur(valid.astype(np.float32), (0, 0), BLUR)
    smooth = cv2.GaussianBlur(excess, (0, 0), BLUR) / np.maximum(known, 0.3)
    smooth[~valid] = 0
    pieces = _pieces(smooth > LEVELS[0] * least)
    sums = np.bincount(pieces.ravel(), np.maximum(excess, 0).ravel())
    sums[0] = 0
    if not sums.any():
        return None
    height, top = _highest(np.where(pieces == sums.argmax(), smooth, 0))
    whole = _around(smooth > LEVELS[0] * height, top)
    hidden = _share(_rim(whole) & np.pad(~valid, 1), _rim(whole))
    core = clipped & whole
    if height < least or hidden > OPEN or whole.sum() < SMALLEST:
        return None
    parts = [*(_around(smooth > level * height, top) for level in LEVELS), core]
    cut = [_share(_rim(part) & ~np.pad(valid, 1), _rim(part)) if part.sum() >= SMALLEST else 1.0 for part in parts]
    if not (_rim(core) & np.pad(np.zeros_like(core), 1, constant_values=True)).any():
        for part, share in zip(parts, cut, strict=True):
            if share < (WHOLE + hidden if part is parts[0] else WHOLE):
                bright = part & (excess > 0)
                return _Spot(np.average(np.argwhere(bright), axis=0, weights=excess[bright]), height, hidden)
    elif cut[-1] < CUT:
        middle = _ellipse_middle(_rim(core) & np.pad(valid, 1))
        if all(0 <= one <= last - 1 for one, last in zip(middle, valid.shape, strict=True)):
            return _Spot(middle, height, max(hidden, cut[-1]))
    return None


def _ellipse_middle(rim: Bool[np.ndarray, "height_and_2 width_and_2"]) -> Float[np.ndarray, "2"]:
    """Return the middle, row and column, of the ellipse through what is seen of a rim."""
    rows, columns = np.nonzero(rim)
    (column, row), _, _ = cv2.fitEllipseDirect(np.stack([columns, rows], -1).astype(np.float32))
    return np.array([row - 1, column - 1])


def _highest(picture: Float[np.ndarray, "height width"]) -> tuple[float, tuple[int, int]]:
    row, column = np.unravel_index(int(np.argmax(picture)), picture.shape)
    return float(picture[row, column]), (int(row), int(column))


def _around(inside: Bool[np.ndarray, "height width"], place: tuple[int, int]) -> Bool[np.ndarray, "height width"]:
    pieces = _pieces(inside)
    return pieces == pieces[place]


def _rim(inside: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height_and_2 width_and_2"]:
    """Return the pixels around a region, in a picture that has one more on each side."""
    padded = np.pad(inside, 1)
    return (cv2.dilate(padded.astype(np.uint8), SQUARE) > 0) & ~padded


def _share(some: np.ndarray, of: np.ndarray) -> float:
    return float(some.sum() / max(of.sum(), 1))


def _pieces(inside: Bool[np.ndarray, "height width"]) -> Int[np.ndarray, "height width"]:
    pieces = np.empty(inside.shape, np.int32)
    label(inside, output=pieces)
    return pieces
