"""All lights from outlines of shadows and the shading of all photos together, from rough starts.

The work is bounded by the number of photos: two passes from each start, one from what is best of all of them photo by
photo, a few with other walls and at other distances, and one short fit per contrast. Photos that are at odds add none.
"""

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from calibration.flashlight.beam_profile import BROAD_TERMS, EXTRA_TERMS
from calibration.flashlight.descent import refine
from calibration.flashlight.fit import (
    FAR,
    NEAR,
    START_AMBIENT,
    START_BEAM,
    FlashlightFit,
    alike,
    misfits,
    variance_about,
)
from calibration.flashlight.model import (
    LAMP,
    NOISE,
    Evidence,
    Flashlights,
    Priors,
    Samples,
    across,
    cell_residuals,
    log_irradiance,
)
from calibration.flashlight.pictured import places_held, without_wall
from calibration.flashlight.wall import NO_WALL, WALL_TERMS, Wall
from calibration.lights import hand
from capture.checks.robust import spread

LOG = logging.getLogger(__name__)
OFF_AXIS = tuple(np.radians([0.0, 7.0, 14.0, 21.0, 28.0, 35.0]))  # of the rings of trial axes, from where people aim
PER_RING = 6  # trial axes on the first ring; the others have as many more
EVERY = 3  # of the ground's cells: many, to tell two aims apart
CLEARLY = 0.9  # of the residual with the present aim: better aims are taken
AIM_ROUNDS = 2  # of looking for aims, each with the beam that the last one's aims gave
USUAL_MISFIT = 0.03  # log units, before it is measured
# factors of an outline's sigma: at first 30 px, as far as rough starts lie, or 3 px, which far-off shading leaves there
BLURS = (np.geomspace(200.0, 1.0, 14), np.geomspace(20.0, 1.0, 8))
PER_BLUR = 3  # steps with each
NO_GROUND = 1e-6  # log units: a misfit of less is that of no cell
LOST = 1e9  # the cost of lights that no ground follows
SCATTER = 30.0  # of the negative log posterior between searches by other steps: it has many small minima
FARTHER = (0.5, 0.6, 0.72, 0.85, 1.18, 1.4, 1.65, 2.0)  # along what outlines leave free: a hand's range
ROUNDS = 3  # of other walls and distances, at most
TRIED = 4  # of a round's: those that are fitted
NEAR_INFINITY = 0.05  # a light that would be moved 20 times as far stays
# tried first: as near as a wall behind a thing stands (mm), of middle grey; the fit moves them
WALLS = tuple(np.array([azimuth, np.log(hand.NEAREST * 1.4), 0.5]) for azimuth in np.arange(8) * np.pi / 4)
CONTRASTS = (1.1, 1.0, 0.9, 0.8, 0.7)  # of log brightness in the picture over that in the scene, that are tried
CONTRAST_WIDTH = 0.1  # prior sigma of its logarithm about 0: phones lift whole regions that are dark
_Found = tuple[float, FlashlightFit, float]  # cost of its outlines, fit, misfit of its shading (log units)
LOOSE = Priors(log_power=0.03, power_outlier=0.5)  # one lamp: .006 to .03 where it and the phone's exposure hold still


def searched(starts: Sequence[Float[np.ndarray, "photos 3"]], evidence: Evidence) -> FlashlightFit:
    """Fit to outlines and shading together from rough starts; return the best fit.

    Outlines alone pull all lights too near, and one light that is too near, its beam aimed elsewhere, may agree with
    its photo. So both are fitted from the first step on, with an outline's sigma that falls to its own (graduated
    non-convexity) [Blake and Zisserman, Visual Reconstruction (1987)]. A light that is lost from one start is found
    from another: the last pass begins with each photo's best, and from the best of all other walls and distances are
    tried. `between` of the fit holds what the others say that explain the photos about as well.

    Args:
        starts: positions, world.
        evidence: with outlines; photos that these do not trust are placed by their shading.
    """
    assert evidence.outlines is not None
    trusted = _trusted(evidence)
    found = []
    for number, one in enumerate(starts):
        LOG.info("fitting lights to outlines of shadows and shading, start %d of %d", number + 1, len(starts) + 1)
        state = _held(one, _weighted(trusted, USUAL_MISFIT), None)[0]
        found += [_pass(state, trusted, USUAL_MISFIT, blurs) for blurs in BLURS]
    best = _likeliest(found, trusted)
    LOG.info("fitting lights to outlines of shadows and shading, start %d of %d", len(starts) + 1, len(starts) + 1)
    found.append(_pass(_best_of_each(best, found, evidence), trusted, best[2], BLURS[0]))
    found += _elsewhere(_likeliest(found, trusted), trusted)
    posterior = _posteriors(found, trusted)
    best = found[int(posterior.argmin())]
    places = np.stack([one[1].flashlights.positions for one in found])
    weight = np.exp((posterior.min() - posterior) / SCATTER)
    between = variance_about(best[1].flashlights.positions, places, weight) * evidence.outlines.trusted[:, None]
    fit = _settled(_best_of_each(best, found, evidence), evidence, best[2])[1]
    return replace(fit, between=between)


