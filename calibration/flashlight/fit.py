"""Fit the flashlight of every photo: a coarse search, then a robust fit that handles gloss and stray photos."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from calibration.flashlight.beam_profile import EXTRA_TERMS
from calibration.flashlight.descent import RobustWeights, refine
from calibration.flashlight.duplicates import refuse_still_light
from calibration.flashlight.model import Evidence, Flashlights, Priors, Tangent, cell_residuals, log_irradiance
from calibration.ground.table_edges import TableEdge, on_table
from calibration.lights import hand
from calibration.lights.ground_cells import GroundCells, sample_ground
from calibration.posed_camera import PosedCamera
from capture.checks.mixture import STEADY, levels
from capture.checks.robust import spread
from capture.errors import CalibrationError
from capture.photos.photo import PhotoStack

MIN_PHOTOS = 4
DROP_RESIDUAL = 3.5  # of the median photo: shaken, or not lit by the flashlight
DROP_SHARE = 0.4  # of the median photo's share: least part of the ground that must follow the model
MIN_GROUND = 100  # cells that behave like ground; fewer do not tell position, aim and beam apart
OBJECT_LIGHT = 0.2  # times (R / d)^2: what an object of radius R sends, of its own light, to the ground at distance d
FAR = tuple([RobustWeights(2.5, False)] * 15)  # far from the answer no sample is forgotten ...
NEAR = tuple(RobustWeights(cut, True) for cut in np.geomspace(7.0, 3.0, 8))  # ... then the cut narrows
LAST = tuple([RobustWeights(3.0, True)] * 8)
LOOSE_POWER = Priors(log_power=0.1)  # nothing is believed yet about how steady the flashlight is
STEADY_POWER = 0.003  # narrowest belief in a constant flashlight
POWER_ERROR = 0.012  # spread of fitted powers that a perfectly steady flashlight shows under LOOSE_POWER
POWER_SHARE = 0.5  # of the spread beyond that: a belief this wide still steadies the positions
POWER_VOTE = 0.1  # in the search, a flashlight 10 % brighter than the others counts like 1 % of misfit
START_BEAM = 2.0  # cos^2: between a bare LED and a focused one
REFIT_RESIDUAL = 2.0  # of the median photo: such a photo may sit in a wrong minimum, ...
REFIT_SHARE = 0.5  # ... or one of less ground that follows than this share of the median photo's
GLOSS_ANGLE = np.radians(22.0)  # half angle below which a glossy table mirrors the light
GLOSS_RISE = 0.03
OVAL_GAIN = 0.85  # of the residual: round beams keep 0.98, beams with 2 % of asymmetry at 40 degrees go to 0.5
OVAL_PHOTOS = 8  # fewer leave the ground's albedo free enough to take the terms up


@dataclass(frozen=True)
class FlashlightFit:
    """The fit behind a LightFit: flashlights, the evidence as finally weighted, and its samples' robust weights."""

    flashlights: Flashlights
    evidence: Evidence
    weight: Float[np.ndarray, "photos cells"]
    priors: Priors
    tangent: Tangent
    between: Float[np.ndarray, "photos 3"] | float = 0.0  # variance of the places over fits that are about as likely

    def residual(self) -> Float[np.ndarray, "photos cells"]:
        """Return the log residuals of all samples."""
        return cell_residuals(self.flashlights, self.evidence, self.weight)


def collect(
    stack: PhotoStack,
    posed_camera: PosedCamera,
    usable: Bool[np.ndarray, " photos"],
) -> tuple[Evidence, Int[np.ndarray, " used"]]:
    """Return the evidence of the usable photos, and their indices in the stack.

    Raises:
        CalibrationError: fewer than 4 photos, too little ground in view, or the flashlight never moved.
    """
    photos = np.flatnonzero(usable)
    if len(photos) < MIN_PHOTOS:
        raise CalibrationError(
            f"{len(photos)} usable photos under the flashlight, {MIN_PHOTOS} needed to locate it "
            "(25 or more are better). Take more photos with the flashlight in different places."
        )
    cells = sample_ground(stack, posed_camera, photos)
    evidence = Evidence.of(cells, np.array(stack.gains)[photos], posed_camera.ground_height)
    refuse_still_light(evidence)
    return evidence, photos


