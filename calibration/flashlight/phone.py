"""Locate the flashlight in each photo from the board as seen by the phone that carries it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from calibration.board.board_pose import board_views
from calibration.board.corners import Corners
from calibration.board.intrinsics import CameraFit, fit_camera
from calibration.flashlight.fit import (
    FlashlightFit,
    before_ends,
    collect,
    first_fits,
    fit_flashlights,
    without_gloss,
)
from calibration.flashlight.led_photo import FITTED_SIGMA, QUARTER_TURNS, BackView, Choice, choose
from calibration.flashlight.light_estimate import LightFit, describe, position_sigma, unseen_error
from calibration.flashlight.model import Flashlights, free_tangent
from calibration.flashlight.outline_lights import outlines_of
from calibration.flashlight.pictured import with_response
from calibration.ground.table_edges import TableEdge
from calibration.lights.fusion import fuse
from calibration.lights.ground_cells import ground_ends
from calibration.outlines.carried_light import offset_by_outlines
from calibration.outlines.terms import DROP_OUTLINE
from calibration.pose import Pose
from calibration.posed_camera import PosedCamera
from capture.errors import CalibrationError
from capture.photos.photo import PhotoStack

MIN_VIEWS = 4  # photos of the board that the phone's lens and the LED's place beside it need
WORST_RMS = 0.002  # of the photo's longer side: corners in wrong places
PAIR_LIMIT = 0.25  # of the range: farther apart, a phone photo and a lit photo were not taken together
PAIR_SKIP = 0.2  # what leaving a phone photo or a lit photo alone costs: less than a wrong pair, more than a fair one
FEWEST_PAIRED = 2 / 3  # of the lit photos: fewer pairs mean that shading is far off, as with a phone's picture pipeline
SHIFTS = 3  # numbers by which phone photos and lit photos may be out of step
IN_STEP = 0.85  # of the distance to phones that are out of step
OFFSET_ERROR_MM = (2.0, 1.0)  # of the LED's place beside the lens, fitted (1 to 6 mm in simulations) and given
FARTHEST_LED_MM, DEEPEST_LED_MM = 50.0, 15.0  # from its lens, and along the lens's axis; a fit errs by up to 6 mm
UNKNOWN_OFFSET_MM = 18.0  # the LED's usual distance from its lens, where neither shading nor the owner tells it
_Offset = tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]  # and its covariance, mm
AGREEING = 0.75  # of the outlines must agree before they are believed against the shading
QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class PhoneViews:
    """The views of the flashlight's phone: photos in the order of the lit ones, some of them without a board."""

    names: tuple[str, ...]
    detections: tuple[Corners | None, ...]
    size: tuple[int, int]  # width, height, px
    focal_35mm: float | None = None
    led_offset_mm: tuple[float, float, float] | None = None  # in the lens's camera frame, if known
    back: BackView | None = None  # what a photo of the phone's back says of that offset


@dataclass(frozen=True)
class _Carried:
    """The phone's lens and world_from_phone per lit photo; None where only shading gives the flashlight's place."""

    poses: tuple[Pose | None, ...]
    reach: Float[np.ndarray, " photos"]  # how far along the beam it passes the scene

    def posed(self) -> Bool[np.ndarray, " photos"]:
        """Which lit photos have a pose."""
        return np.array([pose is not None for pose in self.poses])


