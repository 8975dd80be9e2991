"""Whether views see one object at one place on the sheet; the one that does not is left out, with a sentence.

Silhouettes come from the photos under the flashlight, before any surface is known. A horizontal shift of the object in
one view is fitted to all epipolar tangents; what no shift explains is another object.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float

from calibration.board.board import parse_board
from calibration.calibrated_views import CalibratedView, CalibratedViews
from calibration.calibration import Calibration
from calibration.ground.ground_field import fit_ground_field
from calibration.ground.ground_shadows import LIKELY, find_shadows
from calibration.pose import Pose
from calibration.views.tangents import Silhouette, Tangent, tangents
from capture.photos.photo import PhotoStack

FINER = 3  # times the pixels of the likelihood of the object: its edge falls between them
MOVED_MM = 2.0  # an object that moved by less does little harm
MOVED_SIGMAS = 4.0
EXPLAINED = 0.5  # of the tangents' gaps that may be left by a shift that explains them, root mean square
OTHER_SHARE, OTHER_MM = 0.08, 5.0  # of the object's size, and at least: gaps left by any shift are another object
FEWEST_TANGENTS = 2
AS_GOOD = 9.0  # chi-square: three sigmas


def agree(views: CalibratedViews, stacks: Sequence[PhotoStack]) -> CalibratedViews:
    """Return the views that see one object at one place, their boards read from the same end; others are left out.

    Args:
        stacks: the photos of each view.
    """
    if len(views.views) < 2:
        return views
    masks = [silhouette_mask(stack, view.calibration) for stack, view in zip(stacks, views.views, strict=True)]
    views = from_one_end(views, masks)
    kept, left_out = list(range(len(views.views))), list(views.left_out)
    while len(kept) > 1:
        names = [views.views[i].name for i in kept]
        found = odd_one_out([_silhouette(views.views[i].calibration, masks[i]) for i in kept], names)
        if found is None:
            break
        index, reason = found
        left_out.append((views.views[kept[index]].name, reason))
        del kept[index]
    return replace(views, views=tuple(views.views[i] for i in kept), left_out=tuple(left_out))


def silhouette_mask(stack: PhotoStack, calibration: Calibration) -> Bool[np.ndarray, "height width"]:
    """Return the object as the used photos show it against the ground, on a finer grid than the ground's field."""
    used = np.array([light.used for light in calibration.lights])
    field = fit_ground_field(stack.rgb[used], ~stack.clipped[used])
    shadows = find_shadows(field)
    height, width = shadows.object_mask.shape
    size = (FINER * width, FINER * height)
    near = cv2.dilate(shadows.object_mask.astype(np.uint8), np.ones((3, 3), np.uint8))
    fine = cv2.resize(shadows.likelihood, size, interpolation=cv2.INTER_CUBIC) > LIKELY
    whole = cv2.resize(cv2.erode(shadows.object_mask.astype(np.uint8), np.ones((3, 3), np.uint8)), size) > 0
    return (fine & (cv2.resize(near, size, interpolation=cv2.INTER_NEAREST) > 0)) | whole


def _silhouette(calibration: Calibration, mask: Bool[np.ndarray, "height width"]) -> Silhouette:
    return Silhouette(calibration.posed_camera.resized(mask.shape[1], mask.shape[0]), mask)


@dataclass(frozen=True, eq=False)
class Shift:
    """A horizontal shift of the object in one view that explains the tangents best."""

    mm: Float[np.ndarray, "2"]
    sigmas: float  # its length over its error
    before: float  # root of the mean squared gap of this view's tangents, mm
    after: float

    @property
    def length(self) -> float:
        """How far, mm."""
        return float(np.linalg.norm(self.mm))

    def is_clear(self) -> bool:
        """Return whether the object moved: by more than it may, more than its error, and the tangents then agree."""
        return self.length >= MOVED_MM and self.sigmas >= MOVED_SIGMAS and self.after <= EXPLAINED * self.before


def odd_one_out(silhouettes: Sequence[Silhouette], names: Sequence[str]) -> tuple[int, str] | None:
    """Return the view whose object stands elsewhere or is another one, and what was measured; None if all agree."""
    found = tangents(silhouettes)
    if len(found) < FEWEST_TANGENTS:
        return None
    shifts = [_shift(found, view) for view in range(len(silhouettes))]
    alike = _culprits(found, shifts)
    moved = [view for view in alike if (one := shifts[view]) is not None and one.is_clear()]
    best = moved[-1] if moved else alike[-1]
    shift = shifts[best]
    if shift is None:
        return None
    others = " and ".join(name for view, name in enumerate(names) if view != best)
    doubted = " or ".join(names[view] for view in alike if view != best)
    if moved:
        least = "" if len(silhouettes) > 2 else "at least "
        doubt = f" (or it moved in {doubted}: these views cannot tell)" if doubted else ""
        return best, (
            f"the object stands {least}{shift.length:.1f} mm from where {others} saw it, {MOVED_MM:g} mm may be{doubt}."
            " Nothing on the table may move between views: photograph this view again."
        )
    other = max(OTHER_MM, OTHER_SHARE * _size(silhouettes))
    if shift.after > other:
        return best, (
            f"its silhouette differs by {shift.after:.0f} mm from what {others} saw, {other:.0f} mm may be, wherever "
            "the object stood: another object, a board of another size, or an object that does not stand out from the "
            "table. Photograph one object on one sheet."
        )
    return None