def _elsewhere(best: _Found, evidence: Evidence) -> list[_Found]:
    """Return fits from the best one with a wall in each of eight directions, or none, and at other distances.

    Fits creep along what outlines leave free, and a wall is found from near its place only. Each is tried with the
    places held; those that then shade best are fitted, and the best of these is where the next round begins.
    """
    found = []
    for _ in range(ROUNDS):
        state = best[1].flashlights
        tried = [_shaded(best, state.positions, wall, evidence) for wall in (NO_WALL, *WALLS)]
        places = [farther(state.positions, evidence, times) for times in FARTHER]
        tried += [_shaded(best, one, state.wall, evidence) for one in places]
        order = _posteriors(tried, evidence).argsort()[:TRIED]
        found += [_settled(tried[k][1].flashlights, evidence, best[2]) for k in order]
        before, best = best, _likeliest([best, *found], evidence)
        if best is before:
            break
    return found


def _shaded(like: _Found, places: Float[np.ndarray, "photos 3"], wall: Wall, evidence: Evidence) -> _Found:
    """Return the state with such places and wall whose beam, aims and powers shade the ground best."""
    state = replace(like[1].flashlights, positions=places, wall=wall)
    weighted = _weighted(evidence, USUAL_MISFIT)
    state, weight = refine(state, replace(weighted, outlines=None), LOOSE, places_held, FAR[:6])
    return _judged(state, evidence, weighted, weight)


def farther(
    positions: Float[np.ndarray, "photos 3"], evidence: Evidence, times: float
) -> Float[np.ndarray, "photos 3"]:
    """Return the lights moved as outlines do not see it, the middle one so many times as far from the eye; world.

    A perspectivity that keeps the ground's points and the eye turns one object, its shadows and its outline into
    another's [Kriegman and Belhumeur, What shadows reveal about object structure, J. Opt. Soc. Am. A 18 (2001)].
    """
    terms = evidence.outlines
    assert terms is not None
    ground = np.array([0.0, 0.0, terms.ground])
    above, eye = positions - ground, terms.eye - ground
    share = (1 / times - 1) / np.median(above[:, 2])
    across = 1 + share * above[:, 2:]
    moved = (above + share * above[:, 2:] * eye) / np.maximum(across, NEAR_INFINITY)
    return np.where((across > NEAR_INFINITY) & (moved[:, 2:] > LAMP), moved, above) + ground


def _best_of_each(best: _Found, found: Sequence[_Found], evidence: Evidence) -> Flashlights:
    """Return the best fit's state, each light where the fit has it that explains its photo best, the others held.

    A photo's shading counts as cells whose errors are independent, its outlines as they do in the fit.
    """
    fit = best[1]
    terms, state = evidence.outlines, fit.flashlights
    assert terms is not None
    albedo = (evidence.log_grey - log_irradiance(state, evidence) - cell_residuals(state, evidence, fit.weight))[0]
    ground = fit.weight.sum(0) > 0
    cells = (evidence.weight > 0).sum(1) / alike(evidence.weight)
    costs, trials = [], []
    for one in found:
        trial = replace(one[1].flashlights, beam=state.beam, ambient=state.ambient, aim=state.aim)
        trial = looked_for_aims(trial, evidence, fit.weight)
        residual = evidence.log_grey - log_irradiance(trial, evidence) - albedo
        misfit = [spread(r[m & ground]) for r, m in zip(residual, evidence.weight > 0, strict=True)]
        moved = np.repeat(state.positions[None], len(cells), 0)
        moved[np.arange(len(cells)), np.arange(len(cells))] = trial.positions
        shadows = [
            replace(terms, trusted=terms.trusted | own).cost(at)
            for own, at in zip(np.eye(len(cells)) > 0, moved, strict=True)
        ]
        costs.append(cells * np.log(np.maximum(misfit, NO_GROUND)) + shadows)
        trials.append(trial)
    chosen = np.argmin(costs, axis=0)

    def taken(values: Sequence[np.ndarray]) -> np.ndarray:
        return np.stack(values)[chosen, np.arange(len(chosen))]

    return replace(
        state,
        positions=taken([one.positions for one in trials]),
        targets=taken([one.targets for one in trials]),
        log_power=taken([one.log_power for one in trials]),
    )


