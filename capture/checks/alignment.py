"""Alignment: photos of one fixed view as textures, and the shift of each photo against a group of them.

Every photo is compared with the fine texture that the group has in common (capture.checks.registration). That texture
is taken from the half of the group that does not contain the photo; otherwise the photo's own noise, which never moves,
would count as texture.

Choose the group of photos that the calibration belongs to: the one whose camera took the photo of the board.

The table around the board shows the same texture as under the flashlight. The parts of the picture that agree with the
photos determine where the camera stood. A moved tripod splits photos into groups. The board's group is used, however
small, because camera and ground are known for it only. If the board gives no answer, the largest group is used.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from capture.checks.registration import (
    Correlator,
    Plane,
    Points,
    Shift,
    is_lit,
    middle_of,
    moved_back,
    sigma_along,
    texture_of,
)
from capture.photos.channels import in_blocks, mean_of_channels
from capture.photos.finding import Finding
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
BOARD_SHOWS = 0.1  # of the cells have to show the photos' texture: boards left 0.64 and more of it to see
MOVED, BOARD_OFF = "camera moved", "camera moved from board"  # kinds of finding
BOARD_PX = 3.0  # at common_view.REFERENCE_PX: about 0.2 degrees of a phone's view, which the ground's slope may be off
BOARD_SIGMAS = 5.0  # of the shift as well; another focus than the photos' makes it uncertain


@dataclass(frozen=True)
class Alignment:
    """The photos as textures, compared with what each half of a group of them has in common."""

    seen: list[Plane]  # textures as photographed
    textures: list[Plane]  # moved to where the group is
    brightness: list[Plane]
    halves: tuple[Plane, Plane]
    others: list[int]  # the half that each photo is compared with
    points: Points  # of the halves, with which shifts were refined
    shifts: Float[np.ndarray, "photos 2"]  # px of the stack, u and v; NaN where nothing tells
    covariances: Float[np.ndarray, "photos 2 2"]  # of each shift, px^2; NaN likewise

    def common(self, photo: int) -> Plane:
        """The texture that a photo is compared with."""
        return self.halves[self.others[photo]]

    def outside(self) -> Bool[np.ndarray, " photos"]:
        """The photos that may lie off the group: their shift is unlike that of any good photo, or was not found."""
        return ~(np.hypot(*self.shifts.T) <= allowed_px(self.halves[0]))

    def slopes(self, texture: Plane, common: Plane) -> Float[np.ndarray, "rows columns"]:
        """How much of the common texture each cell of another one shows."""
        return in_cells(texture * common) / (in_cells(common * common) + np.finfo(float).tiny)

    def lit_cells(self, photo: int) -> Bool[np.ndarray, "rows columns"]:
        """Cells that the photo's light reaches everywhere."""
        return in_cells(is_lit(self.brightness[photo]).astype(np.float32)) == 1


def textures_of(stack: PhotoStack, indices: Sequence[int]) -> tuple[list[Plane], list[Plane]]:
    """Texture and brightness, over saturation, of some photos."""
    brightness = [mean_of_channels(stack.rgb[i]) * stack.gains[i] for i in indices]
    return [texture_of(stack.rgb[i]) for i in indices], brightness


