"""Correct differences between photos of one fixed view: ambient light and white balance.

Exposure by EXIF is divided out where photos are read. Other exposure differences are left to the light fit: for the
ground a brighter exposure and a brighter flashlight are equivalent, and every photo's light has its own power.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from capture.errors import CaptureError
from capture.photos.channels import largest_channel, smallest_channel
from capture.photos.photo import PhotoStack

TOO_BRIGHT = 0.7  # brightness without flashlight over that with it: brighter photos are not without flashlight
WHITE_BALANCE = 0.03  # log ratio of colours; light between coloured surfaces gave 0.02 in one photo of 66
LEVEL_STEP = 4  # px: brightness of a whole photo needs no more
DIM, BRIGHT = 0.02, 0.9  # of full scale: limits between which colour is neither noise nor saturated
FEWEST_PIXELS = 500
LONG_SIDE = 160  # px of the picture that colour is read from, at most


def without_ambient(stack: PhotoStack, dark: PhotoStack) -> PhotoStack:
    """Subtract the mean of the photos without flashlight; negative results are noise and become 0.

    Args:
        dark: the same view, read with `reference=stack.reference`.

    Raises:
        CaptureError: `dark` has another size, or is not dark.
    """
    if dark.rgb.shape[1:] != stack.rgb.shape[1:]:
        raise CaptureError(
            f"{dark.paths[0]} is {dark.full_width} x {dark.full_height} pixels, {stack.full_width} x "
            f"{stack.full_height} as the photos under the flashlight was needed. Take it with the same camera."
        )
    ambient = dark.rgb.mean(0)
    share = _level(ambient) / max(float(np.median([_level(rgb) for rgb in stack.rgb])), np.finfo(np.float32).tiny)
    if share > TOO_BRIGHT:
        raise CaptureError(
            f"{dark.paths[0]}, a photo without flashlight, is {share:.2f} times as bright as those with it, "
            f"{TOO_BRIGHT} at most was needed. Was the flashlight on? Darken the room, or remove the photo."
        )
    rgb = np.empty(stack.rgb.shape, np.float32)
    for one, without in zip(stack.rgb, rgb, strict=True):  # all at once would take three times the memory
        np.maximum(one - ambient, np.float32(0), out=without)
    return replace(stack, rgb=rgb)


def _level(rgb: Float[np.ndarray, "height width 3"]) -> float:
    return float(np.median(rgb[::LEVEL_STEP, ::LEVEL_STEP]))


def white_balance(stack: PhotoStack) -> Float[np.ndarray, "photos 3"]:
    """Return the excess of each photo's red, green and blue relative to the usual ones, as factors; mean log 0.

    Every pixel is compared with itself in the other photos, so albedo and the flashlight's colour cancel.
    """
    step = max(1, max(stack.rgb.shape[1:3]) // LONG_SIDE)
    rgb = stack.rgb[:, ::step, ::step].reshape(len(stack.rgb), -1, 3)
    full = rgb * np.array(stack.gains, np.float32)[:, None, None]
    usable = (smallest_channel(full) > DIM) & (largest_channel(full) < BRIGHT)
    logs = np.log(np.maximum(rgb, np.finfo(np.float32).tiny))
    chroma = logs - logs.mean(2, keepdims=True)
    in_order = np.sort(np.where(usable[..., None], chroma, np.inf), axis=0)  # numpy's masked median takes seconds
    middle = np.maximum(usable.sum(0) - 1, 0) // 2
    usual = np.take_along_axis(in_order, middle[None, :, None], axis=0)[0]
    drift = np.zeros((len(rgb), 3))
    for index, (colour, use) in enumerate(zip(chroma, usable, strict=True)):
        if use.sum() >= FEWEST_PIXELS:
            off = np.median(np.asarray(colour[use] - usual[use]), axis=0)
            drift[index] = off - off.mean()
    return np.exp(drift)


def with_one_white_balance(stack: PhotoStack) -> tuple[PhotoStack, dict[Path, float]]:
    """Divide out the white balance of photos that differ from the others; return also the factors by which they did."""
    balance = white_balance(stack)
    off = np.abs(np.log(balance)).max(1)
    changed = np.flatnonzero(off > WHITE_BALANCE)
    if not len(changed):
        return stack, {}
    rgb = np.array(stack.rgb)
    rgb[changed] /= balance[changed, None, None].astype(np.float32)
    kept = np.ones_like(balance)
    kept[changed] = balance[changed]
    return replace(stack, rgb=rgb, balance=kept), {stack.paths[i]: float(np.exp(off[i])) for i in changed}
