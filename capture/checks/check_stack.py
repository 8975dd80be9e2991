"""Find photos that would spoil a reconstruction: flash off, over-exposed, room light, another view."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from capture.checks.alignment import FEWEST_PHOTOS
from capture.checks.ambient_light import shadow_findings
from capture.checks.camera_motion import view_findings
from capture.photos.channels import largest_channel, mean_of_channels
from capture.photos.finding import Finding
from capture.photos.photo import PhotoStack
from capture.photos.radiometry import WHITE_BALANCE

FLASH_OFF = 0.2  # brightness over the median photo's; flashlights at 0.4 to 0.9 m gave 0.4 and more, no flash 0.05
BRIGHT_PART = 75  # percentile that stands for a photo's brightness: a low flashlight leaves much of the table dim
SATURATED = 0.98  # of full scale, before exposure is divided out
OVER_EXPOSED_WARN = 0.05  # share of saturated pixels
OVER_EXPOSED_DROP = 0.30
EXPOSURE_CHANGED = 0.02  # of the median photo's exposure; smaller differences are EXIF rounding
BLACK = 0.004  # of full scale: the least that the median photo's brightness is taken for


def check_stack(
    stack: PhotoStack, dark: PhotoStack | None = None, board: PhotoStack | None = None
) -> tuple[Finding, ...]:
    """Every fault found in the lit photos, in their order; a photo without findings is fine.

    Args:
        stack: lit photos of one fixed camera.
        dark: the same view with the flashlight off, read with `reference=stack.reference`.
        board: the tripod's photo of the board, to which the calibration belongs; photos by another camera do not.
    """
    found = [*_brightness_findings(stack, dark)]
    useless = {finding.photo for finding in found if finding.drop}
    indices = [i for i, path in enumerate(stack.paths) if path not in useless]
    if len(indices) >= FEWEST_PHOTOS:
        found += view_findings(stack, indices, board)
        left_out = {finding.photo for finding in found if finding.drop}
        found += shadow_findings(stack, [path not in left_out for path in stack.paths], dark)
    order = {path: i for i, path in enumerate(stack.paths)}
    return tuple(sorted(found, key=lambda finding: order[finding.photo]))


def white_balance_finding(photo: Path, ratio: float) -> Finding:
    """Return the finding for a photo whose white balance was divided out.

    Args:
        ratio: of the colour that was farthest off, over 1.
    """
    text = f"a colour is {ratio:.2f} times as strong as in the others; divided out. Lock the white balance next time"
    return Finding(photo, "white balance changed", text, ratio, float(np.exp(WHITE_BALANCE)), False)


def _brightness_findings(stack: PhotoStack, dark: PhotoStack | None) -> list[Finding]:
    ambient = 0.0 if dark is None else float(np.median(_levels(dark)))
    levels = np.maximum(_levels(stack) - ambient, 0)
    relative = levels / max(float(np.median(levels)), BLACK)
    found = []
    for path, rgb, gain, level in zip(stack.paths, stack.rgb, stack.gains, relative, strict=True):
        if abs(gain - 1) > EXPOSURE_CHANGED:
            text = f"exposed {gain:.2f} times as much as the median photo; divided out. Lock the exposure next time"
            found.append(Finding(path, "exposure changed", text, gain, 1 + EXPOSURE_CHANGED, False))
        if level < FLASH_OFF:
            text = f"{level:.2f} times as bright as the median photo, {FLASH_OFF} needed: was the flashlight off?"
            found.append(Finding(path, "flash off", text, float(level), FLASH_OFF, True))
            continue
        saturated = float((largest_channel(rgb) * gain >= SATURATED).mean())
        if saturated > OVER_EXPOSED_WARN:
            drop = saturated > OVER_EXPOSED_DROP
            text = f"{saturated:.0%} of the pixels are saturated, at most {OVER_EXPOSED_DROP:.0%} is fine: expose less"
            limit = OVER_EXPOSED_DROP if drop else OVER_EXPOSED_WARN
            found.append(Finding(path, "over-exposed", text, saturated, limit, drop))
    return found


def _levels(stack: PhotoStack) -> Float[np.ndarray, " photos"]:
    thinned = mean_of_channels(stack.rgb[:, ::4, ::4])  # a percentile needs no more pixels than that
    return np.percentile(thinned.reshape(len(thinned), -1), BRIGHT_PART, axis=1)
