"""All lights from outlines of shadows and the shading of all photos together, from rough starts.

The work is bounded: a fit from each start, with outlines blurred at first, then a few fits in rounds. Photos that are
at odds add none.
"""

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from calibration.flashlight.beam_profile import EXTRA_TERMS
from calibration.flashlight.descent import refine
from calibration.flashlight.fit import (
    ALIKE_POWER,
    DIRECTIONS,
    FAR,
    NEAR,
    START_AMBIENT,
    START_BEAM,
    FlashlightFit,
    alike,
    variance_about,
)
from calibration.flashlight.model import (
    NOISE,
    Evidence,
    Flashlights,
    Samples,
    cell_residuals,
    cost,
    log_albedo,
    log_irradiance,
)
from calibration.flashlight.pictured import bent, own_tangent, places_held, without_wall
from calibration.flashlight.wall import WALL_TERMS
from calibration.lights import hand
from calibration.lights.response import bend
from capture.checks.robust import spread

LOG = logging.getLogger(__name__)
BLURS = tuple(np.geomspace(200.0, 1.0, 28))  # factors of an outline's sigma: at first 30 px, as far as rough starts lie
AGAIN = tuple(np.geomspace(10.0, 1.0, 8))  # from a fit on: 1.5 px free lights from false minima
PER_BLUR = 2  # steps with each
SETTLES = 2  # fits in turn: the first tells the misfit by which the second weighs its cells
NO_GROUND = 1e-6  # log units: a misfit of less is that of no cell
LOST = 1e9  # the cost of lights that no ground follows
SCATTER = 15.0  # of the negative log posterior: searches in ten simulated captures end 0 to 23 above the truth's
ROUNDS = 10  # of walls and of lights of other fits, at most
BESIDE = np.radians(15.0)  # between neighbours of a grid of places: DIRECTIONS lie as far apart, ...
REACHES = np.exp(np.arange(np.log(hand.NEAREST), np.log(hand.FARTHEST), BESIDE))  # ... and distances (mm), as a share
PLACES = 4  # of each light, in different directions or distances: where its photo's shading may have a minimum
EVERY = 4  # of the cells, and of the outlines' rays: neighbours err together (SAME of outlines.terms)
WALLED = 3  # walls that are fitted further: places and wall settle together
COMPARED = 4  # fits, of which a light is taken from where it explains its photo best
GAINED = 3.0  # of the negative log posterior, strong evidence [Kass and Raftery 1995]: a last round lowers it less
# tried first: as near as a wall behind a thing stands (mm), of middle grey; the fit moves them
WALLS = tuple(np.array([azimuth, np.log(hand.NEAREST * 1.4), 0.5]) for azimuth in np.arange(8) * np.pi / 4)


class _Found(NamedTuple):
    """A fit, and how probable it is: negative logarithms, up to what all fits to the same evidence share."""

    fit: FlashlightFit
    misfit: float  # of its shading, log units
    by_shading: Float[np.ndarray, " photos"]  # likelihood of each photo's shading
    posterior: float


