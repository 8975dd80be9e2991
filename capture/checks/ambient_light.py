"""Measure how dark the shadows are: light other than the flashlight's brightens them, in all photos or in one.

Every pixel is compared with its median over the photos, so albedo cancels. Cast shadows are then the darkest part of
a photo, nearly all of one level. In captures rendered without room light their darkest part had 0.0 to 0.1 % of the
usual light: lit surfaces reflect less there than the noise. With 2 to 3 % of room light it had 2.2 to 4.3 %. Photos
whose darkest part is not of one level have no clear shadow and give no estimate.

Room light is not even, and the usual light differs from place to place, so photos are compared with each other where
their shadows overlap. Good photos of one capture differ by 0.1 % there (one sigma). The room's light also shows the
exposure of a photo: it does not depend on the flashlight's place.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from capture.checks.mixture import levels, usual_level
from capture.checks.robust import cauchy, spread
from capture.photos.channels import mean_of_channels
from capture.photos.finding import Finding
from capture.photos.photo import PhotoStack, smaller

LONG_SIDE = 160  # px: shadows are larger than one of these
DIM = 0.02  # usual brightness below which ratios are noise
# Of the picture: what is darker than the shadows' level, and how much has to be in shadow; then for small shadows.
SIZES = ((0.003, 0.01), (0.001, 0.003))
LEVEL, AROUND = 0.03, 0.1  # above that: what still belongs to the level, and what has to be rare beside it
UNEVEN = 0.4  # of the level, by which room light may differ within a shadow
ONE_LEVEL = 0.7  # of the pixels AROUND that have to belong to the LEVEL
BRIGHTEST = 0.3  # a darkest part brighter than this is no shadow
FEWEST_PHOTOS = 4
FEWEST_TO_COMPARE = 8  # of fewer, the median lies in shadow in places, and few shadows overlap
CLEAR_IN = 0.5  # of the photos, from which on the darkest parts are shadows, and tell of the room
FEWEST_PIXELS = 20  # that a photo's shadow has to share with those of others
ROOM_LIGHT = 0.05  # in all photos, as docs/report.md has it; rooms that are dark enough gave 2.2 to 4.3 %
ALIKE = 0.0008  # mean deviation of the light in the shadows of good photos: 0.1 % of the usual light is one sigma
SPOILT = 0.05  # above the others: shading and shadows of such a photo mislead
VOTES = 6  # of the robust fit
CUT = 2.0  # sigmas at which a pixel counts half (Cauchy)

Ratios = Float[np.ndarray, "photos pixels"]


@dataclass(frozen=True)
class Shadows:
    """Brightness over the usual brightness, and where each photo is in cast shadow."""

    ratios: Ratios
    levels: Float[np.ndarray, " photos"]  # of the darkest part; NaN where no shadow is clear
    inside: Bool[np.ndarray, "photos pixels"]

    def of(self, photos: Bool[np.ndarray, " photos"]) -> "Shadows":
        """Return those of some photos."""
        return Shadows(self.ratios[photos], self.levels[photos], self.inside[photos])


def find_shadows(stack: PhotoStack, good: Sequence[bool], dark: PhotoStack | None = None) -> Shadows:
    """The shadows of each photo, in small pictures.

    Args:
        good: photos that are looked at; another view or a hand has other dark places.
        dark: photos without flashlight, which are taken off.
    """
    small = _small(stack)
    if dark is not None:
        small = np.maximum(small - _small(dark).mean(0), 0)
    usual = np.median(small, axis=0)  # of all: a few good ones lie in shadow together in places
    ratios = small[:, usual > DIM] / usual[usual > DIM]
    levels, inside = np.full(len(ratios), np.nan), np.zeros(ratios.shape, bool)
    for k, values in enumerate(np.sort(ratios, axis=1)):
        for darker, fewest in SIZES if values.size and good[k] else ():
            darkest = values[int(darker * len(values))]
            still = np.array([LEVEL, AROUND]) + UNEVEN * darkest * np.array([1, 2])
            shadow, around = np.searchsorted(values, darkest + still) / len(values)
            if shadow >= fewest and shadow > ONE_LEVEL * around and darkest < BRIGHTEST:
                levels[k], inside[k] = darkest, ratios[k] < darkest + still[0]
                break
    return Shadows(ratios, levels, inside)


def _small(stack: PhotoStack) -> Float[np.ndarray, "photos rows columns"]:
    return np.stack([mean_of_channels(smaller(rgb, LONG_SIDE)) for rgb in stack.rgb])


def excess(shadows: Shadows) -> Float[np.ndarray, " photos"]:
    """Return by how much each photo's shadows are brighter than others at the same places; NaN without an estimate.

    ratio[k, x] = place[x] + excess[k], by least squares with robust weights; median excess 0.
    """
    asked = shadows.inside & np.isfinite(shadows.levels)[:, None]
    shared = asked.sum(0) >= 2
    asked, ratios = asked[:, shared], shadows.ratios[:, shared]
    known = asked.sum(1) >= FEWEST_PIXELS
    more = np.full(len(ratios), np.nan)
    if known.sum() < FEWEST_PHOTOS:
        return more
    weight, fitted = asked.astype(float), np.zeros(len(ratios))
    for _ in range(VOTES):
        total = np.maximum(weight.sum(0), np.finfo(float).tiny)
        normal = np.diag(weight.sum(1)) - (weight / total) @ weight.T
        pull = (weight * (ratios - (weight * ratios).sum(0) / total)).sum(1)
        fitted = np.linalg.lstsq(normal, pull, rcond=None)[0]
        place = (weight * (ratios - fitted[:, None])).sum(0) / total
        off = ratios - fitted[:, None] - place
        sigma = spread(off[asked]) + np.finfo(np.float32).eps
        weight = np.where(asked, cauchy((off / (CUT * sigma)) ** 2), 0.0)
    more[known] = fitted[known] - np.median(fitted[known])
    return more


def _apart(shadows: Shadows) -> dict[int, float]:
    """Photos with more or less light in their shadows than those that are right, and by how much.

    The largest group is right. A smaller one with less is right instead, if its photos are not darker all over by as
    much: these were not exposed less, but the others had the room light on.
    """
    more = excess(shadows)
    if np.isfinite(more).sum() < FEWEST_TO_COMPARE:
        return {}
    own = levels(more, ALIKE)
    right, room = usual_level(own), float(np.nanmedian(shadows.levels))
    bright = np.log(np.maximum(np.median(shadows.ratios, axis=1), DIM))
    for lower in np.unique(own[own < right]):
        less = np.log(max(room + lower, ALIKE) / max(room + right, ALIKE))
        dimmed = np.median(bright[own == lower]) - np.median(bright[own == right])
        if abs(dimmed) < abs(dimmed - less) and (own == lower).sum() >= FEWEST_PHOTOS:
            right = float(lower)
            break
    return {int(k): float(more[k] - right) for k in np.flatnonzero(np.isfinite(own) & (own != right))}


def _apart_finding(path: Path, more: float) -> Finding:
    """Return the finding for a photo whose shadows differ from those of the others."""
    than = f"shadows have {abs(more):.1%} of the usual light {'more' if more > 0 else 'less'} than other photos have "
    than += "at the same places: "
    if more > 0:
        return Finding(path, "ambient light", f"{than}was a lamp or a door open?", more, SPOILT, more > SPOILT)
    text = f"{than}exposed less, which the file does not tell? Lock the exposure next time"
    return Finding(path, "exposure changed", text, more, SPOILT, False)


def shadow_findings(stack: PhotoStack, good: Sequence[bool], dark: PhotoStack | None = None) -> list[Finding]:
    """Find photos whose shadows contain light of other sources, or less of it than in the other photos.

    Args:
        good: photos that can be assessed.
        dark: photos without flashlight, which are subtracted.
    """
    shadows = find_shadows(stack, good, dark)
    known = shadows.levels[np.isfinite(shadows.levels)]
    if len(known) < FEWEST_PHOTOS:
        return []
    middle, apart = float(np.median(known)), _apart(shadows)
    everywhere = middle > ROOM_LIGHT and len(known) >= CLEAR_IN * sum(good)
    found = []
    for k, (path, level) in enumerate(zip(stack.paths, shadows.levels.tolist(), strict=True)):
        if k in apart:
            found.append(_apart_finding(path, apart[k]))
        elif everywhere and good[k]:
            own = np.isfinite(level)
            text = f"shadows{'' if own else ' of the other photos'} have {level if own else middle:.1%} of the usual "
            text += (
                f"light, at most {ROOM_LIGHT:.0%} is fine: darken the room, or add photos without flashlight in dark/"
            )
            found.append(Finding(path, "ambient light", text, level if own else middle, ROOM_LIGHT, False))
    return found
