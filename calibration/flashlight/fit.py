"""Fit the flashlight of every photo: a coarse search, then a robust fit that handles gloss and stray photos."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array

from calibration.flashlight.beam_profile import EXTRA_TERMS
from calibration.flashlight.descent import RobustWeights, refine
from calibration.flashlight.duplicates import refuse_still_light
from calibration.flashlight.model import (
    Evidence,
    Flashlights,
    Priors,
    Samples,
    Tangent,
    cell_residuals,
    cost,
    free_tangent,
    log_irradiance,
    normal_equations,
)
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
LOOSE_POWER = Priors(log_power=0.1)  # nothing is measured yet of how steady the flashlight is, ...
ALIKE_POWER = Priors(log_power=0.02)  # ... but it is one: what a battery loses in a session, where starts are compared
STEADY_POWER = 0.003  # narrowest belief in a constant flashlight
POWER_ERROR = 0.012  # spread of fitted powers that a perfectly steady flashlight shows under LOOSE_POWER
POWER_SHARE = 0.5  # of the spread beyond that: a belief this wide still steadies the positions
START_BEAM = 2.0  # cos^2: between a bare LED and a focused one
START_BEAMS = (2.0, 6.0)  # a bare LED to a focused one
START_AMBIENT = 0.02  # of a flashlight at a hand's usual distance: a dark room
FEW_CELLS = 400  # of a first fit: light is smooth over the ground
ROUNDS = 5  # of finding directions and the ground's albedo in turn: it settles in three
BLOCKS = 4  # along each side of the ground: regions over which errors are told to be alike
GLOSS_ANGLE = np.radians(22.0)  # half angle below which a glossy table mirrors the light
GLOSS_RISE = 0.03
DIRECTIONS = np.concatenate(  # of a hemisphere, 15 degrees apart: unit vectors
    [
        np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.full_like(a, np.sin(e))], -1)
        for e in np.radians([10.0, 20.0, 30.0, 42.0, 55.0, 70.0])
        for a in [np.arange(24) * np.pi / 12]
    ]
)
OVAL_GAIN = 0.85  # of the residual: round beams keep 0.98, beams with 2 % of asymmetry at 40 degrees go to 0.5
TELLS = 12.0  # independent numbers of a photo's ground: 50 by the correlation within it, and photos err alike
OVAL_PHOTOS = 8  # fewer leave the ground's albedo free enough to take the terms up


@dataclass(frozen=True)
class FirstFits:
    """Fits of a few cells from several starts, their costs, and how many of the samples err independently."""

    states: tuple[Flashlights, ...]
    costs: Float[np.ndarray, " fits"]
    independent: float

    def best(self) -> Flashlights:
        """Return the state of least cost."""
        return self.states[int(self.costs.argmin())]

    def variance_about(self, chosen: Float[np.ndarray, "photos 3"]) -> Float[np.ndarray, "photos 3"]:
        """Return the variance of the places over these fits, each as likely as its cost leaves it; world."""
        log_likelihood = -0.5 * self.independent * np.log(self.costs / self.costs.min())
        weight = np.exp(log_likelihood)
        return variance_about(chosen, np.stack([state.positions for state in self.states]), weight)


def variance_about(
    chosen: Float[np.ndarray, "photos 3"],
    places: Float[np.ndarray, "fits photos 3"],
    weight: Float[np.ndarray, " fits"],
) -> Float[np.ndarray, "photos 3"]:
    """Return the variance of a mixture of fits about the one that is chosen, without the variance of each by itself."""
    return np.einsum("f,fkx->kx", weight / weight.sum(), (places - chosen) ** 2)


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

    def variance(self, trust: float = 1.0) -> Float[np.ndarray, "photos 3"]:
        """Return the variance of the positions, world: of the fit, with priors, and between fits about as likely.

        Args:
            trust: factor of the weight of all samples.
        """
        matrix, _ = normal_equations(self.flashlights, self.evidence, trust * self.weight, self.priors)
        basis = csr_array(self.tangent(self.flashlights))
        covariance = basis @ np.linalg.pinv(basis.T @ matrix @ basis, hermitian=True) @ basis.T
        n, own = len(self.flashlights.positions), self.flashlights.per_flashlight()
        return np.maximum(np.diag(covariance)[: own * n].reshape(n, own)[:, :3], 0) + self.between

    def ground(self) -> int:
        """Return how many cells follow the light in some photo."""
        return int((self.weight.sum(0) > 0).sum())


def collect(
    stack: PhotoStack, posed_camera: PosedCamera, usable: Bool[np.ndarray, " photos"]
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
    gains = np.array(stack.gains)[photos]
    evidence = Evidence.of(cells, gains, posed_camera.ground_height)
    evidence = replace(evidence, exposure=None if stack.is_linear else np.log(gains))
    refuse_still_light(evidence)
    return evidence, photos


def before_ends(evidence: Evidence, edges: Sequence[TableEdge]) -> Evidence:
    """Return the evidence without the cells beyond the ground's ends; as it is where too few would be left."""
    inside = on_table(edges, evidence.cells.points)
    return replace(evidence, weight=evidence.weight * inside) if inside.sum() >= MIN_GROUND else evidence


