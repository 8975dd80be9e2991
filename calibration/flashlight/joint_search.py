"""All lights from outlines of shadows and the shading of all photos together, from rough starts.

The work is bounded: outlines alone from each start, then a few fits to both in rounds, of other distances and walls.
Photos that are at odds add none.
"""

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from calibration.flashlight.beam_profile import EXTRA_TERMS, SMOOTH_TERMS
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
    LAMP,
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
from calibration.flashlight.wall import WALL_TERMS, Wall
from calibration.lights import hand
from calibration.lights.response import bend
from capture.checks.robust import spread

LOG = logging.getLogger(__name__)
BLURS = tuple(np.geomspace(200.0, 1.0, 14))  # factors of an outline's sigma: at first 30 px, as far as rough starts lie
PER_BLUR = 3  # steps with each
SETTLES = 2  # fits in turn: the first tells the misfit by which the second weighs its cells
MUTE = 1e-9  # times a cell's weight: outlines alone
NO_GROUND = 1e-6  # log units: a misfit of less is that of no cell
LOST = 1e9  # the cost of lights that no ground follows
SCATTER = 15.0  # of the negative log posterior: searches in ten simulated captures end 0 to 23 above the truth's
FARTHER = (0.5, 0.6, 0.72, 0.85, 1.0, 1.18, 1.4, 1.65, 2.0)  # along what outlines leave free: a hand's range
HOPS = (0.7, 0.85, 1.18, 1.4)  # likewise, from a fit on: half a stop and one, of what the ground receives
ROUNDS = 10  # of other walls and distances, at most
BESIDE = np.radians(15.0)  # between neighbours of a grid of places: DIRECTIONS lie as far apart, ...
REACHES = np.exp(np.arange(np.log(hand.NEAREST), np.log(hand.FARTHEST), BESIDE))  # ... and distances (mm), as a share
PLACES = 4  # of each light, in different directions or distances: where its photo's shading may have a minimum
EVERY = 4  # of the cells, and of the outlines' rays: neighbours err together (SAME of outlines.terms)
COMPARED = 4  # fits, of which a light is taken from where it explains its photo best
GAINED = 3.0  # of the negative log posterior, strong evidence [Kass and Raftery 1995]: a last round lowers it less
NEAR_INFINITY = 0.05  # a light that would be moved 20 times as far stays
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
    what distance, beam and response make of one another. What both allow is narrow. First each start follows the
    outlines alone, with a sigma that falls to their own (graduated non-convexity) [Blake and Zisserman, Visual
    Reconstruction (1987)]. In rounds all lights of each line are then tried at other distances, with a wall, and each
    light where another fit has it or where its own photo alone leads it; the most probable are fitted to both. The
    worse half of the lines ends with each round (successive halving) [Jamieson and Talwalkar, AISTATS (2016)].
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
    lines = [_settled(by_shading, few, _judged(by_shading, few, few.weight).misfit)]
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
    """Return fits from the best one with a wall, at another distance, and with lights of the others that were found."""
    state = best.fit.flashlights
    walled = [_shaded(state, state.positions, wall, evidence) for wall in WALLS if state.wall[2] <= 0]
    hops = [one for times in HOPS for one in _both(state, farther(state.positions, evidence, times), evidence)]
    tried = [*_likeliest(walled, 1), *_likeliest(hops, 1)]
    mixed = _settled(_best_of_each(best, [*found, *_elsewhere(best, evidence)], evidence), evidence, best.misfit)
    return [mixed, *(_settled(one.fit.flashlights, evidence, one.misfit) for one in tried)]


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
    return _settled(start, evidence, _shaded(start, start.positions, start.wall, evidence).misfit).fit


def _by_outlines(start: Flashlights, evidence: Evidence) -> Flashlights:
    """Return the lights where outlines alone lead them, blurred at first."""
    assert evidence.outlines is not None
    few = evidence.at(np.arange(2))
    few = replace(few, weight=np.full_like(few.weight, MUTE))
    columns = np.arange(start.per_flashlight() * len(start.positions)) % start.per_flashlight() < 3
    full = len(columns) + start.shared()
    held = np.eye(full)[:, : len(columns)][:, columns]
    for blur in BLURS:
        blurred = replace(few, outlines=replace(evidence.outlines, blur=float(blur)))
        start = refine(start, blurred, ALIKE_POWER, lambda _: held, FAR[:PER_BLUR])[0]
    return start


def _begun(start: Flashlights, evidence: Evidence) -> _Found:
    """Return the best of two fits from where outlines alone lead the lights, each at the likeliest distance."""
    places = _by_outlines(start, evidence).positions
    tried = [_both(start, farther(places, evidence, times), evidence) for times in FARTHER]
    best = [_likeliest(same, 1)[0] for same in zip(*tried, strict=True)]
    return _likeliest([_settled(one.fit.flashlights, evidence, one.misfit) for one in best], 1)[0]


def _both(like: Flashlights, places: Float[np.ndarray, "photos 3"], evidence: Evidence) -> tuple[_Found, _Found]:
    """Return the state with such places, shaded from its own beam and response, and by a smooth beam without response.

    Rings and response stand in for what is wrong with places far off; few terms lead to places nearer the truth.
    """
    smooth = replace(like, positions=places, beam=like.beam[:SMOOTH_TERMS], response=np.zeros(0))
    smooth, weight = _lighting(smooth, evidence)
    return _shaded(like, places, like.wall, evidence), _judged(bent(smooth, evidence), evidence, weight)


def _shaded(like: Flashlights, places: Float[np.ndarray, "photos 3"], wall: Wall, evidence: Evidence) -> _Found:
    """Return the state with such places and wall whose beam, aims, powers and response shade the ground best."""
    state, weight = _lighting(replace(like, positions=places, wall=wall), evidence)
    return _judged(state, evidence, weight)


def _lighting(state: Flashlights, evidence: Evidence) -> tuple[Flashlights, Samples]:
    """Return the state whose beam, aims, powers and response shade the ground best, its places held, and weights."""
    return refine(state, replace(evidence, outlines=None), ALIKE_POWER, places_held, FAR[:6])


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