def locate_lights_from_phone(
    stack: PhotoStack, posed_camera: PosedCamera, usable: Bool[np.ndarray, " photos"], views: PhoneViews
) -> LightFit:
    """Return one point light per usable photo: the phone's pose from the board plus the LED's offset from its lens.

    The lens is calibrated from the same photos. The LED's offset (unless known, or outlines of shadows contradict it),
    the beam's tilt against the lens and the beam's profile are common to all photos and fitted to the ground's shading.
    Photos without a pose are fitted to the shading with the same beam. Phone photos are paired with lit photos in
    order; the pairing is checked against the places from shading alone.

    Raises:
        CalibrationError: fewer than 4 phone photos show the board, or as locate_lights raises.
    """
    evidence, photos = collect(stack, posed_camera, usable)
    edges = ground_ends(stack, posed_camera, usable)
    evidence = before_ends(evidence, edges)
    lens, poses = _poses(views)
    first = first_fits(evidence)
    alone = without_gloss(fit_flashlights(first.best(), evidence, free_tangent))
    alone = with_response(first, alone, evidence)
    poses = _least_turned(poses, views, alone.flashlights)
    partner = pair_in_order(poses, alone.flashlights, evidence.cells.centre, photos)
    if len(poses) == len(usable) and (partner >= 0).sum() < FEWEST_PAIRED * len(photos):
        partner = pair_in_step(poses, alone.flashlights, evidence.cells.centre, photos, partner)
    reach = np.linalg.norm(alone.flashlights.positions - alone.flashlights.aim, axis=1)
    carried = _Carried(tuple(poses[p] if p >= 0 else None for p in partner), reach)
    if carried.posed().sum() < MIN_VIEWS:
        raise _too_few(int(carried.posed().sum()), views)
    lens_error = lens.camera.sigmas["fx"] / lens.camera.fx * carried.reach  # a longer lens stands farther away
    shown = None if views.led_offset_mm else _shown_by_outlines(carried, alone, stack, posed_camera, usable, edges)
    middle_error = float(np.median(lens_error[carried.posed()]))
    fit, offset_error, choice = _fit(carried, alone, views, middle_error, shown)
    floor = np.where(carried.posed(), np.hypot(offset_error, lens_error), unseen_error(fit))
    names = [stack.paths[k].name for k in photos]
    sigma = position_sigma(fit)
    found = describe(fit, names, floor, sigma, sigma)
    residuals = (
        found.residuals
        | _phone_back(views.back, choice)
        | {
            "led_offset_mm": _led_offset(fit, carried).tolist(),
            "led_offset_sigma_mm": offset_error,
            "phone_reprojection_rms_px": lens.rms_px,
            "phone_focal_px": lens.camera.fx,
            "phone_photos": {
                stack.paths[photos[i]].name: views.names[p]
                for i, p in enumerate(partner)
                if p >= 0 and carried.posed()[i]
            },
        }
    )
    return replace(found, residuals=residuals)


def _shown_by_outlines(
    carried: _Carried,
    alone: FlashlightFit,
    stack: PhotoStack,
    posed_camera: PosedCamera,
    usable: Bool[np.ndarray, " photos"],
    edges: Sequence[TableEdge],
) -> _Offset | None:
    """Return the LED's offset as the outlines of shadows show it; None if they do not, or contradict each other."""
    terms = outlines_of(stack, posed_camera, usable, edges)
    if terms is None or (trusted := terms.trusted & carried.posed()).sum() < MIN_VIEWS:
        return None
    terms = replace(terms, trusted=trusted)
    offset, covariance = offset_by_outlines(terms, carried.poses, alone.flashlights.positions)
    misfit = terms.misfit(_start(carried, alone.flashlights, offset).positions)[trusted]
    return (offset, covariance) if led_is_beside(offset) and np.mean(misfit < DROP_OUTLINE) > AGREEING else None


def _fit(
    carried: _Carried, alone: FlashlightFit, views: PhoneViews, lens_error_mm: float, shown: _Offset | None
) -> tuple[FlashlightFit, float, Choice | None]:
    """Fit with the LED's offset given, fitted, or read from the phone's back; return also its error, mm, and choice.

    The outlines' offset is taken where it is the surer one, and where it contradicts the shading: then the pictures or
    the beam are not what they are taken for. A photo of the back is used
    after these, which distinguish the main lens from the others and give the phone's orientation.
    """
    known = None if views.led_offset_mm is None else np.array(views.led_offset_mm)
    fit, error = _fit_offset(carried, alone, known), OFFSET_ERROR_MM[0 if known is None else 1]
    shaded = _led_offset(fit, carried)
    if shown is not None and _is_surer(shown, shaded, error):
        fit, error = _fit_offset(carried, alone, shown[0]), float(np.sqrt(np.trace(shown[1])))
    elif known is None and not led_is_beside(shaded):  # the shading misleads: better none than this
        fit, error = _fit_offset(carried, alone, np.zeros(3)), UNKNOWN_OFFSET_MM
    if views.back is None or known is not None:
        return fit, error, None
    choice = choose(views.back, _led_offset(fit, carried), lens_error_mm)
    if choice.offset_mm is None:
        return fit, error, choice
    return _fit_offset(carried, alone, np.array(choice.offset_mm)), choice.sigma_mm, choice


