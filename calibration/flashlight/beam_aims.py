"""Where beams point and lights are, looked for anew: a beam with a hot centre or a ring has many local minima."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from calibration.flashlight.fit import misfits
from calibration.flashlight.model import Evidence, Flashlights, Samples, across, cell_residuals, log_irradiance

OFF_AXIS = tuple(np.radians([0.0, 7.0, 14.0, 21.0, 28.0, 35.0]))  # of the rings of trial axes, from where people aim
PER_RING = 6  # trial axes on the first ring; the others have as many more
EVERY = 3  # of the ground's cells: many, to tell two aims apart
CLEARLY = 0.9  # of the residual with the present aim: better aims are taken


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
