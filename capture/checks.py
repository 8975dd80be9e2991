"""Photos that would spoil a reconstruction: flash off, over-exposed, blurred, camera moved.

Blur and motion are measured against what all photos have in common: the median over photos of the fine texture (of the
logarithm of brightness, so that light does not scale it). It keeps the grain of table and object and loses the edges of
shadows, which move. Each photo is compared with the half of the photos that it is not in, or its own noise, which never
moves, would pass for texture.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Complex, Float, Int

from capture.atomic import read_json, write_json
from capture.photo import PhotoStack
from capture.radiometry import WHITE_BALANCE

FLASH_OFF = 0.2  # brightness over the median photo's; flashlights at 0.4 to 0.9 m gave 0.4 and more, no flash 0.05
BRIGHT_PART = 75  # percentile that stands for a photo's brightness: a low flashlight leaves much of the table dim
SATURATED = 0.98  # of full scale, before exposure is divided out
OVER_EXPOSED_WARN = 0.05  # share of saturated pixels
OVER_EXPOSED_DROP = 0.30
EXPOSURE_CHANGED = 0.02  # of the median photo's exposure; smaller differences are EXIF rounding
BLURRED = 0.8  # contrast of fixed texture; good photos gave 0.88 and more, 9 px of shake 0.75 and less
BLUR_SIGMAS = 6.0  # so far below the others as well: on rough or glossy ground light itself changes it
CONTRAST_NOISE = 0.02  # one sigma of contrast at best
MOVED_PX = 1.0  # at REFERENCE_PX; good photos gave 0.63 at most, and every shadow edge is wrong by as much
MOVED_GAIN = 0.05  # contrast that moving the photo back has to win, or the correlation peaked at something else
FINEST_PX = 0.5  # shifts below this many px of the stack are not measured well enough
REFERENCE_PX = 1024  # long side for which MOVED_PX is stated
BLACK = 0.004  # added to brightness before the logarithm: about one step of 8-bit sRGB
DIM = 0.02  # brightness below which noise and BLACK govern the contrast
BRIGHT = 0.9  # brightness above which saturation does
FINE_PX, COARSE_PX = 0.8, 2.5  # scales between which texture is looked at
EDGE = 0.3  # texture is cut off here, so that no single edge governs the correlation
HALF_PHOTOS = 16  # per half: enough for a median without shadows, more only cost time
STRONG = 99  # percentile of texture strength from which a pixel takes part in the contrast
FEWEST_PIXELS = 200
REPEATS = 0.7  # slope between the textures of the two halves; less is noise, and nothing can be told
TILES = 24  # strongest tiles, that correlate; the other half of a photo is plain or dark
TILES_ALONG = 8  # along the long side
PASS_BAND = 0.15  # cycles per px to which the correlation listens; above lies noise
CLEAR_PEAK = 1.5  # highest correlation over the highest one elsewhere; good photos on the faintest grain gave 1.68
PEAK_PX = 4  # radius that belongs to a peak
FEWEST_PHOTOS = 4
KEPT = "findings.json"
MAD_TO_SIGMA = 1.4826  # of a normal distribution


@dataclass(frozen=True)
class Finding:
    """One fault of one photo: what was measured, the limit, and whether the photo has to be left out."""

    photo: Path
    kind: str  # "flash off" | "over-exposed" | "exposure changed" | "blurred" | "camera moved"
    text: str
    value: float
    limit: float
    drop: bool


Plane = Float[np.ndarray, "height width"]


@dataclass(frozen=True)
class _Half:
    """What one half of the photos has in common: its median texture, and the spectra of the chosen tiles."""

    texture: Plane
    spectra: Complex[np.ndarray, "tiles rows columns"]


def check_stack(stack: PhotoStack, dark: PhotoStack | None = None) -> tuple[Finding, ...]:
    """Every fault found in the lit photos, in their order; a photo without findings is fine.

    Args:
        stack: lit photos of one fixed camera.
        dark: the same view with the flashlight off, read with `reference=stack.reference`.
    """
    found = [*_brightness_findings(stack, dark)]
    useless = {finding.photo for finding in found if finding.drop}
    indices = [i for i, path in enumerate(stack.paths) if path not in useless]
    if len(indices) >= FEWEST_PHOTOS:
        found += _texture_findings(stack, indices)
    order = {path: i for i, path in enumerate(stack.paths)}
    return tuple(sorted(found, key=lambda finding: order[finding.photo]))


def keep_findings(folder: Path, findings: Sequence[Finding]) -> None:
    """Write what was found into a folder, for `kept_findings`."""
    write_json(folder / KEPT, [asdict(finding) | {"photo": str(finding.photo)} for finding in findings])


def kept_findings(folder: Path, photos: Sequence[Path]) -> tuple[Finding, ...] | None:
    """What was found in these photos by an earlier invocation; None where that is not known."""
    by_name = {str(photo): photo for photo in photos}
    try:
        rows = read_json(folder / KEPT)
        return tuple(Finding(**row | {"photo": by_name[row["photo"]]}) for row in rows)
    except (OSError, ValueError, KeyError, TypeError):
        return None


def white_balance_finding(photo: Path, ratio: float) -> Finding:
    """What to say of a photo whose white balance was divided out.

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
        saturated = float((rgb.max(2) * gain >= SATURATED).mean())
        if saturated > OVER_EXPOSED_WARN:
            drop = saturated > OVER_EXPOSED_DROP
            text = f"{saturated:.0%} of the pixels are saturated, {OVER_EXPOSED_DROP:.0%} may be: expose less"
            limit = OVER_EXPOSED_DROP if drop else OVER_EXPOSED_WARN
            found.append(Finding(path, "over-exposed", text, saturated, limit, drop))
    return found