def _fit_offset(carried: _Carried, alone: FlashlightFit, known: Float[np.ndarray, "3"] | None) -> FlashlightFit:
    """The flashlights, carried ones tied to their phone; the LED's offset is free unless known."""
    start = _start(carried, alone.flashlights, known)
    return fit_flashlights(start, alone.evidence, lambda flashlights: _tangent(flashlights, carried, known is None))


def _led_offset(fit: FlashlightFit, carried: _Carried) -> Float[np.ndarray, "3"]:
    """Return the vector from the phone's lens to its LED in the lens's camera frame, mm."""
    k = int(np.flatnonzero(carried.posed())[0])
    pose = carried.poses[k]
    assert pose is not None
    return pose.inverse().apply(fit.flashlights.positions[k])


def _is_surer(shown: _Offset, shaded: Float[np.ndarray, "3"], error_mm: float) -> bool:
    """Return whether outlines tell the offset better than shading, or contradict it by more than both errors explain.

    Args:
        error_mm: of the offset that shading gives.
    """
    spread = np.diag(np.full(3, FITTED_SIGMA**2))
    return np.trace(shown[1]) < error_mm**2 or fuse([shaded, shown[0]], [spread, shown[1]])[2]


def led_is_beside(offset: Float[np.ndarray, "3"]) -> bool:
    """Return whether an LED may lie there: beside its lens, on the same back."""
    return bool(np.linalg.norm(offset) < FARTHEST_LED_MM and abs(offset[2]) < DEEPEST_LED_MM)


def _phone_back(back: BackView | None, choice: Choice | None) -> dict[str, Any]:
    """What was made of the photo of the phone's back, for pages to show."""
    if back is None or choice is None:
        return {}
    lenses = [list(lens.lens_px) for lens in back.lenses]
    shown = {"photo": back.name, "led_px": back.led_px, "lenses_px": lenses, "lens_px": choice.lens_px}
    return {"phone_back": shown | {"sigma_mm": choice.sigma_mm, "why": choice.why}}


def _too_few(n_found: int, views: PhoneViews) -> CalibrationError:
    return CalibrationError(
        f"the board was found in {n_found} of {len(views.names)} photos of the flashlight's phone that match "
        f"a lit photo, {MIN_VIEWS} needed. Leave the board on the table in its view, or leave these photos out."
    )


def _poses(views: PhoneViews) -> tuple[CameraFit, list[Pose | None]]:
    """Return the phone's lens, and world_from_phone of every photo whose corners agree with it."""
    seen = [i for i, corners in enumerate(views.detections) if corners is not None]
    if len(seen) < MIN_VIEWS:
        raise _too_few(len(seen), views)
    lens = fit_camera([corners for corners in views.detections if corners is not None], views.size, views.focal_35mm)
    poses: list[Pose | None] = [None] * len(views.names)
    for i, used in zip(seen, lens.used, strict=True):
        corners = views.detections[i]
        assert corners is not None
        found = board_views(lens.on_sheet(corners), lens.camera)
        if used and found and found[0].rms() < WORST_RMS * max(views.size):
            poses[i] = found[0].camera_from_world.inverse()
    return lens, poses


def _least_turned(poses: list[Pose | None], views: PhoneViews, flashlights: Flashlights) -> list[Pose | None]:
    """Return the poses, turned about the board's middle where it looks the same from several sides.

    The flashlights found by shading decide; they lie within centimetres of the right one.
    """
    out = list(poses)
    for i, (pose, corners) in enumerate(zip(poses, views.detections, strict=True)):
        if pose is None or corners is None:
            continue
        middle = corners.board.points().mean(0)
        turns = [np.linalg.matrix_power(QUARTER_TURN, n) for n in range(0, QUARTER_TURNS, corners.board.turns_alike())]
        turned = [Pose(turn, middle - turn @ middle) @ pose for turn in turns]
        nearest = [np.linalg.norm(flashlights.positions - p.translation, axis=1).min() for p in turned]
        out[i] = turned[int(np.argmin(nearest))]
    return out


