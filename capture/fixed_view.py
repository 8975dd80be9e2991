"""Photos that do not show what the others show: camera moved, blurred, another scene, something in front of it.

Every photo is compared with the fine texture that the photos have in common (capture.fine_texture): that of the half
of the photos that it is not in, or its own noise, which never moves, would pass for texture. Where the camera moved for
good, the larger group of photos says what the view is.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float

from capture.finding import Finding
from capture.fine_texture import (
    MAD_TO_SIGMA,
    Correlator,
    Plane,
    Points,
    is_lit,
    middle_of,
    moved_back,
    texture_of,
)
from capture.photo import PhotoStack

MOVED_PX = 0.6  # at REFERENCE_PX; every shadow edge is wrong by as much. Good photos gave 0.5 at most, on faint grain
MOVED_SIGMAS = 5.0  # of the shift, and of how much the photos' shifts differ
REFERENCE_PX = 1024  # long side for which MOVED_PX is stated
ANCHORS = 8  # photos that all others are compared with, to find the larger group
GROUP_PX = 0.6  # shifts by correlation that belong together are nearer than this to their middle
# Of what differs from the common texture, at most so much is left where a moved photo is moved back: shifts of 1 to 3
# px left 0.03 to 0.66, shading that was taken for a shift 0.78 and more.
EXPLAINED = 0.75
STILL_PX = 0.25  # smaller shifts are not moved back: nothing measured here would change
BLURRED = 0.8  # contrast of fixed texture; good photos gave 0.88 and more, 9 px of shake 0.75 and less
STILL_SHARP = 0.9  # median slope of cells, over the whole picture, from which no photo is blurred
BLUR_SIGMAS = 6.0  # so far below the others as well: on rough or glossy ground light itself changes it
CONTRAST_NOISE = 0.02  # one sigma of contrast at best
STRONG = 99  # percentile of texture strength from which a pixel takes part in the contrast
FEWEST_PIXELS = 200
REPEATS = 0.7  # slope between the textures of the two halves; less is noise, and nothing can be told
FEWEST_PHOTOS = 4
CELLS_ALONG = 32  # cells of the picture along its long side, each of which shows the common texture or does not
SHOWN, MISSING = 0.5, 0.3  # slope of a cell's texture over the common one: there; hidden by something
STEADY = 0.8  # share of the lit photos that must show a cell's texture: else light makes it
COVERED = 0.01  # of the picture, in one piece; good photos gave 0.4 % on the faintest grain
OFTEN = 0.25  # of the photos: what hides texture in more of them is gloss, not a hand
SHARP = 0.85  # strength of a photo's own texture, over the usual; good photos gave 0.95 and more
COARSER = 8  # times smaller pictures, in which a blurred photo still shows what the others do
SAME_VIEW = 0.5  # median slope of cells, from which two photos show the same from the same place
SAME_SCENE = 0.2  # correlation of coarse texture: other scenes gave 0.08 at most, 8 px of blur 0.27 and more


@dataclass(frozen=True)
class _View:
    """The photos as textures, each moved to where the others are, and what each half of them has in common."""

    textures: list[Plane]
    brightness: list[Plane]
    halves: tuple[Plane, Plane]
    others: list[int]  # the half that each photo is compared with

    def common(self, photo: int) -> Plane:
        return self.halves[self.others[photo]]

    def in_cells(self, values: Plane) -> Float[np.ndarray, "rows columns"]:
        """The mean of each cell."""
        side = max(max(self.halves[0].shape) // CELLS_ALONG, 1)
        rows, columns = values.shape[0] // side, values.shape[1] // side
        return values[: rows * side, : columns * side].reshape(rows, side, columns, side).mean((1, 3))

    def lit_cells(self, photo: int) -> Bool[np.ndarray, "rows columns"]:
        """Cells that the photo's light reaches everywhere."""
        return self.in_cells(is_lit(self.brightness[photo]).astype(np.float32)) == 1


