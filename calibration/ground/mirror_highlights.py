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
BLUR = 2.0  # px of the ground field: grain of wood is finer
SPOTS = 4  # places per photo that are looked at
SMALLEST = 20  # px of the ground field
OPEN = 0.5  # share of a spot's rim that may border on what is no ground
SPOT_ERROR = 0.012  # radians of the half vector: as two varnished tables show with lights that are known


@dataclass(frozen=True)
class MirrorHighlights:
    """Spots on the ground, at most one per photo."""

    photos: Int[np.ndarray, " spots"]
    points: Float[np.ndarray, "spots 3"]  # centroid of the excess brightness, world
    sigma: Float[np.ndarray, " spots"]  # of the half vector there, radians

    def __len__(self) -> int:
        return len(self.photos)


def find_highlights(
    field: GroundField,
    shadows: GroundShadows,
    points: Float[np.ndarray, "height width 3"],
    near: Bool[np.ndarray, "height width"],
) -> MirrorHighlights:
    """Return the spots of all photos. Those that the picture's border cuts are left out: their middle is unknown.

    Args:
        points: of the ground in each pixel, world.
        near: where to look: on the ground, not far from the object.
    """
    hidden = cv2.dilate(shadows.object_mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    bare = near & ~hidden & (shadows.likelihood < GROUND_LIKE)
    least = max(DULLEST, SIGMAS * field.noise())
    spots = []
    for photo, (residual, visibility) in enumerate(zip(field.residual, shadows.visibility, strict=True)):
        valid = bare & ((visibility > 0.5) | (residual > 0))
        best = _brightest_spot(np.where(valid, np.clip(residual, -0.3, BRIGHTEST), 0), valid, least)
        if best is not None:
            weight, share = best
            point = (weight[..., None] * np.where(weight[..., None] > 0, points, 0)).sum((0, 1)) / weight.sum()
            spots.append((photo, point, SPOT_ERROR * (1 + 2 * share)))
    photos, places, sigma = zip(*spots, strict=True) if spots else ((), (), ())
    return MirrorHighlights(np.array(photos, int), np.array(places).reshape(-1, 3), np.array(sigma, float))


def _brightest_spot(excess: Float[np.ndarray, "height width"], valid: Bool[np.ndarray, "height width"], least: float):
    """Return the weights of the pixels of the spot with the largest sum, and the open share of its rim; or None."""
    known = cv2.GaussianBlur(valid.astype(np.float32), (0, 0), BLUR)
    smooth = cv2.GaussianBlur(excess.astype(np.float32), (0, 0), BLUR) / np.maximum(known, 0.3)
    smooth[~valid] = 0
    wide, left, best = _pieces(smooth > 0.5 * least), smooth.copy(), None
    for _ in range(SPOTS):
        top = np.unravel_index(int(np.argmax(left)), left.shape)
        if left[top] < least:
            break
        pieces = _pieces(smooth > 0.5 * left[top])
        left[wide == wide[top]] = 0
        spot = pieces == pieces[top]
        rim = (cv2.dilate(spot.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0) & ~spot
        open_share = float((rim & ~valid).sum() / max(rim.sum(), 1))
        if spot.sum() < SMALLEST or open_share > OPEN or _at_border(spot):
            continue
        weight = np.where(spot, np.maximum(excess, 0), 0)
        if best is None or weight.sum() > best[0].sum():
            best = weight, open_share
    return best


def _pieces(inside: Bool[np.ndarray, "height width"]) -> Int[np.ndarray, "height width"]:
    pieces = np.empty(inside.shape, np.int32)
    label(inside, output=pieces)
    return pieces


def _at_border(spot: Bool[np.ndarray, "height width"]) -> bool:
    inner = spot[2:-2, 2:-2]
    return bool(spot.sum() > inner.sum())
