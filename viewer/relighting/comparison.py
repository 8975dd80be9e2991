"""Comparison: a photo, its computed picture and their difference, of a finished run or a snapshot of a running one."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from calibration.calibration import Calibration
from capture.photos.photo import decode_srgb, encode_srgb
from reconstruct.detail.file import Detail
from reconstruct.detail.sample import with_detail
from reconstruct.fields import Fields
from reconstruct.render.g_buffer import RenderView, look
from reconstruct.render.photo_prediction import photographed, shadow_picture, snapshot, with_refined_lights
from reconstruct.sdf.grid import SdfGrid
from viewer.display.pictures import Picture, difference_picture, reduced

BRIGHT_ENOUGH = 0.02  # linear: pixels above it are used to compare brightness
BLACK_OR_WHITE = 12  # of 255 from either end: JPEG error of a shadow picture, except at edges
MOSTLY = 0.9  # of the pixels
OTHERS = 12  # photos that the albedo of a snapshot is read from: more cost time and change little
MOST = 95  # per cent of the pixels that a number is stated for


@dataclass(frozen=True)
class Comparison:
    """Three pictures of one size, 8-bit sRGB."""

    photo: Picture
    computed: Picture
    difference: Picture  # see difference_picture

    def gaps(self) -> tuple[float, float]:
        """Return median and MOST-th percentile of |photo - computed| over the pixels, as shares of white."""
        gap = np.abs(self.photo.astype(float).mean(-1) - self.computed.astype(float).mean(-1)) / 255
        return float(np.median(gap)), float(np.percentile(gap, MOST))


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


def compare_snapshot(
    surface: SdfGrid, calibration: Calibration, name: str, thumbs: Mapping[str, Picture], width: int
) -> Comparison | None:
    """Compare a photo of a running run with its picture: from the surface so far and an albedo read from other photos.

    Args:
        thumbs: small photos by their names, as far as they are there.
        width: of the pictures, px.
    """
    photo = reduced(thumbs[name], width)
    camera = calibration.camera.resized(photo.shape[1], photo.shape[0])
    others = {} if is_shadow_picture(photo) else _others(calibration, name, thumbs, photo)
    return compare(photo, _computed(snapshot(surface, calibration, camera, others), calibration, name, photo))


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


def _others(
    calibration: Calibration, name: str, thumbs: Mapping[str, Picture], photo: Picture
) -> dict[str, Float[np.ndarray, "height width 3"]]:
    """Return some used photos (linear) spread over the capture, without the compared one."""
    names = [x.photo for x in calibration.lights if x.used and x.photo in thumbs and x.photo != name]
    chosen = [names[i] for i in np.unique(np.linspace(0, len(names) - 1, OTHERS).astype(int))] if names else []
    small = {other: reduced(thumbs[other], photo.shape[1]) for other in chosen}
    return {other: decode_srgb(picture) for other, picture in small.items() if picture.shape == photo.shape}