def _levels(stack: PhotoStack) -> Float[np.ndarray, "photos"]:
    thinned = stack.rgb[:, ::4, ::4].mean(3)  # a percentile needs no more pixels than that
    return np.percentile(thinned.reshape(len(thinned), -1), BRIGHT_PART, axis=1)


def _texture_findings(stack: PhotoStack, indices: list[int]) -> list[Finding]:
    textures = [_texture(stack.rgb[i]) for i in indices]
    medians = [_median(textures[half::2]) for half in (0, 1)]
    tile = max(stack.rgb.shape[1:3]) // TILES_ALONG
    strength = np.minimum(*(np.abs(_tiles(median, tile)).mean((1, 2)) for median in medians))
    chosen = np.argsort(-strength)[:TILES]
    halves = [_Half(median, _spectra(median, tile, chosen)) for median in medians]
    others = [halves[1 - place % 2] for place in range(len(indices))]
    shifts = [
        _shift(_spectra(texture, tile, chosen), other, tile) for texture, other in zip(textures, others, strict=True)
    ]
    brightness = [stack.rgb[i].mean(2) * stack.gains[i] for i in indices]
    contrasts = _contrasts(textures, brightness, others, halves)
    still = [_moved_back(texture, shift) for texture, shift in zip(textures, shifts, strict=True)]
    contrasts_still = _contrasts(still, brightness, others, halves)
    has_moved = np.any(contrasts_still > contrasts + MOVED_GAIN, axis=1)  # False where no texture can be told
    contrasts = np.where(np.expand_dims(has_moved, 1), contrasts_still, contrasts)
    paths = [stack.paths[i] for i in indices]
    blurred = _blur_findings(paths, contrasts)
    # Where blur leaves no texture, the correlation peaks anywhere: such a photo is blurred, not moved.
    told = {finding.photo for finding in blurred}
    lengths = {p: float(np.hypot(*s)) for p, s, moved in zip(paths, shifts, has_moved, strict=True) if moved}
    return blurred + [finding for finding in _motion_findings(stack, lengths) if finding.photo not in told]


def _motion_findings(stack: PhotoStack, lengths: dict[Path, float]) -> list[Finding]:
    height, width = stack.rgb.shape[1:3]
    limit = max(MOVED_PX * max(height, width) / REFERENCE_PX, FINEST_PX)
    to_file = stack.full_width / width
    found = []
    for path, length in lengths.items():
        if length > limit:
            text = f"the view lies {length * to_file:.1f} px off the other photos, {limit * to_file:.1f} px may be: "
            text += "did the tripod move?"
            found.append(Finding(path, "camera moved", text, length * to_file, limit * to_file, True))
    return found


def _blur_findings(paths: list[Path], contrasts: Float[np.ndarray, "photos axes"]) -> list[Finding]:
    """Photos whose contrast is far below the others'; an axis weighs the more the less the photos differ in it."""
    axes = contrasts[:, np.isfinite(contrasts).any(0)]
    told = np.flatnonzero(np.isfinite(axes).any(1))
    if len(told) < FEWEST_PHOTOS:
        return []
    relative = axes[told] / np.nanmedian(axes, 0)
    weights = np.where(np.isfinite(relative), 1 / (_spread(relative) ** 2 + CONTRAST_NOISE**2), 0)
    values = (np.nan_to_num(relative) * weights).sum(1) / weights.sum(1)
    limit = min(BLURRED, 1 - BLUR_SIGMAS * float(_spread(values[:, None])[0]))
    text = "fixed texture has {:.2f} times its usual contrast, {:.2f} needed: shaken, out of focus, or moved far"
    return [
        Finding(paths[i], "blurred", text.format(value, limit), float(value), limit, True)
        for i, value in zip(told, values, strict=True)
        if value < limit
    ]


def _spread(values: Float[np.ndarray, "photos columns"]) -> Float[np.ndarray, "columns"]:
    """One sigma of each column, from the median absolute deviation."""
    return MAD_TO_SIGMA * np.nanmedian(np.abs(values - np.nanmedian(values, 0)), 0)


