"""Whether views see one object at one place on the sheet; the one that does not is left out, with a sentence.

Silhouettes come from the photos under the flashlight, before any surface is known. A horizontal shift of the object in
one view is fitted to all epipolar tangents, and where they do not agree after it, to those of its upper half alone: a
flat foot may be taken for the table in some views. A shift that nobody makes by accident is another object.

Epipolar tangents: two cameras that see one object, wherever they stand, touch it with the same two planes.

All planes through both camera centres form a pencil about the baseline. The outermost of them that meet the object
touch it (at frontier points), and each camera sees them as tangents of its silhouette. So the first and the last angle
about the baseline are the same in both silhouettes, whatever the object's shape [Porrill and Pollard 1991; Cipolla,
Astrom and Giblin 1995]. A difference is an object that moved or is another one, or a wrong pose.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float

from calibration.board.board import parse_board
from calibration.calibrated_views import CalibratedView, CalibratedViews
from calibration.calibration import Calibration
from calibration.ground.ground_shadows import LIKELY, find_shadows
from calibration.light import Vector
from calibration.lights.ground_cells import field_of
from calibration.pose import Pose
from calibration.posed_camera import PosedCamera
from capture.photos.photo import PhotoStack

SHORTEST_BASELINE = 0.1  # of the distance to the object: below, a pixel is a large angle about the baseline
OUTLINE_PX = 0.5  # one sigma of an outline; rendered captures gave 0.3 and less
LEAST_SPREAD = np.radians(0.5)  # of the angles of one silhouette
FINER = 3  # times the pixels of the likelihood of the object: its edge falls between them
MOVED_MM = 2.0  # an object that moved by less does little harm
OTHER_SHARE, OTHER_MM = 0.15, 10.0  # of the object's size, and at least: who pushes it so far lays another one there
UPWARD = 0.2  # z of the normal of tangents that touch the object's upper half: its foot may look like the table
AS_GOOD = 9.0  # chi-square: three sigmas


@dataclass(frozen=True, eq=False)
class Silhouette:
    """The object in one view."""

    camera: PosedCamera  # of the mask's pixels
    mask: Bool[np.ndarray, "height width"]

    def outline(self) -> Float[np.ndarray, "n 3"]:
        """Return world directions through the outline's pixels, of z-depth 1."""
        inner = cv2.erode(self.mask.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0) > 0
        rows, columns = np.nonzero(self.mask & ~inner)
        return self.camera.rays(np.stack([columns, rows], -1).astype(float))

    def pixel(self, at: Vector) -> float:
        """Return the size of a pixel at a world point, in the world's unit."""
        return float(np.linalg.norm(at - self.camera.centre)) / self.camera.camera.fx


@dataclass(frozen=True, eq=False)
class Tangent:
    """One plane that two silhouettes should share."""

    views: tuple[int, int]
    normal: Vector  # unit, world, away from the other tangent plane
    gap: float  # by how far along the normal the second view sees the object farther out than the first, world unit
    sigma: float  # one sigma of it, of outlines that are known to OUTLINE_PX


def tangents(silhouettes: Sequence[Silhouette]) -> list[Tangent]:
    """Return both tangents of every pair of views that stand far enough apart."""
    outlines = [one.outline() for one in silhouettes]
    found: list[Tangent] = []
    for i, first in enumerate(silhouettes):
        for j in range(i + 1, len(silhouettes)):
            found += _of_pair((i, j), (first, silhouettes[j]), (outlines[i], outlines[j]))
    return found


def _of_pair(
    views: tuple[int, int], pair: tuple[Silhouette, Silhouette], outlines: tuple[np.ndarray, np.ndarray]
) -> list[Tangent]:
    start, end = (one.camera.centre for one in pair)
    base = end - start
    amid = [rays.mean(0) if len(rays) else np.array([0.0, 0.0, -1.0]) for rays in outlines]
    middle = _nearest((start, end), (amid[0], amid[1]))  # which both see amid their silhouettes
    away = [float(np.linalg.norm(middle - eye)) for eye in (start, end)]
    if not all(len(rays) for rays in outlines) or np.linalg.norm(base) < SHORTEST_BASELINE * min(away):
        return []
    base = base / np.linalg.norm(base)
    across = (middle - start) - ((middle - start) @ base) * base
    if np.linalg.norm(across) < SHORTEST_BASELINE * min(away):  # the object stands between the cameras
        return []
    across /= np.linalg.norm(across)
    up = np.cross(base, across)
    angles = [np.arctan2(rays @ up, rays @ across) for rays in outlines]
    if min(float(np.ptp(one)) for one in angles) < LEAST_SPREAD or max(np.abs(one).max() for one in angles) > np.pi / 2:
        return []
    found = []
    for pick, sign in ((np.argmin, -1.0), (np.argmax, 1.0)):
        rays = [one[int(pick(angle))] for one, angle in zip(outlines, angles, strict=True)]
        first, second = (float(angle[int(pick(angle))]) for angle in angles)
        at = _nearest((start, end), (rays[0], rays[1]))
        distance = float(np.linalg.norm((at - start) - ((at - start) @ base) * base))
        tilt = 0.5 * (first + second)
        normal = sign * (np.cos(tilt) * up - np.sin(tilt) * across)
        sigma = OUTLINE_PX * float(np.hypot(*(one.pixel(at) for one in pair)))
        found.append(Tangent(views, normal, sign * distance * (second - first), sigma))
    return found


