"""Shadows on the ground and the object's outline, from what deviates from the ground's field; no light is needed."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import label

from calibration.ground.ground_field import GroundField, Maps
from calibration.ground.outline_model import (
    ODDS,
    ObjectAndGround,
    Witness,
    dark_levels,
    object_and_ground,
    shadowed_inside,
)

GROUND_LIKE = -0.3  # mean log likelihood ratio of a photo below which a pixel is ground
LIKELY = -0.1  # the same, from which a pixel is none
LINE_GAP = 5  # px: shorter gaps in a line across the picture are closed
SEAM = 0.006  # of the picture's long side, to both sides of the line where the ground ends


@dataclass(frozen=True)
class GroundShadows:
    """What GroundField's residuals mean, on its pixel grid."""

    visibility: Maps  # of ground: 1 lit, 0 in shadow, not clipped
    dark_level: Float[np.ndarray, " photos"]  # log brightness of shadows relative to lit ground: ambient, one bounce
    likelihood: Float[np.ndarray, "height width"]  # mean log likelihood ratio of a photo, no ground over ground
    object_mask: Bool[np.ndarray, "height width"]  # what throws shadows; empty where nothing does


@dataclass(frozen=True)
class BareGround:
    """The ground beside an object."""

    field: GroundField  # with the albedo of the ground around in gaps
    shadows: GroundShadows
    types: ObjectAndGround


def find_shadows(field: GroundField) -> GroundShadows:
    """Return the shadows and the object, whose mask is empty where nothing deviates from the ground."""
    return bare_ground(field).shadows


def bare_ground(field: GroundField, witness: Witness | None = None) -> BareGround:
    """Return the shadows and the object, and the ground under both as far as the photos tell it.

    Args:
        witness: see object_and_ground.
    """
    seam = None if field.beyond is None else _seam(field.beyond)
    found = object_and_ground(field, seam, witness)
    likelihood = cv2.GaussianBlur(found.brightness, (0, 0), 0.7)
    if field.beyond is not None:
        likelihood = np.where(field.beyond | seam, np.float32(ODDS), likelihood)
    field = replace(field, albedo=found.albedo, residual=field.residual + (field.albedo - found.albedo))
    dark = dark_levels(field)
    visibility = (np.exp(np.minimum(field.residual, 0.5)) - np.exp(dark)) / (1 - np.exp(dark))
    mask = shadowed_inside(field, found.region)
    shadows = GroundShadows(visibility.astype(np.float32), dark.ravel(), likelihood, mask)
    return BareGround(field, shadows, found)


def _seam(beyond: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """Return the pixels at the line where the ground ends, in which neither side's field holds."""
    disc = np.ones([2 * max(1, round(SEAM * max(beyond.shape))) + 1] * 2, np.uint8)
    return cv2.morphologyEx(beyond.astype(np.uint8), cv2.MORPH_GRADIENT, disc) > 0


def convex_hull(region: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """Return the pixels inside the convex hull of a region that is not empty."""
    hull = np.zeros(region.shape, np.uint8)
    cv2.fillConvexPoly(hull, cv2.convexHull(np.argwhere(region)[:, ::-1].astype(np.int32)), 1)
    return hull > 0


def of_one_ground(shadows: GroundShadows) -> GroundShadows:
    """Return the shadows with all that a line across the picture parts from the ground marked as no ground.

    Behind the foot of a wall or the edge of a table there may be another surface whose light is as smooth.
    """
    line = (shadows.likelihood > GROUND_LIKE).astype(np.uint8)
    line = cv2.morphologyEx(
        np.pad(line, LINE_GAP, constant_values=1), cv2.MORPH_CLOSE, np.ones((LINE_GAP, LINE_GAP), np.uint8)
    )
    line = (line[LINE_GAP:-LINE_GAP, LINE_GAP:-LINE_GAP] > 0) | shadows.object_mask
    parts = np.empty(line.shape, np.int32)
    label(~line, output=parts)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    border = np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]])
    beyond = np.setdiff1d(border, [0, int(sizes.argmax())])
    return replace(shadows, likelihood=np.where(np.isin(parts, beyond), np.float32(ODDS), shadows.likelihood))