def before_ends(evidence: Evidence, edges: Sequence[TableEdge]) -> Evidence:
    """Return the evidence without the cells beyond the ground's ends; as it is where too few would be left."""
    inside = on_table(edges, evidence.cells.points)
    return replace(evidence, weight=evidence.weight * inside) if inside.sum() >= MIN_GROUND else evidence


def hemisphere(cells: GroundCells) -> list[Float[np.ndarray, "candidates 3"]]:
    """Candidate places of a handheld flashlight, world (mm), one array per elevation."""
    azimuth = np.arange(0, 2 * np.pi, np.pi / 8)
    rings = []
    for elevation in np.radians([12.0, 25.0, 40.0, 55.0, 72.0]):
        direction = np.stack(
            [
                np.cos(elevation) * np.cos(azimuth),
                np.cos(elevation) * np.sin(azimuth),
                np.full_like(azimuth, np.sin(elevation)),
            ],
            -1,
        )
        rings.append(np.concatenate([cells.centre + d * direction for d in hand.DISTANCES]))
    return rings


def misfits(residual: Float[np.ndarray, "trials cells"], common: float | None):
    """Return the median absolute residual of each trial (log units), an unusual power added, and its log power.

    Args:
        common: log power that flashlights are expected to share; None if unknown.
    """
    offset = np.median(residual, axis=1)
    size = np.median(np.abs(residual - offset[:, None]), axis=1)
    if common is not None:
        size += POWER_VOTE * np.minimum(np.abs(offset - common), 1)
    return size, offset


@dataclass(frozen=True)
class _Search:
    """Candidate places of flashlights, and the log irradiance from each at every cell of the evidence."""

    places: Float[np.ndarray, "places 3"]
    table: Float[np.ndarray, "places cells"]

    @staticmethod
    def over(places: Float[np.ndarray, "places 3"], like: Flashlights, evidence: Evidence) -> "_Search":
        """Return flashlights of power 1 at the places, all aimed like the given ones on average."""
        n = len(places)
        flashlights = replace(like, positions=places, targets=np.repeat(like.aim[None], n, 0), log_power=np.zeros(n))
        return _Search(places, log_irradiance(flashlights, evidence))

    def best(self, brightness: Float[np.ndarray, "photos cells"], common: float | None = None):
        """Return for every photo the place of least median absolute residual, and the log power there.

        Args:
            brightness: log, albedo taken out, NaN where unknown.
            common: log power that flashlights are expected to share; None if unknown.
        """
        index, power = [], []
        for row in brightness:
            known = np.isfinite(row)
            size, offset = misfits(row[known] - self.table[:, known], common)
            index.append(int(np.argmin(size)))
            power.append(offset[index[-1]])
        return np.array(index), np.array(power)


def _thinned(evidence: Evidence, step: int = 4):
    """Return every step-th cell that is known in most photos, enough for a search; brightness is NaN where unknown."""
    keep = np.flatnonzero((evidence.weight > 0).mean(0) > 0.5)[::step]
    if len(keep) * step < MIN_GROUND:
        raise too_little_ground(len(keep) * step)
    thin = evidence.at(keep)
    return thin, np.where(thin.weight > 0, thin.log_grey, np.nan)


def first_guess(evidence: Evidence) -> Flashlights:
    """Estimate places and powers by a coarse search: each photo tries a hemisphere, then albedo is estimated again.

    World frame; powers relative to their median. Medians over cells and photos make it robust to object and shadows.

    Raises:
        CalibrationError: too little ground is usable in most photos.
    """
    n, centre = len(evidence.log_grey), evidence.cells.centre
    thin, log_grey = _thinned(evidence)
    beam = np.r_[START_BEAM, np.zeros(EXTRA_TERMS)]
    targets = np.repeat(centre[None], n, 0)
    flashlights = Flashlights(targets, targets, np.zeros(n), beam, 0.02, centre)
    search = _Search.over(np.concatenate(hemisphere(evidence.cells)), flashlights, thin)
    level = np.nanmedian(log_grey, axis=0)
    index, power = search.best(log_grey - level)
    for _ in range(2):
        level = np.nanmedian(log_grey - search.table[index] - power[:, None], axis=0)
        index, power = search.best(log_grey - level, float(np.median(power)))
    return replace(flashlights, positions=search.places[index], log_power=power - np.median(power))