def _culprits(found: Sequence[Tangent], shifts: Sequence[Shift | None]) -> list[int]:
    """Return the views each of whose shifts makes all tangents agree about as well as that of any."""
    rest = [
        float(np.sum([(one.gap / one.sigma) ** 2 for one in found if view not in one.views]))
        for view in range(len(shifts))
    ]
    explained = [value + _left(found, view, shifts[view]) for view, value in enumerate(rest)]
    return np.flatnonzero(np.array(explained) <= min(explained) + AS_GOOD).tolist()


def _left(found: Sequence[Tangent], view: int, shift: Shift | None) -> float:
    """Return chi-square of a view's own tangents after its shift."""
    if shift is None:
        return 0.0
    own = [one for one in found if view in one.views]
    return float(np.sum([((one.gap - _sign(one, view) * one.normal[:2] @ shift.mm) / one.sigma) ** 2 for one in own]))


def _sign(tangent: Tangent, view: int) -> float:
    return 1.0 if tangent.views[1] == view else -1.0


def _shift(found: Sequence[Tangent], view: int) -> Shift | None:
    """Fit the shift of the object in one view; the shortest one where a direction is not seen."""
    own = [one for one in found if view in one.views]
    if len(own) < FEWEST_TANGENTS:
        return None
    rows = np.array([_sign(one, view) * one.normal[:2] / one.sigma for one in own])
    gaps = np.array([one.gap / one.sigma for one in own])
    left, sizes, right = np.linalg.svd(rows, full_matrices=False)
    seen = sizes > 0.3 * sizes[0]
    along = (left.T @ gaps)[seen] / sizes[seen]
    mm = along @ right[seen]
    sigmas = float(np.sqrt(((along * sizes[seen]) ** 2).sum()))
    millimetres = np.array([one.gap for one in own])
    rest = millimetres - np.array([_sign(one, view) * one.normal[:2] @ mm for one in own])
    return Shift(mm, sigmas, float(np.sqrt((millimetres**2).mean())), float(np.sqrt((rest**2).mean())))


def _size(silhouettes: Sequence[Silhouette]) -> float:
    """Return about how large the object is, mm: the root of its area in the picture, at the ground's distance."""
    sizes = [np.sqrt(one.mask.sum()) * one.pixel(one.camera.looked_at()) for one in silhouettes]
    return float(np.median(sizes))


# --- boards whose ends are alike -------------------------------------------------------------------------------------


def from_one_end(views: CalibratedViews, masks: Sequence[Bool[np.ndarray, "height width"]]) -> CalibratedViews:
    """Return the views with a board whose ends are alike read from the same end as in the first view.

    Each later view is turned as the board allows it; the turn that lets the silhouettes agree best is taken.
    """
    board = parse_board(views.first.residuals["board"])
    quarters = board.turns_alike()
    if quarters == 4:
        return views
    middle = board.points()[:, :2].mean(0)
    placed: list[CalibratedView] = [views.views[0]]
    for view, mask in zip(views.views[1:], masks[1:], strict=True):
        turned = [view.calibration.moved(_turn(middle, k * quarters)) for k in range(4 // quarters)]
        known = [_silhouette(one.calibration, seen) for one, seen in zip(placed, masks, strict=False)]
        costs = [_disagreement([*known, _silhouette(one, mask)]) for one in turned]
        placed.append(replace(view, calibration=turned[int(np.argmin(costs))]))
    return replace(views, views=tuple(placed))


def _turn(middle: Float[np.ndarray, "2"], quarters: int) -> Pose:
    """Return a turn about the vertical through a point of the ground."""
    angle = np.pi / 2 * quarters
    rotation = np.round([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    centre = np.append(middle, 0.0)
    return Pose(rotation, centre - rotation @ centre)


def _disagreement(silhouettes: Sequence[Silhouette]) -> float:
    """Return the mean squared gap of the last view's tangents; infinite where the rays do not meet."""
    last = len(silhouettes) - 1
    gaps = [one.gap for one in tangents(silhouettes) if last in one.views]
    return float(np.mean(np.square(gaps))) if gaps else float("inf")
