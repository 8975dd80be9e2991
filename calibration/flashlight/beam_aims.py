"""Where beams point and lights are, looked for anew: a beam with a hot centre or a ring has many local minima."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from calibration.flashlight.fit import hemisphere
from calibration.flashlight.model import Evidence, Flashlights, Samples, across, cell_residuals, log_irradiance

OFF_AXIS = tuple(np.radians([0.0, 7.0, 14.0, 21.0, 28.0, 35.0]))  # of the rings of trial axes, from where people aim
PER_RING = 6  # trial axes on the first ring; the others have as many more
EVERY = 3  # of the ground's cells: many, to tell two aims apart
CLEARLY = 0.9  # of the residual with the present aim: better aims are taken
POWER_VOTE = 0.1  # a flashlight 10 % brighter than the others counts like 1 % of misfit


def looked_for_aims(
    flashlights: Flashlights, evidence: Evidence, weight: Samples, photos: Sequence[int] | None = None
) -> Flashlights:
    """Return the state with the aims (and powers) of least median absolute residual, places and beam held.

    Args:
        weight: of the samples, as a fit left them: they tell the ground's albedo.
        photos: whose aims are looked for; None: all.
    """
    thin, level = _ground(flashlights, evidence, weight)
    targets, power = flashlights.targets.copy(), flashlights.log_power.copy()
    for k in range(len(targets)) if photos is None else photos:
        if not (thin.weight[k] > 0).any():
            continue
        place = flashlights.positions[k]
        trials = np.concatenate([targets[k : k + 1], _trial_targets(flashlights.aim, place)])
        size, offset = _misfits(flashlights, thin, level, k, np.repeat(place[None], len(trials), 0), trials)
        best = int(np.argmin(size))
        if size[best] < CLEARLY * size[0]:
            targets[k], power[k] = trials[best], offset[best]
    return replace(flashlights, targets=targets, log_power=power)


def places_by_shading(
    flashlights: Flashlights, evidence: Evidence, weight: Samples, k: int, count: int
) -> Float[np.ndarray, "count 3"]:
    """Return the places (world) of least median absolute residual of light k, its beam aimed as suits each, best first.

    Tried are where it is, and places all around that a hand may hold it at.

    Args:
        weight: of the samples, as a fit left them: they tell the ground's albedo.
        count: of the places, at most; none where photo k shows no ground.
    """
    thin, level = _ground(flashlights, evidence, weight)
    places, least = np.concatenate([flashlights.positions[k : k + 1], *hemisphere(evidence.cells)]), []
    if not (thin.weight[k] > 0).any():
        return places[:0]
    for place in places:
        trials = _trial_targets(flashlights.aim, place)
        least.append(_misfits(flashlights, thin, level, k, np.repeat(place[None], len(trials), 0), trials)[0].min())
    return places[np.argsort(least, kind="stable")[:count]]


def _ground(
    flashlights: Flashlights, evidence: Evidence, weight: Samples
) -> tuple[Evidence, Float[np.ndarray, " thinned"]]:
    """Return every third cell of those that follow the light, and their log albedo."""
    residuals = cell_residuals(flashlights, evidence, weight)
    level = (evidence.log_grey - log_irradiance(flashlights, evidence) - residuals)[0]
    some = np.flatnonzero(weight.sum(0) > 0)[::EVERY]
    cells = evidence.cells
    thin = replace(cells, points=cells.points[some], rgb=cells.rgb[:, some], usable=cells.usable[:, some])
    return Evidence(thin, evidence.height, evidence.log_grey[:, some], evidence.weight[:, some]), level[some]


def _misfits(
    flashlights: Flashlights,
    thin: Evidence,
    level: Float[np.ndarray, " cells"],
    k: int,
    places: Float[np.ndarray, "trials 3"],
    targets: Float[np.ndarray, "trials 3"],
) -> tuple[Float[np.ndarray, " trials"], Float[np.ndarray, " trials"]]:
    """Return photo k's median absolute residual from each place and target, an unusual power added; and log powers."""
    use = thin.weight[k] > 0
    cells = thin.cells
    cells = replace(cells, points=cells.points[use], rgb=cells.rgb[:, use], usable=cells.usable[:, use])
    own = Evidence(cells, thin.height, thin.log_grey[:, use], thin.weight[:, use])
    state = replace(flashlights, positions=places, targets=targets, log_power=np.zeros(len(places)))
    residual = own.log_grey[k] - level[use] - log_irradiance(state, own)
    offset = np.median(residual, axis=1)
    size = np.median(np.abs(residual - offset[:, None]), axis=1)
    return size + POWER_VOTE * np.minimum(np.abs(offset - float(np.median(flashlights.log_power))), 1), offset


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
