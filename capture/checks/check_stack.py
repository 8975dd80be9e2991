"""Find photos that would spoil a reconstruction: flash off, over-exposed, room light, another view.

Photos that a tapped phone or tripod moved a little are registered: found, measured and moved back.

A tap turns the camera by a fraction of a degree and shifts it by less than a millimetre. A turn about the camera's
centre moves the pixels by one homography, whatever lies in the picture, so the photo can be brought back to where the
calibrated camera would have shown it. Its three angles are fitted to the fixed texture (capture.checks.registration).
Whether that was right is not assumed: the photos are checked again, and one that still lies off stays out.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from capture.checks.alignment import BOARD_OFF, FEWEST_PHOTOS, MOVED, REFERENCE_PX, home_view, textures_of
from capture.checks.ambient_light import shadow_findings
from capture.checks.camera_motion import view_findings
from capture.checks.framing import NOT_COMPARED, framing_findings
from capture.checks.registration import Homography, Rotation, moved
from capture.decode.exif import focal_in_pixels
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
FARTHEST_PX = 12.0  # at REFERENCE_PX: a larger motion moves the camera's place as well
ROLLED = 2.0  # a shift alone, found where the camera also rolled, may seem so many times as far
REGISTERED, ANOTHER_SCENE = "registered", "another scene"  # kinds of finding
NEAR_ENOUGH = 0.25  # px: a photo nearer than that is left as it is
RINGING = 3  # px around a saturated one, into which moving back carries its colour


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
    return _in_order(stack, found)


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


def check_and_register(
    stack: PhotoStack, dark: PhotoStack | None = None, board: PhotoStack | None = None
) -> tuple[Finding, ...]:
    """Check photos as check_stack does, and move back, in the stack, those whose camera a tap moved a little.

    A photo that was moved back has a finding of kind "registered", which does not drop it. Where all photos show the
    board's view zoomed, turned or from another place (capture.checks.framing), each has a finding that says so, and
    the board's photo tells nothing else of them. The arguments are those of check_stack.
    """
    found = check_stack(stack, dark, board)
    if not any(one.kind == BOARD_OFF and one.drop for one in found):
        left_out = {one.photo for one in found if one.drop and one.kind not in (MOVED, ANOTHER_SCENE)}
        framed = framing_findings(stack, [i for i, p in enumerate(stack.paths) if p not in left_out], board)
        if framed and framed[0].kind == NOT_COMPARED:  # what check_stack saw of the board counts
            found = (*framed, *found)
        elif framed:
            return _in_order(stack, [*check_and_register(stack, dark), *framed])
    own, to_board = _motions(stack, found, board)
    if not own and to_board is None:
        return found
    before = {i: (stack.rgb[i].copy(), stack.clipped[i].copy()) for i in own}
    for i, motion in own.items():
        _move_back(stack, i, motion)
    if board is not None and to_board is not None:  # as the group's camera would have seen it
        board = replace(board, rgb=board.rgb.copy(), clipped=board.clipped.copy())
        _move_back(board, 0, to_board)
    again = check_stack(stack, dark, board)
    for i, pixels in before.items():
        stack.rgb[i], stack.clipped[i] = pixels
    told = {finding.photo: finding for finding in found if _is_motion(finding)}
    off = {finding.photo for finding in again if _is_motion(finding)}
    kept = [told.get(one.photo, one) if _is_motion(one) else one for one in again]
    dropped = {finding.photo for finding in kept if finding.drop}
    for i, path in enumerate(stack.paths):
        motion = own.get(i, np.eye(3)) @ (np.eye(3) if to_board is None else np.linalg.inv(to_board))
        if path not in off | dropped and (length := _shift_of(motion, stack)) > NEAR_ENOUGH:
            length *= stack.to_file
            text = (
                f"the view lay {length:.1f} px off, as after a tap on the phone; the photo was moved back and is used"
            )
            limit = FARTHEST_PX * stack.full_width / REFERENCE_PX
            kept.append(Finding(path, REGISTERED, text, length, limit, False, tuple(motion.ravel().tolist())))
    findings = _in_order(stack, kept)
    register(stack, findings)
    return findings


def _in_order(stack: PhotoStack, findings: Sequence[Finding]) -> tuple[Finding, ...]:
    order = {path: i for i, path in enumerate(stack.paths)}
    return tuple(sorted(findings, key=lambda finding: order[finding.photo]))


def register(stack: PhotoStack, findings: Sequence[Finding]) -> None:
    """Move back, in the stack, the photos that have a finding of kind "registered"."""
    for finding in findings:
        if finding.kind == REGISTERED and finding.homography is not None:
            _move_back(stack, stack.paths.index(finding.photo), np.reshape(finding.homography, (3, 3)))


def _move_back(stack: PhotoStack, photo: int, motion: Homography) -> None:
    """Resample a photo to what the others' camera would have seen.

    Args:
        motion: from the pixels of the common view to those of the photo.
    """
    near = np.ones((2 * RINGING + 1, 2 * RINGING + 1), np.uint8)
    tainted = cv2.dilate(stack.clipped[photo].astype(np.uint8), near)
    stack.rgb[photo] = np.maximum(_warped(stack.rgb[photo], motion, cv2.INTER_LANCZOS4), 0)
    stack.clipped[photo] = _warped(tainted, motion, cv2.INTER_NEAREST) > 0


def _warped(picture: np.ndarray, motion: Homography, flags: int) -> np.ndarray:
    size, flags = (picture.shape[1], picture.shape[0]), flags | cv2.WARP_INVERSE_MAP
    return cv2.warpPerspective(picture, motion, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)


def _is_motion(finding: Finding) -> bool:
    return finding.kind in (MOVED, BOARD_OFF)


def _shift_of(motion: Homography, stack: PhotoStack) -> float:
    """The motion of the middle of the picture, px of the stack."""
    middle = np.array([[(stack.rgb.shape[2] - 1) / 2, (stack.rgb.shape[1] - 1) / 2]])
    return float(np.hypot(*(moved(motion, middle) - middle)[0]))


def _motions(
    stack: PhotoStack, found: Sequence[Finding], board: PhotoStack | None
) -> tuple[dict[int, Homography], Homography | None]:
    """Return the homographies of photos that lie off the group by little, and that of the board's photo if it does."""
    farthest = FARTHEST_PX * stack.rgb.shape[2] / REFERENCE_PX
    limit = ROLLED * FARTHEST_PX * stack.full_width / REFERENCE_PX
    near = [finding for finding in found if _is_motion(finding) and finding.value <= limit]
    off = {finding.photo for finding in near if finding.drop}
    useless = {finding.photo for finding in found if finding.drop} - off
    indices = [i for i, path in enumerate(stack.paths) if path not in useless]
    if not near or len(indices) < FEWEST_PHOTOS:
        return {}, None
    height, width = stack.rgb.shape[1:3]
    home = home_view(stack, indices, board)
    rotation = Rotation(focal_in_pixels(stack.focal_35mm, width, height), width, height)
    view, turns = home.alignment, {}
    for k, i in enumerate(indices):
        if stack.paths[i] in off:
            pair, start = (view.seen[k], view.brightness[k]), rotation.from_shift(view.shifts[k])
            turns[i], _ = view.points.refined(*pair, view.others[k], start, rotation.homography)
    own = {i: rotation.homography(one) for i, one in turns.items() if np.isfinite(one).all()}
    own = {i: motion for i, motion in own.items() if _shift_of(motion, stack) <= farthest}
    if board is None or len(near) == len(off):
        return own, None
    pair = (planes[0] for planes in textures_of(board, [0]))
    angles, _ = view.points.refined(*pair, 0, rotation.from_shift(home.shift), rotation.homography)
    return own, rotation.homography(angles) if np.isfinite(angles).all() else None
