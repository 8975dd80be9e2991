"""How the bare table looks from another place: the tripod's picture of it, carried over the plane z = ground."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from calibration.ground.outline_model import window_mean
from calibration.posed_camera import PosedCamera
from capture.checks.robust import column_spread, geman_mcclure

DARKEST = 0.004  # linear: added nowhere, a floor before the logarithm; one step of 8-bit sRGB
FLATTEST = 0.02  # least slope of a ray that is taken to meet the table
SEEN_WIDTH = 1.2  # px of the side photo's working size: both pictures are smoothed by it before they are compared
GAIN_WIDTH = 0.25  # of the window: room light and gloss change slowly
GAIN_ROUNDS = 4
BELIEVED_INSIDE = 0.5  # vote of ground where the object may be, against ground beside it
SHIFT = 1.0  # px: how far pose and sheet may misplace the table's texture
NARROWEST = 0.03  # log units
SAME_TEXTURE = 0.35  # correlation of fine texture from which the object was on the table already
FINE = 1.5  # px: scale of that texture
REDUCED = 96  # px: the gain is smooth


@dataclass(frozen=True)
class TripodView:
    """The tripod's photo in room light, and what hides the table in it."""

    posed_camera: PosedCamera
    rgb: Float[np.ndarray, "height width 3"]  # linear
    hides: Bool[np.ndarray, "height width"]  # object, not table


@dataclass(frozen=True)
class GroundLook:
    """Deviation of a side photo from the bare table, on its window; logarithms are natural."""

    residual: Float[np.ndarray, "height width 3"]  # log photo minus log table, smooth gain taken off; 0 where unknown
    error: Float[np.ndarray, "height width 3"]  # one sigma of it on bare table
    known: Bool[np.ndarray, "height width"]  # the tripod saw the table here
    hidden: Bool[np.ndarray, "height width"]  # the object hid the table from the tripod here


def stood_there(
    rgb: Float[np.ndarray, "height width 3"],
    lit: Float[np.ndarray, "height width"],
    mask: Bool[np.ndarray, "height width"],
) -> bool:
    """Return whether the object was on the table in the tripod's photo in room light: its texture is in both.

    Args:
        rgb: that photo; lit: mean log brightness of the photos under the flashlight, on the same pixels.
        mask: the object.
    """
    inner = cv2.erode(mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    if inner.sum() < 50:
        return True
    logs = (values.astype(np.float32) for values in (np.log(np.maximum(rgb.mean(-1), DARKEST)), lit))
    one, other = (
        (cv2.GaussianBlur(log, (0, 0), FINE) - cv2.GaussianBlur(log, (0, 0), 4 * FINE))[inner] for log in logs
    )
    size = float(np.sqrt((one**2).sum() * (other**2).sum()))
    return size <= 0 or float((one * other).sum()) / size > SAME_TEXTURE


def ground_look(
    log_rgb: Float[np.ndarray, "height width 3"],
    camera: PosedCamera,
    region: Bool[np.ndarray, "height width"],
    tripod: TripodView,
) -> GroundLook:
    """Compare a window of a side photo with the table as the tripod saw it.

    Args:
        log_rgb: of the window, smoothed by SEEN_WIDTH; camera: of the window.
        region: where the object may be.
    """
    table, known, hidden = _table(camera, tripod)
    raw = np.where(known[..., None], log_rgb - table, 0.0).astype(np.float32)
    if (known & ~region).sum() < 100:
        return GroundLook(raw, np.ones_like(raw), np.zeros_like(known), hidden)
    slope = np.abs(np.gradient(table, axis=0)) + np.abs(np.gradient(table, axis=1))
    outside = known & ~region
    vote, sigma = outside.astype(np.float32), np.full(3, 0.2)
    residual = raw
    for _ in range(GAIN_ROUNDS):
        residual = raw - window_mean(raw, vote, GAIN_WIDTH * max(vote.shape), GAIN_WIDTH * REDUCED, 1e-6)
        off = residual[outside]
        sigma = np.maximum(column_spread(off), NARROWEST)
        error = np.hypot(sigma, SHIFT * slope)
        size = np.sqrt(((residual / error) ** 2).mean(-1))
        vote = (np.where(region, BELIEVED_INSIDE, 1.0) * known * geman_mcclure((size / 2) ** 2)).astype(np.float32)
    return GroundLook(np.where(known[..., None], residual, 0.0), np.hypot(sigma, SHIFT * slope), known, hidden)


def _table(camera: PosedCamera, tripod: TripodView):
    """Return the log colour of the table at each pixel, where the tripod saw it, and where the object hid it."""
    rays = camera.rays(camera.camera.pixel_grid())
    down = rays[..., 2] < -FLATTEST
    reach = (camera.ground_height - camera.centre[2]) / np.where(down, rays[..., 2], -1.0)
    pixels, depth = tripod.posed_camera.project_with_depth(camera.centre + rays * reach[..., None])
    height, width = tripod.hides.shape
    inside = ((pixels > 1) & (pixels < [width - 2, height - 2])).all(-1)
    known = down & (depth > 0) & inside
    at = np.where(known[..., None], pixels, -10).astype(np.float32)
    hidden = cv2.dilate(tripod.hides.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(np.float32)
    free = cv2.remap(hidden, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderValue=1) < 0.01
    log = np.log(np.maximum(tripod.rgb, DARKEST)).astype(np.float32)
    finer = max(1.0, float(tripod.posed_camera.camera.fx / camera.camera.fx))
    log = cv2.GaussianBlur(log, (0, 0), SEEN_WIDTH * finer)
    return cv2.remap(log, at[..., 0], at[..., 1], cv2.INTER_LINEAR), known & free, known & ~free
