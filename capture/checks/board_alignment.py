"""Choose the group of photos that the calibration belongs to: the one whose camera took the photo of the board.

The table around the board shows the same texture as under the flashlight. The parts of the picture that agree with the
photos determine where the camera stood. A moved tripod splits photos into groups. The board's group is used, however
small, because camera and ground are known for it only. If the board gives no answer, the largest group is used.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from capture.checks.alignment import (
    FEWEST_PHOTOS,
    MOVED_PX,
    SHOWN,
    Alignment,
    CommonView,
    align,
    allowed_px,
    textures_of,
)
from capture.checks.picture_motion import Rotation, Shift
from capture.checks.registration import Correlator, Plane, Points, moved_back, sigma_along
from capture.photos.finding import Finding
from capture.photos.photo import PhotoStack

BOARD_SHOWS = 0.1  # of the cells have to show the photos' texture: boards left 0.64 and more of it to see
MOVED, BOARD_OFF = "camera moved", "camera moved from board"  # kinds of finding
BOARD_PX = 3.0  # at common_view.REFERENCE_PX: about 0.2 degrees of a phone's view, which the ground's slope may be off
BOARD_SIGMAS = 5.0  # of the shift as well; another focus than the photos' makes it uncertain
TRIES = 2  # with the cells that agree; those of the second are chosen where the first one led


@dataclass(frozen=True)
class HomeView:
    """The photos compared with the chosen group, and the photo of the board compared with it."""

    textures: list[Plane]  # as photographed
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
        return np.flatnonzero(~self.alignment.outside()) if self.pushed else np.arange(len(self.textures))

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
        return HomeView(textures, largest, None, np.full(2, np.nan), np.nan)
    correlator = Correlator.over(textures)
    texture, lit = (planes[0] for planes in textures_of(board, [0]))
    shift, sigma = shift_of_board(texture, lit, largest.view, correlator)
    limit, path = allowed_px(texture), board.paths[0]
    rest = np.flatnonzero(largest.outside())
    if not np.hypot(*shift) <= limit and len(rest) >= FEWEST_PHOTOS:
        other = align(textures, brightness, rest)
        off, its_sigma = shift_of_board(texture, lit, other.view, correlator)
        if np.hypot(*off) <= limit and (~other.outside()[rest]).sum() >= FEWEST_PHOTOS:
            pushed = frozenset(np.flatnonzero(~largest.outside()).tolist())
            return HomeView(textures, other, path, off, its_sigma, pushed)
    return HomeView(textures, largest, path, shift, sigma)


def board_findings(stack: PhotoStack, indices: Sequence[int], home: HomeView) -> list[Finding]:
    """Return a finding for each photo if the board's photo lies off every group that could be kept."""
    length = float(np.hypot(*home.shift))
    limit = max(allowed_px(home.textures[0]) * BOARD_PX / MOVED_PX, BOARD_SIGMAS * home.sigma)
    if home.board is None or not length > limit:
        return []
    to_file = stack.full_width / stack.rgb.shape[2]
    found = []
    for k in home.members.tolist():
        path = stack.paths[indices[k]]
        text = f"the view lies {length * to_file:.1f} px off that of {named_apart(home.board, path)}, the photo of the "
        text += f"board, at most {limit * to_file:.1f} px is fine: did the tripod move in between?"
        found.append(Finding(path, BOARD_OFF, text, length * to_file, limit * to_file, False))
    return found


def named_apart(board: Path, photo: Path) -> str:
    """The name of the board's photo, with its folder where a photo may have the same name."""
    return board.name if board.parent == photo.parent else f"{board.parent.name}/{board.name}"


def shift_of_board(texture: Plane, brightness: Plane, view: CommonView, correlator: Correlator) -> tuple[Shift, float]:
    """Return the shift of the board's photo against a group, px, and one sigma; NaN if too little is shared.

    Only cells that agree with the photos take part: the board itself covers some, and the object others.
    """
    starts = [np.zeros(2), *(correlator.shift(correlator.spectra(texture), correlator.spectra(h)) for h in view.halves)]
    agreeing = [(_agreeing(texture, start, view), start) for start in starts if np.isfinite(start).all()]
    agrees, shift = max(agreeing, key=lambda pair: int(pair[0].sum()))
    points, covariance = Points.of(view.halves), np.full((2, 2), np.nan)
    for _ in range(TRIES):
        if agrees.mean() < BOARD_SHOWS:
            return np.full(2, np.nan), np.nan
        shift, covariance = points.refined(texture, _only(brightness, agrees, view.cell_side), 0, shift)
        if not np.isfinite(shift).all():
            return shift, np.nan
        agrees = _agreeing(texture, shift, view)
    is_clear = agrees.mean() >= BOARD_SHOWS
    return (shift, sigma_along(covariance, shift)) if is_clear else (np.full(2, np.nan), np.nan)


def board_rotation(board: PhotoStack, home: HomeView, rotation: Rotation) -> Float[np.ndarray, "3"]:
    """Return the rotation of the camera from the group to the photo of the board; NaN if too little is shared.

    Args:
        rotation: the meaning of the three angles.
    """
    texture, brightness = (planes[0] for planes in textures_of(board, [0]))
    view, points = home.alignment.view, home.alignment.points
    if not np.isfinite(home.shift).all():
        return np.full(3, np.nan)
    lit = _only(brightness, _agreeing(texture, home.shift, view), view.cell_side)
    return points.refined(texture, lit, 0, rotation.from_shift(home.shift), rotation)[0]


def _agreeing(texture: Plane, shift: Shift, view: CommonView) -> Bool[np.ndarray, "rows columns"]:
    """Cells in which a photo, moved back, correlates with what both halves have in common."""
    seen, common = moved_back(texture, shift), 0.5 * (view.halves[0] + view.halves[1])
    strength = view.in_cells(seen * seen) * view.in_cells(common * common)
    return view.in_cells(seen * common) > SHOWN * np.sqrt(strength)


def _only(brightness: Plane, cells: Bool[np.ndarray, "rows columns"], side: int) -> Plane:
    """The brightness, 0 outside some cells."""
    kept = np.zeros_like(brightness)
    rows, columns = (side * n for n in cells.shape)
    kept[:rows, :columns] = brightness[:rows, :columns] * cells.repeat(side, 0).repeat(side, 1)
    return kept