def _pass(state: Flashlights, evidence: Evidence, misfit: float, blurs: Float[np.ndarray, " blurs"]) -> _Found:
    """Fit with outlines that are blurred at first."""
    assert evidence.outlines is not None
    weighted = _weighted(evidence, misfit)
    for blur in blurs:
        blurred = replace(weighted, outlines=replace(evidence.outlines, blur=float(blur)))
        state = refine(state, blurred, LOOSE, without_wall, FAR[:PER_BLUR])[0]
    return _settled(state, evidence, misfit)


def at_best_contrast(start: Flashlights, evidence: Evidence, contrasts: Sequence[float] = CONTRASTS) -> FlashlightFit:
    """Fit to outlines and shading together under the contrast that explains the photos best.

    A phone that evens out brightness over whole regions shows a share of the differences of log brightness that the
    light makes. Taken for the light's, these place all lights too far away. The share is one number for all photos: its
    posterior mean is taken, and `between` of the fit holds what other shares would give. The fit that is returned has
    beam and powers as they are in the pictures.

    Args:
        start: places, aims, powers and beam near the answer.
        evidence: with outlines.
        contrasts: that are tried, one after the other; 1 alone where the photos are linear.
    """
    found: list[_Found] = []
    state, misfit = start, USUAL_MISFIT
    for number, one in enumerate(contrasts):
        LOG.info("fitting the lights under contrast %d of %d", number + 1, len(contrasts))
        found.append(_settled(state, _flattened(evidence, one), misfit))
        state, misfit = found[-1][1].flashlights, found[-1][2]
    shown = [(cost, fit, one * misfit) for one, (cost, fit, misfit) in zip(contrasts, found, strict=True)]
    surprise = np.log(contrasts) / CONTRAST_WIDTH
    cost = _posteriors(shown, evidence) + 0.5 * surprise**2  # of the misfit in the pictures
    weight = np.exp(cost.min() - cost)
    best = float(weight @ contrasts / weight.sum())
    near = found[int(np.abs(np.array(contrasts) - best).argmin())][1].flashlights
    fit = _settled(near, _flattened(evidence, best), misfit)[1]
    places = np.stack([one.flashlights.positions for _, one, _ in found])
    between = variance_about(np.einsum("f,fkx->kx", weight / weight.sum(), places), places, weight)
    return _as_pictured(replace(fit, between=between), evidence)


def _flattened(evidence: Evidence, contrast: float) -> Evidence:
    return replace(evidence, log_grey=evidence.log_grey / contrast)


def _as_pictured(fit: FlashlightFit, evidence: Evidence) -> FlashlightFit:
    """Fit beam, aims and powers to the evidence with the places held, so that they say what the pictures show."""
    weighted = _weighted(evidence, USUAL_MISFIT)
    flashlights, weight = _held(fit.flashlights.positions, weighted, fit.flashlights)
    return replace(_judged(flashlights, evidence, weighted, weight)[1], between=fit.between)


def _posteriors(found: Sequence[_Found], evidence: Evidence) -> Float[np.ndarray, " found"]:
    """Return the negative log posteriors of fits to the same evidence, up to a constant that they share.

    The shading counts as cells whose errors are independent, as many as in the fits themselves: log(misfit) for each. A
    wall pays for its terms [Schwarz, Estimating the Dimension of a Model, Annals of Statistics 6 (1978)].
    """
    misfit = np.maximum([one[2] for one in found], NO_GROUND)
    cells = (evidence.weight > 0).sum() / alike(evidence.weight)
    walls = np.array([one[1].flashlights.wall[2] > 0 for one in found])
    return np.array([one[0] for one in found]) + cells * np.log(misfit) + walls * WALL_TERMS / 2 * np.log(cells)


def _likeliest(found: Sequence[_Found], evidence: Evidence) -> _Found:
    return found[int(_posteriors(found, evidence).argmin())]


def _settled(start: Flashlights, evidence: Evidence, misfit: float) -> _Found:
    """Refine a state near the answer; misfit: of the shading, log units, by which its cells are weighted."""
    weighted = _weighted(evidence, misfit)
    flashlights, weight = refine(start, weighted, LOOSE, without_wall, FAR[:8] + NEAR)
    return _judged(flashlights, evidence, weighted, weight)


def _judged(flashlights: Flashlights, evidence: Evidence, weighted: Evidence, weight: Samples) -> _Found:
    """Return a state as a fit, with the cost of its outlines and the misfit of its shading; weight: of its samples."""
    assert evidence.outlines is not None
    misfit = spread(cell_residuals(flashlights, weighted, weight)[weighted.weight > 0])
    return (
        evidence.outlines.cost(flashlights.positions) if (weight > 0).any() else LOST,
        FlashlightFit(flashlights, _weighted(evidence, misfit), weight, LOOSE, without_wall),
        misfit,
    )