def fit_flashlights(start: Flashlights, evidence: Evidence, tangent: Tangent) -> FlashlightFit:
    """Fit all flashlights robustly: with Cauchy weights, then Tukey weights, then less weight near the object.

    The prior on a constant power starts wide and narrows to the steadiness that the fit itself shows.

    Raises:
        CalibrationError: fewer than MIN_GROUND cells follow the light.
    """
    flashlights, weight = refine(start, evidence, LOOSE_POWER, tangent, FAR + NEAR)
    evidence = less_near_object(evidence, weight)
    flashlights, _ = refine(flashlights, evidence, LOOSE_POWER, tangent, NEAR + LAST)
    usual = levels(flashlights.log_power, STEADY)
    seen = spread(flashlights.log_power - usual)
    varies = POWER_SHARE * np.sqrt(max(seen**2 - POWER_ERROR**2, 0.0))
    priors = Priors(log_power=float(np.clip(varies, STEADY_POWER, LOOSE_POWER.log_power)), usual=usual)
    flashlights, weight = refine(flashlights, evidence, priors, tangent, NEAR + LAST)
    ground = int((weight.sum(0) > 0).sum())
    if ground < MIN_GROUND:
        raise too_little_ground(ground)
    return FlashlightFit(flashlights, evidence, weight, priors, tangent)


def too_little_ground(ground: int) -> CalibrationError:
    """Return the error for a view without enough bare ground."""
    return CalibrationError(
        f"only {ground} patches of bare, unclipped ground follow the light, {MIN_GROUND} needed to locate "
        "the flashlight. Show more of a plain matt table around the object, and avoid over-exposure."
    )


def less_near_object(evidence: Evidence, weight: Float[np.ndarray, "photos cells"]) -> Evidence:
    """Return the evidence with an added error for light that the object reflects onto the ground around it.

    The cells rejected in every photo are the object's outline on the ground. Its centre is taken half its width above
    the ground on the ray through the middle of the outline.
    """
    cells = evidence.cells
    outline = cells.points[weight.sum(0) <= 0]
    if len(outline) < 5:
        return evidence
    middle = np.median(outline, axis=0)
    distance = np.linalg.norm(outline - middle, axis=1)
    outline = outline[distance < 3 * np.median(distance)]
    view = outline.mean(0) - cells.eye
    view /= np.linalg.norm(view)
    side = np.cross(view, [0.0, 0.0, 1.0])
    radius = 2 * float(np.std(outline @ side) / np.linalg.norm(side))  # a disc's radius is twice its standard deviation
    centre = cells.eye + (evidence.height + radius - cells.eye[2]) / view[2] * view
    reach = np.maximum(np.linalg.norm(cells.points - centre, axis=1), radius)
    misfit = OBJECT_LIGHT * (radius / reach) ** 2
    return replace(evidence, weight=evidence.weight / (1 + evidence.weight * misfit**2))


def half_angles(flashlights: Flashlights, cells: GroundCells) -> Float[np.ndarray, "photos cells"]:
    """The angle (rad) between the ground's normal and the bisector of the directions to flashlight and camera."""
    light = flashlights.positions[:, None] - cells.points
    light /= np.linalg.norm(light, axis=-1, keepdims=True)
    view = cells.eye - cells.points
    view /= np.linalg.norm(view, axis=-1, keepdims=True)
    bisector = light + view
    return np.arccos(np.clip(bisector[..., 2] / np.linalg.norm(bisector, axis=-1), -1, 1))


def without_gloss(fit: FlashlightFit) -> FlashlightFit:
    """Refit without the samples where a glossy table mirrors the light; for a matt table return the fit itself."""
    known = fit.evidence.weight > 0
    angle = half_angles(fit.flashlights, fit.evidence.cells)
    residual = fit.residual()
    mirrored = known & (angle < GLOSS_ANGLE)
    plain = known & (angle > 1.5 * GLOSS_ANGLE)
    if mirrored.sum() < MIN_GROUND or plain.sum() < MIN_GROUND:
        return fit
    if np.median(residual[mirrored]) - np.median(residual[plain]) < GLOSS_RISE:
        return fit
    evidence = replace(fit.evidence, weight=np.where(angle < GLOSS_ANGLE, 0.0, fit.evidence.weight))
    return fit_flashlights(fit.flashlights, evidence, fit.tangent)