def thinned(evidence: Evidence) -> Evidence:
    """Return at most FEW_CELLS of the cells that are known in most photos: enough for a search."""
    known = np.flatnonzero((evidence.weight > 0).mean(0) > 0.5)
    if len(known) < MIN_GROUND:
        raise too_little_ground(len(known))
    return evidence.at(known[:: max(len(known) // FEW_CELLS, 1)])


def first_fits(evidence: Evidence) -> FirstFits:
    """Fit a few cells from several starts: all lights at one distance, under one beam; relative powers are alike.

    On a small patch of ground, distance, aim and beam stand in for one another: from any one start the fit may end in a
    wrong minimum. Powers are held alike from the first step on, because one flashlight is.

    Raises:
        CalibrationError: too little ground is usable in most photos.
    """
    thin = thinned(evidence)
    starts = []
    for beam in START_BEAMS:
        for distance in hand.DISTANCES[1:-1]:
            state, weight = refine(_on_sphere(thin, distance, beam), thin, ALIKE_POWER, free_tangent, FAR[:8])
            starts.append((cost(state, thin, weight, ALIKE_POWER), len(starts), state))
    better = sorted(starts)[: len(starts) // 2]  # what is far behind by now does not catch up
    found = [refine(state, thin, ALIKE_POWER, free_tangent, FAR[8:] + NEAR) for _, _, state in better]
    costs = np.array([cost(state, thin, weight, ALIKE_POWER) for state, weight in found])
    best, weight = found[int(costs.argmin())]
    return FirstFits(tuple(state for state, _ in found), costs, independent(best, weight, thin))


def _on_sphere(evidence: Evidence, distance: float, beam: float) -> Flashlights:
    """Return lights of one power at one distance from the photo's middle, each where its photo's ground is lit most so.

    Each photo tries the directions of a hemisphere; then albedo is estimated again. Medians over cells and photos make
    it robust to object and shadows.
    """
    evidence = evidence.at(np.arange(0, evidence.log_grey.shape[1], 3))  # a median needs fewer than a fit
    centre = evidence.cells.centre
    places = centre + distance * DIRECTIONS
    terms = np.r_[beam, np.zeros(EXTRA_TERMS)]

    def state(positions: Float[np.ndarray, "lights 3"]) -> Flashlights:
        targets = np.repeat(centre[None], len(positions), 0)
        return Flashlights(positions, targets, np.zeros(len(positions)), terms, START_AMBIENT, centre)

    table = log_irradiance(state(places), evidence)
    log_grey = np.where(evidence.weight > 0, evidence.log_grey, np.nan)
    shown, index = np.zeros_like(log_grey), np.zeros(len(log_grey), int)
    for _ in range(ROUNDS):
        brightness = log_grey - np.nanmedian(log_grey - shown, axis=0)
        for photo, row in enumerate(brightness):
            known = np.isfinite(row)
            residual = row[known] - table[:, known]
            power = np.median(residual, axis=1)
            index[photo] = np.median(np.abs(residual - power[:, None]), axis=1).argmin()
            shown[photo] = table[index[photo]] + power[index[photo]]
    return state(places[index])


def independent(state: Flashlights, weight: Samples, evidence: Evidence) -> float:
    """Return how many of a fit's weighted samples err independently."""
    effect = design_effect(cell_residuals(state, evidence, weight), weight, evidence)
    return max(float(weight.sum() / evidence.weight.max()) / effect, 1.0)


def alike(weight: Samples) -> float:
    """Return how many of a photo's weighted ground cells are wrong together."""
    cells = (weight > 0).sum(1)
    return max(float(np.median(cells[cells > 0])) / TELLS, 1.0) if cells.any() else 1.0


def design_effect(residual: Samples, weight: Samples, evidence: Evidence) -> float:
    """Return how many cells of a photo err as one: the variance of means of neighbours over that of strangers.

    Kish, Survey Sampling (1965), section 5.4.
    """
    offset = evidence.cells.points[:, :2] - evidence.cells.centre[:2]
    block = np.floor(BLOCKS * (offset - offset.min(0)) / (np.ptp(offset, axis=0) + 1e-9)).astype(int) @ [1, BLOCKS]
    ratio = []
    for row, some in zip(residual, weight > 0, strict=True):
        count = np.bincount(block[some], minlength=BLOCKS**2)
        mean = np.bincount(block[some], row[some] - row[some].mean(), BLOCKS**2) / np.maximum(count, 1)
        ratio.append((count * mean**2)[count > 1].mean() / max(row[some].var(), 1e-12) if (count > 1).any() else 1.0)
    return max(float(np.median(ratio)), 1.0)


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
    fit = FlashlightFit(flashlights, evidence, weight, priors, tangent)
    if fit.ground() < MIN_GROUND:
        raise too_little_ground(fit.ground())
    return fit


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