def searched(
    starts: Sequence[Float[np.ndarray, "photos 3"]], by_shading: Flashlights, evidence: Evidence
) -> FlashlightFit:
    """Fit to outlines and shading together from rough starts; return the most probable fit.

    Outlines alone leave free how far away all lights are, and more where the thing is round; shading alone leaves free
    what distance, beam and response make of one another. What both allow is narrow: each start follows both together,
    with a sigma of the outlines that falls to their own (graduated non-convexity) [Blake and Zisserman, Visual
    Reconstruction (1987)]. In rounds each line then tries a wall, blurred outlines again, and each light where another
    fit has it or where its own photo alone leads it. The worse half of the lines ends with each round (successive
    halving) [Jamieson and Talwalkar, AISTATS (2016)].
    `between` of the fit holds what all fits say that explain the photos about as well.

    Args:
        starts: positions, world.
        by_shading: what shading alone gives, with rings and response; some lights may be far off.
        evidence: with outlines.
    """
    n, centre = len(by_shading.positions), evidence.cells.centre
    aims, beam = np.repeat(centre[None], n, 0), np.r_[START_BEAM, np.zeros(EXTRA_TERMS)]
    plain = bent(Flashlights(by_shading.positions, aims, np.zeros(n), beam, START_AMBIENT, centre), evidence)
    assert evidence.outlines is not None
    few = evidence.at(np.arange(0, len(evidence.cells.points), EVERY))
    few = replace(few, outlines=evidence.outlines.thinned(EVERY))
    lines = [_begun(by_shading, few)]
    for number, one in enumerate(starts):
        LOG.info("fitting lights to outlines of shadows and shading, start %d of %d", number + 1, len(starts))
        lines.append(_begun(replace(plain, positions=one), few))
    found = list(lines)
    for number in range(ROUNDS):
        LOG.info("fitting lights to outlines of shadows and shading, round %d of at most %d", number + 1, ROUNDS)
        before = lines[0].posterior
        for line, best in enumerate(lines):
            new = _improved(best, _likeliest(found, COMPARED), few)
            lines[line] = _likeliest([best, *new], 1)[0]
            found += new
        if len(lines) == 1 and before - lines[0].posterior < GAINED:
            break
        lines = _likeliest(lines, max(len(lines) // 2, 1))
    (best,) = lines
    state = best.fit.flashlights
    posterior = np.array([one.posterior for one in found])
    places = np.stack([one.fit.flashlights.positions for one in found])
    between = variance_about(state.positions, places, np.exp((posterior.min() - posterior) / SCATTER))
    return replace(_settled(state, evidence, best.misfit).fit, between=between)


def _improved(best: _Found, found: Sequence[_Found], evidence: Evidence) -> list[_Found]:
    """Return fits from the best one: with blurred outlines, with lights of the others that were found, with a wall."""
    state = best.fit.flashlights
    mixed = _best_of_each(best, [*found, *_elsewhere(best, evidence)], evidence)
    walled = [_shaded(replace(state, wall=wall), evidence) for wall in WALLS if state.wall[2] <= 0]
    misfits = best.misfit, spread(cell_residuals(mixed, evidence, evidence.weight)[evidence.weight > 0])
    new = [_annealed(one, evidence, misfit, AGAIN) for one, misfit in zip((state, mixed), misfits, strict=True)]
    return new + [_settled(one.fit.flashlights, evidence, one.misfit) for one in _likeliest(walled, WALLED)]


def _elsewhere(best: _Found, evidence: Evidence) -> list[_Found]:
    """Return fits of each light by itself to its photo's shading, from its likeliest places in a hand's reach.

    One photo's shading has several minima, and outlines hold a light in a false one while other lights are still off.
    Albedo, beam, response and wall are the best fit's, so that a grid tells each light's places without a fit.
    """
    state, centre = best.fit.flashlights, evidence.cells.centre
    albedo = log_albedo(state, evidence, best.fit.weight)
    grid = np.concatenate([centre + reach * DIRECTIONS for reach in REACHES])
    power = np.full(len(grid), np.median(state.log_power))
    there = replace(state, positions=grid, targets=np.repeat(state.aim[None], len(grid), 0), log_power=power)
    light = log_irradiance(replace(there, response=np.zeros(0)), evidence)
    among = log_irradiance(state, evidence)
    exposure = np.zeros(len(among)) if evidence.exposure is None else evidence.exposure
    chosen = np.zeros((PLACES, len(state.positions)), int)
    for photo, exposed in enumerate(exposure - np.median(among + exposure[:, None])):
        shown = light + bend(light + exposed, state.response) if len(state.response) else light
        off = (evidence.log_grey[photo] - albedo - shown)[:, evidence.weight[photo] > 0]
        order = np.median(np.abs(off - np.median(off, axis=1, keepdims=True)), axis=1).argsort()
        for rank in range(PLACES):
            chosen[rank, photo] = order[0]
            apart = np.linalg.norm(grid[order] - grid[order[0]], axis=1)
            order = order[apart > BESIDE * np.linalg.norm(grid[order[0]] - centre)]
    alone, found = replace(_weighted(evidence, best.misfit), outlines=None), []
    for some in chosen:
        moved = replace(there, positions=grid[some], targets=there.targets[some], log_power=power[some])
        new, weight = refine(moved, alone, ALIKE_POWER, own_tangent, FAR[:6] + NEAR[-2:])
        found.append(_judged(new, evidence, weight))
    return found


def settled(start: Flashlights, evidence: Evidence) -> FlashlightFit:
    """Return the fit to outlines and shading from a state near the answer."""
    return _settled(start, evidence, _shaded(start, evidence).misfit).fit


def _begun(start: Flashlights, evidence: Evidence) -> _Found:
    """Return the fit from rough places on."""
    begun = _shaded(start, evidence)
    return _annealed(begun.fit.flashlights, evidence, begun.misfit, BLURS)


def _annealed(state: Flashlights, evidence: Evidence, misfit: float, blurs: Sequence[float]) -> _Found:
    """Return the fit with outlines first blurred and then sharp; misfit: of the shading, log units."""
    terms = evidence.outlines
    assert terms is not None
    for blur in blurs:
        weighted = _weighted(replace(evidence, outlines=replace(terms, blur=float(blur))), misfit)
        state, weight = refine(state, weighted, ALIKE_POWER, without_wall, FAR[:PER_BLUR])
        misfit = spread(cell_residuals(state, evidence, weight)[evidence.weight > 0])
    return _settled(state, evidence, misfit)


def _shaded(like: Flashlights, evidence: Evidence) -> _Found:
    """Return the state with such places and wall whose beam, aims, powers and response shade the ground best."""
    state, weight = refine(like, replace(evidence, outlines=None), ALIKE_POWER, places_held, FAR[:6])
    return _judged(state, evidence, weight)


def _best_of_each(best: _Found, found: Sequence[_Found], evidence: Evidence) -> Flashlights:
    """Return the best fit's state, each light where the fit has it that explains its photo best, the others held.

    A photo's shading counts as cells whose errors are independent, its own rays and the camera's as they do in the fit.
    """
    terms, state = evidence.outlines, best.fit.flashlights
    assert terms is not None
    own = np.eye(len(state.positions)) > 0
    costs = []
    for other in found:
        moved = np.where(own[..., None], other.fit.flashlights.positions, state.positions)
        costs.append(other.by_shading + [terms.own_cost(photo, at) for photo, at in enumerate(moved)])
    chosen = np.argmin(costs, axis=0)

    def taken(values: Sequence[np.ndarray]) -> np.ndarray:
        return np.stack(values)[chosen, np.arange(len(chosen))]

    states = [other.fit.flashlights for other in found]
    return replace(
        state,
        positions=taken([one.positions for one in states]),
        targets=taken([one.targets for one in states]),
        log_power=taken([one.log_power for one in states]),
    )


def _likeliest(found: Sequence[_Found], count: int) -> list[_Found]:
    return [found[k] for k in np.argsort([one.posterior for one in found], kind="stable")[:count]]


def _settled(start: Flashlights, evidence: Evidence, misfit: float) -> _Found:
    """Refine a state near the answer; misfit: of the shading, log units, by which its cells are weighted."""
    found = None
    for _ in range(SETTLES):
        weighted = _weighted(evidence, misfit)
        start, weight = refine(start, weighted, ALIKE_POWER, without_wall, FAR[:4] + NEAR)
        found = _judged(start, evidence, weight)
        misfit = found.misfit
    assert found is not None
    return found


def _judged(flashlights: Flashlights, evidence: Evidence, weight: Samples) -> _Found:
    """Return a state as a fit, and how probable it is by outlines, priors and shading.

    A photo's shading counts as cells whose errors are independent, of a size of its own: log(misfit) for each. A wall
    pays for its terms [Schwarz, Estimating the Dimension of a Model, Annals of Statistics 6 (1978)].
    """
    residual, known, worth = cell_residuals(flashlights, evidence, weight), evidence.weight > 0, alike(evidence.weight)
    misfit = spread(residual[known])
    fit = FlashlightFit(flashlights, _weighted(evidence, misfit), weight, ALIKE_POWER, without_wall)
    own = [spread(r[k]) if k.any() else 1.0 for r, k in zip(residual, known, strict=True)]
    by_shading = known.sum(1) / worth * np.log(np.maximum(own, NO_GROUND))
    lost = 0.0 if (weight > 0).any() else LOST
    other = lost + cost(flashlights, evidence, np.zeros_like(weight), ALIKE_POWER)
    terms = (flashlights.wall[2] > 0) * WALL_TERMS / 2 * np.log(known.sum() / worth)
    return _Found(fit, misfit, by_shading, other + by_shading.sum() + terms)


def _weighted(evidence: Evidence, misfit: float) -> Evidence:
    """Weight all photos' cells as their misfit (log units) and their likeness allow."""
    trust = (NOISE / max(misfit, NO_GROUND)) ** 2 / alike(evidence.weight)
    return replace(evidence, weight=evidence.weight * trust)