def _contrasts(
    textures: list[Plane], brightness: list[Plane], others: list[_Half], halves: list[_Half]
) -> Float[np.ndarray, "photos axes"]:
    """Slope of each photo's texture over that of the other half, from one pixel to the next: down, and to the right.

    Shake along one axis leaves the texture of the other. NaN where the halves do not agree on any texture, or where too
    little of it is lit.
    """
    contrasts = np.full((len(textures), 2), np.nan)
    for axis in (0, 1):
        first, second = (np.diff(half.texture, axis=axis) for half in halves)
        strength = np.where(first * second > 0, np.minimum(np.abs(first), np.abs(second)), 0)
        strong = strength >= max(float(np.percentile(strength, STRONG)), np.finfo(np.float32).tiny)
        one_sided = np.abs(first) >= np.percentile(np.abs(first), STRONG)
        if np.median(second[one_sided] / first[one_sided]) < REPEATS:
            continue
        for i, (texture, lit, other) in enumerate(zip(textures, brightness, others, strict=True)):
            usable = np.diff(texture, axis=axis)
            lit = lit[: usable.shape[0], : usable.shape[1]]
            pixels = strong & (lit > DIM) & (lit < BRIGHT)
            if pixels.sum() >= FEWEST_PIXELS:
                common = np.diff(other.texture, axis=axis)[pixels]
                contrasts[i, axis] = np.median(usable[pixels] / common)
    return contrasts


def _texture(rgb: Float[np.ndarray, "height width 3"]) -> Plane:
    log = np.log(np.maximum(rgb.mean(2), 0) + np.float32(BLACK))
    return cv2.GaussianBlur(log, (0, 0), FINE_PX) - cv2.GaussianBlur(log, (0, 0), COARSE_PX)


def _median(textures: list[Plane]) -> Plane:
    some = np.linspace(0, len(textures) - 1, min(len(textures), HALF_PHOTOS)).round().astype(int)
    return np.median(np.stack([textures[i] for i in some]), axis=0)


def _tiles(texture: Plane, side: int) -> Float[np.ndarray, "tiles side side"]:
    rows, columns = texture.shape[0] // side, texture.shape[1] // side
    cut = texture[: rows * side, : columns * side].reshape(rows, side, columns, side)
    return cut.transpose(0, 2, 1, 3).reshape(-1, side, side)


def _spectra(texture: Plane, tile: int, chosen: Int[np.ndarray, "tiles"]) -> Complex[np.ndarray, "tiles rows columns"]:
    tiles = np.clip(_tiles(texture, tile)[chosen], -EDGE, EDGE)
    window = np.hanning(tile)
    return np.fft.rfft2((tiles - tiles.mean((1, 2), keepdims=True)) * window[:, None] * window)


def _shift(spectra: Complex[np.ndarray, "tiles rows columns"], half: _Half, tile: int) -> tuple[float, float]:
    """By how many px (u, v) a photo lies off what the half has in common; (0, 0) where no clear peak tells.

    Phase correlation of tiles, added up: shadow edges correlate anywhere, fixed texture in one place.
    """
    product = spectra * np.conj(half.spectra)
    product /= np.abs(product) + np.finfo(float).tiny
    frequency = np.fft.fftfreq(tile)[:, None] ** 2 + np.fft.rfftfreq(tile) ** 2
    correlation = np.fft.irfft2((product * np.exp(-frequency / (2 * PASS_BAND**2))).sum(0), (tile, tile))
    correlation = np.fft.fftshift(correlation)
    row, column = np.unravel_index(np.argmax(correlation), correlation.shape)
    elsewhere = correlation.copy()
    elsewhere[max(0, row - PEAK_PX) : row + PEAK_PX + 1, max(0, column - PEAK_PX) : column + PEAK_PX + 1] = 0
    on_rim = min(row, column) < 1 or max(row, column) > tile - 2
    if on_rim or correlation[row, column] < CLEAR_PEAK * elsewhere.max():
        return 0.0, 0.0
    return (
        float(column - tile // 2 + _vertex(*correlation[row, column - 1 : column + 2])),
        float(row - tile // 2 + _vertex(*correlation[row - 1 : row + 2, column])),
    )


def _vertex(before: float, peak: float, after: float) -> float:
    """Where the parabola through three neighbouring values is highest, relative to the middle one."""
    return (after - before) / (2 * (2 * peak - before - after))


def _moved_back(texture: Plane, shift: tuple[float, float]) -> Plane:
    if not any(shift):
        return texture
    back = np.array([[1, 0, -shift[0]], [0, 1, -shift[1]]])
    return cv2.warpAffine(texture, back, texture.shape[::-1], flags=cv2.INTER_CUBIC)
