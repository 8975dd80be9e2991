"""Comparison: a photo of a finished run, its computed picture and their difference."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from calibration.calibration import Calibration
from capture.photos.photo import decode_srgb, encode_srgb
from reconstruct.detail.file import Detail
from reconstruct.detail.sample import with_detail
from reconstruct.fields import Fields
from reconstruct.render.g_buffer import RenderView, look
from reconstruct.render.photo_prediction import photographed, shadow_picture, with_refined_lights
from viewer.report.drawing import Picture, difference_picture

BRIGHT_ENOUGH = 0.02  # linear: pixels above it are used to compare brightness
BLACK_OR_WHITE = 12  # of 255 from either end: JPEG error of a shadow picture, except at edges
MOSTLY = 0.9  # of the pixels


@dataclass(frozen=True)
class Comparison:
    """Three pictures of one size, 8-bit sRGB."""

    photo: Picture
    computed: Picture
    difference: Picture  # see difference_picture


def compare(photo: Picture, linear: Float[np.ndarray, "height width 3"]) -> Comparison | None:
    """Compare a photo with a computed picture, scaled to the photo's brightness; None if their sizes differ."""
    if linear.shape != photo.shape:
        return None
    computed = as_bright_as(linear, photo)
    return Comparison(photo, computed, difference_picture(photo, computed))


def as_bright_as(linear: Float[np.ndarray, "height width 3"], photo: Picture) -> Picture:
    """Scale a computed picture so that the median ratio of its pixels to the photo's is 1. sRGB."""
    theirs = decode_srgb(photo)
    both = (linear > BRIGHT_ENOUGH) & (theirs > BRIGHT_ENOUGH)
    gain = float(np.median(theirs[both] / linear[both])) if both.any() else 1.0
    return encode_srgb(gain * linear)


def compare_result(
    fields: Fields, calibration: Calibration, name: str, photo: Picture, details: Sequence[Detail] = ()
) -> Comparison | None:
    """Compare a photo of a finished run, by its name in the calibration, with its computed picture."""
    camera = fields.camera.resized(photo.shape[1], photo.shape[0])
    view = with_detail(look(fields, posed_camera=replace(fields.posed_camera, camera=camera)), details, camera)
    return compare(photo, _computed(view, with_refined_lights(calibration, fields), name, photo))


def is_shadow_picture(photo: Picture) -> bool:
    """Return whether a picture is black and white: then it shows where light arrives, and nothing else."""
    grey = photo.mean(-1)
    return bool(np.mean((grey < BLACK_OR_WHITE) | (grey > 255 - BLACK_OR_WHITE)) > MOSTLY)


def _computed(
    view: RenderView, calibration: Calibration, name: str, photo: Picture
) -> Float[np.ndarray, "height width 3"]:
    """Return the linear picture that the photo should show; for a shadow picture, where light arrives."""
    picture = shadow_picture if is_shadow_picture(photo) else photographed
    return picture(view, calibration, name).numpy()