def view_findings(stack: PhotoStack, indices: Sequence[int]) -> list[Finding]:
    """What is wrong with some photos' views; 4 photos at least."""
    brightness = [stack.rgb[i].mean(2) * stack.gains[i] for i in indices]
    textures = [texture_of(stack.rgb[i]) for i in indices]
    shifts, sigmas, view = _aligned(textures, brightness)
    lengths = np.nan_to_num(np.hypot(*shifts.T))
    limits = _motion_limits(stack, lengths, sigmas)
    shown, steady = _cells(view)
    low = _low_contrast(_contrasts(view))
    found = []
    for k, i in enumerate(indices):
        told = shown[k][steady & np.isfinite(shown[k])]
        path, seen = stack.paths[i], float(np.median(told)) if len(told) else np.nan
        has_moved = lengths[k] > limits[k] and not seen < SAME_VIEW and _is_explained(view, textures[k], k, steady)
        if ((k in low and not seen > STILL_SHARP) or seen < SAME_VIEW) and not has_moved:
            contrast = low.get(k, (seen, SAME_VIEW))
            found.append(_blurred_or_another(path, *contrast, _own_strength(view, k), _coarse_match(stack, indices, k)))
        elif has_moved:
            found.append(_moved(stack, path, float(lengths[k]), float(limits[k])))
        elif (share := _hidden_share(shown[k], steady)) > COVERED:
            text = f"something that the other photos do not show covers at least {share:.0%} of the picture"
            found.append(Finding(path, "covered", f"{text}, {COVERED:.0%} may be", share, COVERED, True))
    many = sum(finding.kind == "covered" for finding in found) > OFTEN * len(indices)
    return [finding for finding in found if not (many and finding.kind == "covered")]


def _aligned(
    textures: list[Plane], brightness: list[Plane]
) -> tuple[Float[np.ndarray, "photos 2"], Float[np.ndarray, "photos"], _View]:
    """By how much each photo lies off the larger group of them, one sigma of that, and the photos without it."""
    correlator = Correlator.over(textures)
    shifts = _coarse_shifts(textures, correlator)
    group = ~(np.hypot(*np.nan_to_num(shifts).T) > GROUP_PX)
    sigmas = np.full(len(textures), np.nan)
    halves, others = (textures[0], textures[0]), [0] * len(textures)
    for _ in range(2):  # a second time where the first group turns out to be two
        places = np.flatnonzero(group)
        halves = (middle_of([textures[k] for k in places[::2]]), middle_of([textures[k] for k in places[1::2]]))
        others = [int((np.searchsorted(places, k) + 1) % 2) for k in range(len(textures))]
        points = Points.of(halves)
        common = [correlator.spectra(half) for half in halves]
        for k in np.flatnonzero(np.isnan(shifts[:, 0])):  # many photos together are clearer than one
            shifts[k] = correlator.shift(correlator.spectra(textures[k]), common[others[k]])
        start = np.nan_to_num(shifts)
        found = [
            points.refined(*pair, others[k], start[k]) for k, pair in enumerate(zip(textures, brightness, strict=True))
        ]
        shifts, sigmas = np.array([shift for shift, _ in found]), np.array([sigma for _, sigma in found])
        middle, near = _densest(shifts, 0.5 * _allowed(textures[0]))
        told = np.isfinite(shifts).all(1)
        if near.sum() < FEWEST_PHOTOS or (told & group & ~near).sum() < 2:
            break
        shifts, group = shifts - middle, near
    still = [moved_back(t, s) if np.hypot(*s) > STILL_PX else t for t, s in zip(textures, shifts, strict=True)]
    return shifts, sigmas, _View(still, brightness, halves, others)


def _coarse_shifts(textures: list[Plane], correlator: Correlator) -> Float[np.ndarray, "photos 2"]:
    """Shifts against the larger group, by correlation with single photos; NaN where none is clear."""
    anchors = np.unique(np.linspace(0, len(textures) - 1, ANCHORS).round().astype(int))
    kept = [correlator.spectra(textures[a]) for a in anchors]
    seen = np.full((len(anchors), len(textures), 2), np.nan)
    for k, texture in enumerate(textures):
        spectra = correlator.spectra(texture)
        for row, anchor in enumerate(kept):
            seen[row, k] = 0.0 if anchors[row] == k else correlator.shift(spectra, anchor)
    groups = [_densest(row, GROUP_PX) for row in seen]
    shifts = np.full((len(textures), 2), np.nan)
    for row in sorted(range(len(anchors)), key=lambda row: -int(groups[row][1].sum())):
        middle, near = groups[row]
        if near.sum() >= FEWEST_PHOTOS:
            shifts = np.where(np.isfinite(shifts), shifts, seen[row] - middle)
    return shifts