def _nearest(starts: tuple[Vector, Vector], rays: tuple[Vector, Vector]) -> Vector:
    """Return the point with the least squared distance to two lines."""
    square, right = np.zeros((3, 3)), np.zeros(3)
    for start, ray in zip(starts, rays, strict=True):
        along = ray / np.linalg.norm(ray)
        project = np.eye(3) - np.outer(along, along)
        square, right = square + project, right + project @ start
    return np.linalg.lstsq(square, right, rcond=None)[0]


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
    shadows = find_shadows(field_of(stack, calibration.posed_camera, used))
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


def odd_one_out(silhouettes: Sequence[Silhouette], names: Sequence[str]) -> tuple[int, str] | None:
    """Return the view whose object stands elsewhere or is another one, and what was measured; None if all agree."""
    every = tangents(silhouettes)
    whole = _moved(every, len(silhouettes), FULLY, len(names) > 2)
    upper = [one for one in every if one.normal[2] > UPWARD]
    found = whole or _moved(upper, len(silhouettes), BY_THE_TOP, len(names) > 2)
    if found is None:
        return None
    shift, view, alike = found
    others = " and ".join(name for k, name in enumerate(names) if k != view)
    doubted = " or ".join(names[k] for k in alike if k != view)
    doubt = f" (or it is {doubted} that differs: these views cannot tell)" if doubted else ""
    least = "" if len(silhouettes) > 2 else "at least "
    measured = (
        f"the object stands {least}{shift.length:.1f} mm from where {others} saw it, {MOVED_MM:g} mm may be{doubt}"
    )
    # about how large the object is, mm: the root of its area in the picture, at the ground's distance
    sizes = [np.sqrt(one.mask.sum()) * one.pixel(one.camera.looked_at()) for one in silhouettes]
    if shift.length > max(OTHER_MM, OTHER_SHARE * float(np.median(sizes))):
        measured += ": is it another object, or a board of another size?"
        return view, f"{measured} Photograph one object on one sheet, and move nothing on the table."
    return view, f"{measured}. Nothing on the table may move between views: photograph this view again."


@dataclass(frozen=True)
class Limits:
    """What makes a shift clear: its length, its length over its error, and the share of the gaps that it may leave."""

    mm: float
    sigmas: float
    left: float


FULLY = Limits(MOVED_MM, 4.0, 0.5)  # asked of all tangents, which then agree
BY_THE_TOP = Limits(3.0, 4.5, np.inf)  # asked of the upper ones, which a shift always explains


def _moved(
    found: Sequence[Tangent], n_views: int, limits: Limits, has_several: bool
) -> tuple["Shift", int, list[int]] | None:
    """Return the shift that makes the tangents agree, the last view that may have it, and all views that may."""
    shifts = [_shift(found, view, 2 if has_several or limits is FULLY else 1) for view in range(n_views)]
    alike = _culprits(found, shifts)
    for view in reversed(alike):
        shift = shifts[view]
        if shift is None or shift.length < limits.mm or shift.sigmas < limits.sigmas:
            continue
        if shift.after <= limits.left * shift.before:
            return shift, view, alike
    return None


def _culprits(found: Sequence[Tangent], shifts: Sequence[Shift | None]) -> list[int]:
    """Return the views each of whose shifts makes all tangents agree about as well as that of any."""
    explained = []
    for view, shift in enumerate(shifts):
        moved = np.zeros(2) if shift is None else shift.mm
        own = [one for one in found if view not in one.views or shift is not None]
        gaps = [one.gap - (view in one.views) * _sign(one, view) * one.normal[:2] @ moved for one in own]
        explained.append(sum((gap / one.sigma) ** 2 for gap, one in zip(gaps, own, strict=True)))
    return np.flatnonzero(np.array(explained) <= min(explained) + AS_GOOD).tolist()


def _sign(tangent: Tangent, view: int) -> float:
    return 1.0 if tangent.views[1] == view else -1.0


def _shift(found: Sequence[Tangent], view: int, fewest: int) -> Shift | None:
    """Fit the shift of the object in one view; the shortest one where a direction is not seen."""
    own = [one for one in found if view in one.views]
    if len(own) < fewest:
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