def with_oval_beams(fit: FlashlightFit, evidence: Evidence) -> FlashlightFit:
    """Refit with beams that need not be round if that explains the ground clearly better; else return the fit itself.

    With round beams, every per cent of asymmetry at 40 degrees off the axis costs a per cent of position. The new fit
    starts from the places only: a round fit distorts the beam's profile and rejects much of the ground, and the new fit
    does not recover from that.

    Args:
        evidence: as it was collected, before any fit.
    """
    n = len(fit.flashlights.positions)
    if n < OVAL_PHOTOS:
        return fit
    flashlights = replace(fit.flashlights, oval=np.zeros((n, 2)))
    flashlights, weight = refine(flashlights, fit.evidence, fit.priors, fit.tangent, LAST[:5])
    trial = replace(fit, flashlights=flashlights, weight=weight)
    voting = (fit.weight > 0) & (weight > 0)
    gain = spread(trial.residual()[voting]) / spread(fit.residual()[voting])
    if gain >= OVAL_GAIN:
        return fit
    afresh = replace(evidence, weight=np.where(fit.evidence.weight > 0, evidence.weight, 0.0))
    beam = np.r_[START_BEAM, np.zeros(EXTRA_TERMS)]
    return fit_flashlights(replace(fit.flashlights, beam=beam, oval=np.zeros((n, 2))), afresh, fit.tangent)


def photo_quality(fit: FlashlightFit):
    """Per photo the residual over its expected noise, relative to the median photo, and the ground's inlier share."""
    ground = fit.weight.sum(0) > 0
    known = (fit.evidence.weight > 0) & ground
    size = np.sqrt(fit.evidence.weight) * fit.residual()
    residual = np.array([spread(s[m]) if m.any() else np.inf for s, m in zip(size, known, strict=True)])
    follows = (fit.weight > 0.1 * fit.evidence.weight) & known
    share = follows.sum(1) / max(int(ground.sum()), 1)
    seen = residual[np.isfinite(residual)]
    return residual / max(float(np.median(seen)) if seen.size else 0.0, 1e-6), share


def does_not_follow(fit: FlashlightFit) -> Bool[np.ndarray, " photos"]:
    """Return which photos the shading contradicts: their lights are not used."""
    residual, share = photo_quality(fit)
    return (residual > DROP_RESIDUAL) | (share < least_share(share))


def least_share(share: Float[np.ndarray, " photos"]) -> float:
    """Return the share of the ground that must follow the model: of a beam with rings half does in a usual photo."""
    return DROP_SHARE * float(np.median(share))


def may_be_misplaced(fit: FlashlightFit) -> Bool[np.ndarray, " photos"]:
    """Return which photos misfit twice as much as usual, or show half as much ground that follows."""
    residual, share = photo_quality(fit)
    return (residual > REFIT_RESIDUAL) | (share < REFIT_SHARE * float(np.median(share)))


def refit_outliers(fit: FlashlightFit) -> FlashlightFit:
    """Refit after photos with large residuals have tried other starts, one per ring of the hemisphere."""
    stray = may_be_misplaced(fit)
    if not stray.any() or stray.sum() > 0.5 * len(stray):
        return fit
    thin, log_grey = _thinned(fit.evidence)
    level = np.nanmedian(np.where(stray[:, None], np.nan, log_grey - log_irradiance(fit.flashlights, thin)), axis=0)
    best = fit
    for places in hemisphere(fit.evidence.cells):
        search = _Search.over(places, fit.flashlights, thin)
        index, power = search.best(log_grey - np.nan_to_num(level))
        flashlights = replace(
            best.flashlights,
            positions=np.where(stray[:, None], places[index], best.flashlights.positions),
            targets=np.where(stray[:, None], best.flashlights.aim, best.flashlights.targets),
            log_power=np.where(stray, power, best.flashlights.log_power),
        )
        flashlights, weight = refine(flashlights, fit.evidence, fit.priors, fit.tangent, NEAR)
        trial = replace(fit, flashlights=flashlights, weight=weight)
        if _total_residual(trial, stray) < 0.98 * _total_residual(best, stray):
            best = trial
    return best


def _total_residual(fit: FlashlightFit, photos: Bool[np.ndarray, " photos"]) -> float:
    """Return the sum over some photos of the median absolute residual of all their ground samples."""
    residual = np.abs(fit.residual())
    known = (fit.evidence.weight > 0) & (fit.weight.sum(0) > 0)
    return float(sum(np.median(residual[k, known[k]]) for k in np.flatnonzero(photos)))