def _densest(
    shifts: Float[np.ndarray, "photos 2"], radius: float
) -> tuple[Float[np.ndarray, "2"], Bool[np.ndarray, "photos"]]:
    """The middle of the largest group of shifts, and which photos belong to it."""
    apart = np.linalg.norm(shifts[:, None] - shifts, axis=-1)
    near = apart < radius
    chosen = near[np.argmax(near.sum(1))]
    if not chosen.any():
        return np.zeros(2), chosen
    middle = np.median(shifts[chosen], axis=0)
    return middle, np.linalg.norm(shifts - middle, axis=1) < radius


def _motion_limits(
    stack: PhotoStack, lengths: Float[np.ndarray, "photos"], sigmas: Float[np.ndarray, "photos"]
) -> Float[np.ndarray, "photos"]:
    """From which shift on a photo counts as moved, px of the stack."""
    usual = MAD_TO_SIGMA * float(np.median(lengths))
    return np.maximum(_allowed(stack.rgb[0, ..., 0]), MOVED_SIGMAS * np.hypot(np.nan_to_num(sigmas), usual))


def _is_explained(view: _View, unmoved: Plane, photo: int, steady: Bool[np.ndarray, "rows columns"]) -> bool:
    """Whether a photo agrees better with the common texture when it is moved back; False where none is told."""
    asked = steady & view.lit_cells(photo)
    left, before = (
        float(view.in_cells((texture - view.common(photo)) ** 2)[asked].sum())
        for texture in (view.textures[photo], unmoved)
    )
    return left < EXPLAINED * before


def _allowed(picture: Plane) -> float:
    """MOVED_PX in px of this picture."""
    return MOVED_PX * max(picture.shape) / REFERENCE_PX


def _moved(stack: PhotoStack, path: Path, length: float, limit: float) -> Finding:
    to_file = stack.full_width / stack.rgb.shape[2]
    text = f"the view lies {length * to_file:.1f} px off the other photos, {limit * to_file:.1f} px may be: "
    text += "did the tripod move?"
    return Finding(path, "camera moved", text, length * to_file, limit * to_file, True)


def _blurred_or_another(path: Path, contrast: float, limit: float, own: float, coarse: float) -> Finding:
    """The name of what leaves little of the common texture in a photo.

    Args:
        own: strength of its own texture, over the usual.
        coarse: correlation of its coarse texture with the common one.
    """
    if coarse < SAME_SCENE or (own > SHARP and contrast < MISSING):
        text = f"it shows {max(contrast, 0):.2f} times the texture that the others have in common, {limit:.2f} needed, "
        text += f"and has {own:.2f} times as much of its own: another object or another view"
        return Finding(path, "another scene", text, contrast, limit, True)
    why = "shaken or out of focus" if own < SHARP else "shaken, out of focus, or the camera was turned"
    text = f"fixed texture has {contrast:.2f} times its usual contrast, {limit:.2f} needed: {why}"
    return Finding(path, "blurred", text, contrast, limit, True)


def _low_contrast(contrasts: Float[np.ndarray, "photos axes"]) -> dict[int, tuple[float, float]]:
    """Contrast and limit of photos far below the others; an axis weighs the more the less the photos differ in it."""
    axes = contrasts[:, np.isfinite(contrasts).any(0)]
    told = np.flatnonzero(np.isfinite(axes).any(1))
    if len(told) < FEWEST_PHOTOS:
        return {}
    relative = axes[told] / np.nanmedian(axes, 0)
    weights = np.where(np.isfinite(relative), 1 / (_spread(relative) ** 2 + CONTRAST_NOISE**2), 0)
    values = (np.nan_to_num(relative) * weights).sum(1) / weights.sum(1)
    limit = min(BLURRED, 1 - BLUR_SIGMAS * float(_spread(values[:, None])[0]))
    return {int(k): (float(value), limit) for k, value in zip(told, values, strict=True) if value < limit}


def _spread(values: Float[np.ndarray, "photos columns"]) -> Float[np.ndarray, "columns"]:
    """One sigma of each column, from the median absolute deviation."""
    return MAD_TO_SIGMA * np.nanmedian(np.abs(values - np.nanmedian(values, 0)), 0)