def _trusted(evidence: Evidence) -> Evidence:
    """Return the evidence without the cells of those photos whose outlines are not trusted."""
    assert evidence.outlines is not None
    return replace(evidence, weight=evidence.weight * evidence.outlines.trusted[:, None])


def _weighted(evidence: Evidence, misfit: float) -> Evidence:
    """Weight all photos' cells as their misfit (log units) and their likeness allow."""
    trust = (NOISE / max(misfit, NOISE)) ** 2 / alike(evidence.weight)
    return replace(evidence, weight=evidence.weight * trust)


def _held(
    places: Float[np.ndarray, "photos 3"], evidence: Evidence, like: Flashlights | None
) -> tuple[Flashlights, Samples]:
    """Fit beam, aims and powers with the places held; return also the samples' weights.

    Where nothing is known of them yet, aims are looked for.
    """
    n, centre = len(places), evidence.cells.centre
    evidence = replace(evidence, outlines=None)
    if like is not None:
        return refine(replace(like, positions=places), evidence, LOOSE, places_held, FAR[:2] + NEAR)
    beam = np.r_[START_BEAM, np.zeros(EXTRA_TERMS + BROAD_TERMS)]
    state = Flashlights(places, np.repeat(centre[None], n, 0), np.zeros(n), beam, START_AMBIENT, centre)
    for _ in range(AIM_ROUNDS):
        state, weight = refine(state, evidence, LOOSE, places_held, FAR[:8] + NEAR)
        state = looked_for_aims(state, evidence, weight)
    return refine(state, evidence, LOOSE, places_held, FAR[:8] + NEAR)


def looked_for_aims(flashlights: Flashlights, evidence: Evidence, weight: Samples) -> Flashlights:
    """Return the state with the aims (and powers) of least median absolute residual, places and beam held.

    Args:
        weight: of the samples, as a fit left them: they tell the ground's albedo.
    """
    thin = _without_albedo(flashlights, evidence, weight)
    targets, power = flashlights.targets.copy(), flashlights.log_power.copy()
    for k in range(len(targets)):
        own = thin.at(thin.weight[k] > 0)
        if not len(own.cells.points):
            continue
        place = flashlights.positions[k]
        trials = np.concatenate([targets[k : k + 1], _trial_targets(flashlights.aim, place)])
        size, offset = _misfits(flashlights, own, k, place, trials)
        best = int(np.argmin(size))
        if size[best] < CLEARLY * size[0]:
            targets[k], power[k] = trials[best], offset[best]
    return replace(flashlights, targets=targets, log_power=power)


def _without_albedo(flashlights: Flashlights, evidence: Evidence, weight: Samples) -> Evidence:
    """Return every third cell of those that follow the light, its log albedo taken out of its brightness."""
    residuals = cell_residuals(flashlights, evidence, weight)
    level = (evidence.log_grey - log_irradiance(flashlights, evidence) - residuals)[0]
    some = np.flatnonzero(weight.sum(0) > 0)[::EVERY]
    thin = evidence.at(some)
    return replace(thin, log_grey=thin.log_grey - level[some])


def _misfits(
    flashlights: Flashlights,
    own: Evidence,
    k: int,
    place: Float[np.ndarray, "3"],
    targets: Float[np.ndarray, "trials 3"],
):
    """Return what `misfits` does of photo k, its light in one place and aimed at each target.

    Args:
        own: of the cells that photo k shows, without albedo.
    """
    n = len(targets)
    state = replace(flashlights, positions=np.repeat(place[None], n, 0), targets=targets, log_power=np.zeros(n))
    return misfits(own.log_grey[k] - log_irradiance(state, own), float(np.median(flashlights.log_power)))


def _trial_targets(aim: Float[np.ndarray, "3"], place: Float[np.ndarray, "3"]) -> Float[np.ndarray, "trials 3"]:
    """Return targets around where all aim on average, at rings of angles about the way there."""
    arm = aim - place
    reach = float(np.linalg.norm(arm))
    axis = arm / reach
    first, second = (one[0] for one in across(axis[None]))
    found = [axis]
    for ring, angle in enumerate(OFF_AXIS[1:], 1):
        turn = np.linspace(0, 2 * np.pi, PER_RING * ring, endpoint=False)[:, None]
        found += list(np.cos(angle) * axis + np.sin(angle) * (np.cos(turn) * first + np.sin(turn) * second))
    return place + reach * np.array(found)
