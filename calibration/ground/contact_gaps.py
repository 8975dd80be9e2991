"""Ground in the gaps of an object's outline: at a contact and between feet, where most photos show shadow.

There the albedo of the field is that of the shadow, so that nothing fits. The ground around tells the albedo instead:
ground in a gap is as bright as its neighbours where light gets in, and dark otherwise; the object is mostly in between.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float

from calibration.ground.ground_field import GroundField
from calibration.ground.ground_shadows import DARK, NARROWEST, OBJECT_WIDTH, ODDS, GroundShadows, gaussian

NEIGHBOURHOOD = 0.6  # of the object's size in the picture, sigma of the window whose ground tells the albedo
FOLLOWS = 0.6  # share of photos from which a pixel tells it
ALBEDO_STEPS = np.linspace(-0.5, 0.5, 11)  # log units: how far albedos of neighbours differ
LIT_WIDTH = 3.0  # sigmas of open ground: light in a gap comes from part of the lamp, and from the object
LIT_PRIOR, DARK_PRIOR = 0.25, 0.4  # share of lit ground in a gap; share of the object's samples that are dark
DARK_EDGE, DARK_DENSITY = 0.35, 0.33  # log units above the photo's dark level; density of darker samples
OBJECT = -0.5  # log brightness of the object relative to the ground
SHADED_SHARE = 0.35  # of the photos, that show a gap in shadow
FEWEST_LIT = 3  # photos that show the ground lit
TOO_DARK = 0.3  # log units below the neighbours: the albedo of a shadow
LIKELY = 0.15  # mean log likelihood ratio of a photo, ground over object


def around(field: GroundField, mask: Bool[np.ndarray, "height width"]) -> Float[np.ndarray, "height width"]:
    """Return the log albedo of the ground around each pixel: a mean over a window of bare ground."""
    rim = cv2.dilate(mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    bare = (~rim & (field.follows > FOLLOWS)).astype(np.float32)
    sigma = NEIGHBOURHOOD * max(1.0, float(mask.sum())) ** 0.5
    total, count = (cv2.GaussianBlur(x, (0, 0), sigma) for x in (field.albedo * bare, bare))
    return np.where(count > 1e-6, total / np.maximum(count, 1e-6), field.albedo)


def with_gaps(
    field: GroundField, shadows: GroundShadows
) -> tuple[Float[np.ndarray, "height width"], Float[np.ndarray, "height width"]]:
    """Compare the object's pixels with ground of their neighbours' albedo.

    Returns:
        the mean log likelihood ratio of a photo, ground over object; and the log albedo that the ground would have.
    """
    near = around(field, shadows.object_mask)
    level = field.residual + (field.albedo - near)
    likely = np.full(near.shape, -ODDS, np.float32)
    albedo = near.copy()
    count = np.maximum(field.usable.sum(0), 1)
    width = LIT_WIDTH * max(NARROWEST, field.noise())
    dark_level = shadows.dark_level[:, None, None]
    is_shaded = (field.usable & (level < DARK)).sum(0) > SHADED_SHARE * count  # a level top of the object is lit
    dark = DARK_DENSITY * np.exp(-0.5 * (np.maximum(level - dark_level, 0) / DARK_EDGE) ** 2)
    anything = (1 - DARK_PRIOR) * gaussian(level - OBJECT, OBJECT_WIDTH) + DARK_PRIOR * dark + 1e-3
    for step in ALBEDO_STEPS:
        ground = LIT_PRIOR * gaussian(level - step, width) + (1 - LIT_PRIOR) * dark + 1e-3
        odds = (np.clip(np.log(ground / anything), -ODDS, ODDS) * field.usable).sum(0) / count
        lit = (field.usable & (np.abs(level - step) < 2.5 * width)).sum(0)
        better = (odds > likely) & (lit >= FEWEST_LIT) & is_shaded
        likely[better], albedo[better] = odds[better], near[better] + step
    return cv2.GaussianBlur(likely, (0, 0), 0.7), albedo


@dataclass(frozen=True)
class BareGround:
    """The ground beside an object."""

    field: GroundField  # with the neighbours' albedo in gaps and where shadows were taken for it
    shadows: GroundShadows  # without the gaps in the object
    gap_likelihood: Float[np.ndarray, "height width"]  # ground in a gap over object


def without_gaps(field: GroundField, shadows: GroundShadows) -> BareGround:
    """Cut the gaps out of the object, and correct the albedo of ground that is seldom lit."""
    likely, albedo = with_gaps(field, shadows)
    is_gap = likely > LIKELY
    reach = 2 * round(NEIGHBOURHOOD * float(shadows.object_mask.sum()) ** 0.5) + 1
    near = cv2.dilate(shadows.object_mask.astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0
    wrong = is_gap & near & (shadows.object_mask | (field.albedo < albedo - TOO_DARK))
    changed = np.where(wrong, albedo, field.albedo).astype(np.float32)
    corrected = replace(field, albedo=changed, residual=field.residual + (field.albedo - changed))
    return BareGround(corrected, replace(shadows, object_mask=shadows.object_mask & ~is_gap), likely)
