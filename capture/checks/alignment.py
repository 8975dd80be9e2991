"""CommonView: photos of one fixed view as textures, and the shift of each photo against a group of them.

Every photo is compared with the fine texture that the group has in common (capture.checks.registration). That texture
is taken from the half of the group that does not contain the photo; otherwise the photo's own noise, which never moves,
would count as texture.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from capture.checks.registration import Correlator, Plane, Points, is_lit, middle_of, moved_back, texture_of
from capture.photos.channels import mean_of_channels
from capture.photos.photo import PhotoStack

MOVED_PX = 0.6  # at REFERENCE_PX; every shadow edge is wrong by as much. Good photos gave 0.5 at most, on faint grain
REFERENCE_PX = 1024  # long side for which MOVED_PX is stated
ANCHORS = 8  # photos that all others are compared with, to find the largest group
GROUP_PX = 0.6  # shifts by correlation that belong together are nearer than this to their middle
STILL_PX = 0.25  # smaller shifts are not moved back: nothing measured here would change
CELLS_ALONG = 32  # cells of the picture along its long side, each of which shows the common texture or does not
SHOWN = 0.5  # of a cell's texture, as slope over the common one or as correlation with it, from which it is there
ROUNDS = 4  # at most, until the members are known: half of them a pixel off blur what they have in common
FEWEST_PHOTOS = 4  # that a group has to have, for halves of two


@dataclass(frozen=True)
class CommonView:
    """The photos as textures, each moved to where the group is, and what each half of the group has in common."""

    textures: list[Plane]
    brightness: list[Plane]
    halves: tuple[Plane, Plane]
    others: list[int]  # the half that each photo is compared with

    def common(self, photo: int) -> Plane:
        """The texture that a photo is compared with."""
        return self.halves[self.others[photo]]

    @property
    def cell_side(self) -> int:
        """Length of a cell's side, px."""
        return max(max(self.halves[0].shape) // CELLS_ALONG, 1)

    def in_cells(self, values: Plane) -> Float[np.ndarray, "rows columns"]:
        """The mean of each cell."""
        side = self.cell_side
        rows, columns = values.shape[0] // side, values.shape[1] // side
        return values[: rows * side, : columns * side].reshape(rows, side, columns, side).mean((1, 3))

    def slopes(self, texture: Plane, common: Plane) -> Float[np.ndarray, "rows columns"]:
        """How much of the common texture each cell of another one shows."""
        return self.in_cells(texture * common) / (self.in_cells(common * common) + np.finfo(float).tiny)

    def lit_cells(self, photo: int) -> Bool[np.ndarray, "rows columns"]:
        """Cells that the photo's light reaches everywhere."""
        return self.in_cells(is_lit(self.brightness[photo]).astype(np.float32)) == 1


@dataclass(frozen=True)
class Alignment:
    """Shifts of photos against a group of them."""

    shifts: Float[np.ndarray, "photos 2"]  # px of the stack, u and v; NaN where nothing tells
    covariances: Float[np.ndarray, "photos 2 2"]  # of each shift, px^2; NaN likewise
    view: CommonView
    points: Points  # of the halves, with which shifts were refined

    def outside(self) -> Bool[np.ndarray, " photos"]:
        """The photos that may lie off the group: their shift is unlike that of any good photo, or was not found."""
        return ~(np.hypot(*self.shifts.T) <= allowed_px(self.view.halves[0]))


def textures_of(stack: PhotoStack, indices: Sequence[int]) -> tuple[list[Plane], list[Plane]]:
    """Texture and brightness, over saturation, of some photos."""
    brightness = [mean_of_channels(stack.rgb[i]) * stack.gains[i] for i in indices]
    return [texture_of(stack.rgb[i]) for i in indices], brightness


def allowed_px(picture: Plane) -> float:
    """MOVED_PX in px of this picture."""
    return MOVED_PX * max(picture.shape) / REFERENCE_PX


def align(textures: list[Plane], brightness: list[Plane], among: Int[np.ndarray, " some"]) -> Alignment:
    """Return each photo's shift against the largest group among at least 4 of them."""
    correlator = Correlator.over(textures)
    shifts, group = np.full((len(textures), 2), np.nan), np.zeros(len(textures), bool)
    shifts[among] = _coarse_shifts([textures[k] for k in among], correlator)
    group[among] = ~(np.hypot(*np.nan_to_num(shifts[among]).T) > GROUP_PX)
    asked = np.isin(np.arange(len(textures)), among)[:, None]
    covariances = np.full((len(textures), 2, 2), np.nan)
    halves, others = (textures[0], textures[0]), [0] * len(textures)
    points = Points.of(halves)
    for _ in range(ROUNDS):  # again where the group turns out to be two
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
        shifts, covariances = (np.array(values) for values in zip(*found, strict=True))
        middle, near = densest(np.where(asked, shifts, np.nan), allowed_px(halves[0]) / 2)
        known = np.isfinite(shifts).all(1)
        if near.sum() < FEWEST_PHOTOS or (known & group & ~near).sum() < 2:
            break
        shifts, group = shifts - middle, near
    still = [moved_back(t, s) if np.hypot(*s) > STILL_PX else t for t, s in zip(textures, shifts, strict=True)]
    return Alignment(shifts, covariances, CommonView(still, brightness, halves, others), points)


def _coarse_shifts(textures: list[Plane], correlator: Correlator) -> Float[np.ndarray, "photos 2"]:
    """Return shifts against the largest group, by correlation with single photos; NaN where none is clear."""
    anchors = np.unique(np.linspace(0, len(textures) - 1, ANCHORS).round().astype(int))
    kept = [correlator.spectra(textures[a]) for a in anchors]
    seen = np.full((len(anchors), len(textures), 2), np.nan)
    for k, texture in enumerate(textures):
        spectra = correlator.spectra(texture)
        for row, anchor in enumerate(kept):
            seen[row, k] = 0.0 if anchors[row] == k else correlator.shift(spectra, anchor)
    groups = [densest(row, GROUP_PX) for row in seen]
    shifts = np.full((len(textures), 2), np.nan)
    for row in sorted(range(len(anchors)), key=lambda row: -int(groups[row][1].sum())):
        middle, near = groups[row]
        if near.sum() >= FEWEST_PHOTOS:
            shifts = np.where(np.isfinite(shifts), shifts, seen[row] - middle)
    return shifts


def densest(
    shifts: Float[np.ndarray, "photos 2"], radius: float
) -> tuple[Float[np.ndarray, "2"], Bool[np.ndarray, " photos"]]:
    """Return the middle of the largest group of shifts, and its members."""
    apart = np.linalg.norm(shifts[:, None] - shifts, axis=-1)
    near = apart < radius
    chosen = near[np.argmax(near.sum(1))]
    if not chosen.any():
        return np.zeros(2), chosen
    middle = np.median(shifts[chosen], axis=0)
    return middle, np.linalg.norm(shifts - middle, axis=1) < radius