def pair_in_order(
    poses: list[Pose | None], flashlights: Flashlights, centre: Float[np.ndarray, "3"], photos: Int[np.ndarray, " used"]
) -> Int[np.ndarray, " used"]:
    """Return for every lit photo the index of the phone photo taken with it; -1 if there is none.

    The order is kept; both sides may miss some. Dynamic programming minimises the total distance between the phone and
    the place from shading, in ranges; an unpaired photo costs PAIR_SKIP. A phone photo without a pose costs nothing in
    its own place, so that the numbers stay in step.
    """
    n, m = len(flashlights.positions), len(poses)
    reach = np.linalg.norm(flashlights.positions - centre, axis=1)
    price = np.zeros((n, m))
    for j, pose in enumerate(poses):
        if pose is not None:
            price[:, j] = np.linalg.norm(flashlights.positions - pose.translation, axis=1) / reach
    in_step = np.abs(photos[:, None] - np.arange(m)) * 1e-4  # between equals, the one of the same number
    total = np.zeros((n + 1, m + 1))
    total[1:, 0] = PAIR_SKIP * np.arange(1, n + 1)
    total[0, 1:] = PAIR_SKIP * np.arange(1, m + 1)
    for i in range(n):
        for j in range(m):
            pair = total[i, j] + min(price[i, j], 1.0) + in_step[i, j]
            total[i + 1, j + 1] = min(pair, total[i, j + 1] + PAIR_SKIP, total[i + 1, j] + PAIR_SKIP)
    partner, i, j = np.full(n, -1), n, m
    while i > 0 and j > 0:
        if total[i, j] == total[i - 1, j] + PAIR_SKIP:
            i -= 1
        elif total[i, j] == total[i, j - 1] + PAIR_SKIP:
            j -= 1
        else:
            i, j = i - 1, j - 1
            partner[i] = j if price[i, j] < PAIR_LIMIT else -1
    return partner


def pair_in_step(
    poses: list[Pose | None],
    flashlights: Flashlights,
    centre: Float[np.ndarray, "3"],
    photos: Int[np.ndarray, " used"],
    otherwise: Int[np.ndarray, " used"],
) -> Int[np.ndarray, " used"]:
    """Return the phone photo of the same number for every lit photo, where shading is too far off to tell each pair.

    Shading must place the flashlights clearly nearer to these phones than to those some numbers before or after; else
    `otherwise` is returned.
    """
    places = np.array([np.full(3, np.nan) if pose is None else pose.translation for pose in poses])
    reach = np.linalg.norm(flashlights.positions - centre, axis=1)

    def price(shift: int) -> float:
        other = photos + shift
        inside = (other >= 0) & (other < len(poses))
        away = np.linalg.norm(flashlights.positions[inside] - places[other[inside]], axis=1) / reach[inside]
        return float(np.nanmean(np.minimum(away, 1.0))) if np.isfinite(away).any() else 1.0

    apart = min(price(shift) for shift in range(-SHIFTS, SHIFTS + 1) if shift)
    seen = np.array([poses[k] is not None for k in photos])
    return np.where(seen, photos, -1) if price(0) < IN_STEP * apart else otherwise


def _start(carried: _Carried, flashlights: Flashlights, offset: Float[np.ndarray, "3"] | None) -> Flashlights:
    """Flashlights at the lens (or at the LED, if its offset is known) aimed as the lens is; the others unchanged."""
    positions, targets = flashlights.positions.copy(), flashlights.targets.copy()
    for k, pose in enumerate(carried.poses):
        if pose is not None:
            positions[k] = pose.apply(np.zeros(3) if offset is None else offset)
            targets[k] = positions[k] + carried.reach[k] * pose.rotation[:, 2]
    return replace(flashlights, positions=positions, targets=targets)


def _tangent(flashlights: Flashlights, carried: _Carried, is_offset_free: bool) -> Float[np.ndarray, "full reduced"]:
    """The tangent of carried flashlights, all with one LED offset in the lens frame (3, or 0 if known) and tilt (2).

    Their powers, the flashlights without a pose and all shared parameters move as in free_tangent.
    """
    own, posed = flashlights.per_flashlight(), carried.posed()
    free = free_tangent(flashlights)
    tied = [c for k in np.flatnonzero(posed) for c in range((own - 1) * k, (own - 1) * k + 5)]
    common = np.zeros((len(free), 5))
    for k, pose in enumerate(carried.poses):
        if pose is not None:
            row = own * k
            common[row : row + 3, :3] = pose.rotation
            common[row + 3 : row + 6, :3] = pose.rotation
            common[row + 3 : row + 6, 3:] = carried.reach[k] * pose.rotation[:, :2]
    return np.hstack([common if is_offset_free else common[:, 3:], np.delete(free, tied, axis=1)])