def in_cells(values: Plane) -> Float[np.ndarray, "rows columns"]:
    """The mean of each cell."""
    return in_blocks(values, max(max(values.shape) // CELLS_ALONG, 1)).mean((2, 3))


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
    return Alignment(textures, still, brightness, halves, others, points, shifts, covariances)


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


@dataclass(frozen=True)
class HomeView:
    """The photos compared with the chosen group, and the photo of the board compared with it."""

    alignment: Alignment
    board: Path | None  # the photo of the board, where there is one of the photos' size
    shift: Shift  # of the photo of the board, px of the stack; NaN where nothing tells
    sigma: float  # along it
    pushed: frozenset[int] = frozenset()  # places of the photos of a larger group, which counted without the board

    @property
    def lengths(self) -> Float[np.ndarray, " photos"]:
        """Of the shifts off the group, px; 0 where nothing tells."""
        return np.nan_to_num(np.hypot(*self.alignment.shifts.T))

    @property
    def members(self) -> Int[np.ndarray, " members"]:
        """Places of the photos that tell what is usual: all, unless the board belongs to some of them only."""
        return np.flatnonzero(~self.alignment.outside()) if self.pushed else np.arange(len(self.alignment.seen))

    def fault(self, photo: Path) -> tuple[str, str]:
        """Return the kind of finding for a photo that lies off the group, and a name for the reference."""
        if not self.pushed or self.board is None:
            return MOVED, "the other photos"
        named = named_apart(self.board, photo)
        return BOARD_OFF, f"{named}, the photo of the board, and the {len(self.members)} photos that agree with it"


def home_view(stack: PhotoStack, indices: Sequence[int], board: PhotoStack | None) -> HomeView:
    """Compare the photos with those of the board's camera, or with the largest group if the board gives no answer.

    Args:
        board: the tripod's photo of the board.
    """
    textures, brightness = textures_of(stack, indices)
    largest = align(textures, brightness, np.arange(len(textures)))
    if board is None or board.rgb.shape[1:] != stack.rgb.shape[1:]:
        return HomeView(largest, None, np.full(2, np.nan), np.nan)
    correlator = Correlator.over(textures)
    texture, lit = (planes[0] for planes in textures_of(board, [0]))
    shift, sigma = shift_of_board(texture, lit, largest, correlator)
    limit, path = allowed_px(texture), board.paths[0]
    rest = np.flatnonzero(largest.outside())
    if not np.hypot(*shift) <= limit and len(rest) >= FEWEST_PHOTOS:
        other = align(textures, brightness, rest)
        off, its_sigma = shift_of_board(texture, lit, other, correlator)
        if np.hypot(*off) <= limit and (~other.outside()[rest]).sum() >= FEWEST_PHOTOS:
            pushed = frozenset(np.flatnonzero(~largest.outside()).tolist())
            return HomeView(other, path, off, its_sigma, pushed)
    return HomeView(largest, path, shift, sigma)


def board_findings(stack: PhotoStack, indices: Sequence[int], home: HomeView) -> list[Finding]:
    """Return a finding for each photo if the board's photo lies off every group that could be kept."""
    length = float(np.hypot(*home.shift))
    limit = max(allowed_px(home.alignment.seen[0]) * BOARD_PX / MOVED_PX, BOARD_SIGMAS * home.sigma)
    if home.board is None or not length > limit:
        return []
    length, limit, found = length * stack.to_file, limit * stack.to_file, []
    for k in home.members.tolist():
        path = stack.paths[indices[k]]
        text = f"the view lies {length:.1f} px off that of {named_apart(home.board, path)}, the photo of the board, "
        text += f"at most {limit:.1f} px is fine: did the tripod move in between?"
        found.append(Finding(path, BOARD_OFF, text, length, limit, False))
    return found


def named_apart(board: Path, photo: Path) -> str:
    """The name of the board's photo, with its folder where a photo may have the same name."""
    return board.name if board.parent == photo.parent else f"{board.parent.name}/{board.name}"


def shift_of_board(texture: Plane, brightness: Plane, view: Alignment, correlator: Correlator) -> tuple[Shift, float]:
    """Return the shift of the board's photo against a group, px, and one sigma; NaN if too little is shared."""
    starts = [np.zeros(2), *(correlator.shift(correlator.spectra(texture), correlator.spectra(h)) for h in view.halves)]
    start = max((one for one in starts if np.isfinite(one).all()), key=lambda one: _agreeing(texture, one, view))
    shift, covariance = view.points.refined(texture, brightness, 0, start)
    is_clear = np.isfinite(shift).all() and _agreeing(texture, shift, view) >= BOARD_SHOWS
    return (shift, sigma_along(covariance, shift)) if is_clear else (np.full(2, np.nan), np.nan)


def _agreeing(texture: Plane, shift: Shift, view: Alignment) -> float:
    """The share of cells in which a photo, moved back, correlates with what both halves have in common."""
    seen, common = moved_back(texture, shift), 0.5 * (view.halves[0] + view.halves[1])
    strength = in_cells(seen * seen) * in_cells(common * common)
    return float((in_cells(seen * common) > SHOWN * np.sqrt(strength)).mean())