def _contrasts(view: _View) -> Float[np.ndarray, "photos axes"]:
    """Slope of each photo's texture over that of the other half, from one pixel to the next: down, and to the right.

    Shake along one axis leaves the texture of the other. NaN where the halves do not agree on any texture, or where too
    little of it is lit.
    """
    contrasts = np.full((len(view.textures), 2), np.nan)
    for axis in (0, 1):
        first, second = (np.diff(half, axis=axis) for half in view.halves)
        strength = np.where(first * second > 0, np.minimum(np.abs(first), np.abs(second)), 0)
        strong = strength >= max(float(np.percentile(strength, STRONG)), np.finfo(np.float32).tiny)
        one_sided = np.abs(first) >= np.percentile(np.abs(first), STRONG)
        if np.median(second[one_sided] / first[one_sided]) < REPEATS:
            continue
        for k, texture in enumerate(view.textures):
            usable = np.diff(texture, axis=axis)
            pixels = strong & is_lit(view.brightness[k][: usable.shape[0], : usable.shape[1]])
            if pixels.sum() >= FEWEST_PIXELS:
                contrasts[k, axis] = np.median(usable[pixels] / (first, second)[view.others[k]][pixels])
    return contrasts


def _cells(view: _View) -> tuple[Float[np.ndarray, "photos rows columns"], Bool[np.ndarray, "rows columns"]]:
    """How much of the common texture each cell of each photo shows (NaN: not lit), and where nearly all photos do."""
    strength = [view.in_cells(half * half) + np.finfo(float).tiny for half in view.halves]
    agree = view.in_cells(view.halves[0] * view.halves[1]) / np.sqrt(strength[0] * strength[1])
    shown = []
    for k, (texture, other) in enumerate(zip(view.textures, view.others, strict=True)):
        alike = view.in_cells(texture * view.halves[other]) / strength[other]
        shown.append(np.where(view.lit_cells(k), alike, np.nan))
    shown = np.array(shown)
    lit = np.isfinite(shown).sum(0)
    steady = (shown > SHOWN).sum(0) > STEADY * np.maximum(lit, FEWEST_PHOTOS - 1)
    return shown, steady & (agree > SHOWN)


def _hidden_share(shown: Float[np.ndarray, "rows columns"], steady: Bool[np.ndarray, "rows columns"]) -> float:
    """The share of the picture in the largest piece where a photo lacks what nearly all others show."""
    hidden = (shown < MISSING) & steady
    pieces = cv2.connectedComponentsWithStats(hidden.astype(np.uint8), connectivity=4)[2]
    return float(pieces[1:, cv2.CC_STAT_AREA].max(initial=0)) / hidden.size


def _own_strength(view: _View, photo: int) -> float:
    """Strength of a photo's own texture over the common one, wherever it lies; cells that are not lit do not count."""
    lit = view.lit_cells(photo)
    ratio = view.in_cells(view.textures[photo] ** 2) / (view.in_cells(view.common(photo) ** 2) + 1e-12)
    return float(np.sqrt(np.median(ratio[lit]))) if lit.any() else 1.0


def _coarse_match(stack: PhotoStack, indices: Sequence[int], photo: int) -> float:
    """Correlation of one photo's coarse texture with what the others have in common: blur weakens, but leaves it."""
    size = (stack.rgb.shape[2] // COARSER, stack.rgb.shape[1] // COARSER)
    some = [k for k in np.linspace(0, len(indices) - 1, 2 * ANCHORS).astype(int) if k != photo]
    small = [cv2.resize(stack.rgb[indices[k]], size, interpolation=cv2.INTER_AREA) for k in (photo, *some)]
    own, *rest = (texture_of(picture) for picture in small)
    halves = (middle_of(rest[::2]), middle_of(rest[1::2]))
    view = _View([own], [small[0].mean(2) * stack.gains[indices[photo]]], halves, [0])
    agree = halves[0] * halves[1] > 0
    strength = np.where(agree, np.minimum(np.abs(halves[0]), np.abs(halves[1])), 0)
    pixels = (strength > np.median(strength)) & is_lit(view.brightness[0])
    if not pixels.any():
        return 1.0
    common, seen = halves[0][pixels], own[pixels]
    return float((common * seen).sum() / np.sqrt(max((common**2).sum() * (seen**2).sum(), 1e-20)))
