"""Where each beam points, looked for anew: a beam with a hot centre or a ring has many local minima by its aim."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

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
    residuals = cell_residuals(flashlights, evidence, weight)
    level = (evidence.log_grey - log_irradiance(flashlights, evidence) - residuals)[0]
    some = np.flatnonzero(weight.sum(0) > 0)[::EVERY]
    cells = evidence.cells
    thin = replace(cells, points=cells.points[some], rgb=cells.rgb[:, some], usable=cells.usable[:, some])
    thinned = Evidence(thin, evidence.height, evidence.log_grey[:, some], evidence.weight[:, some])
    targets, power = flashlights.targets.copy(), flashlights.log_power.copy()
    common = float(np.median(power))
    for k in range(len(targets)) if photos is None else photos:
        use = thinned.weight[k] > 0
        if not use.any():
            continue
        trials = np.concatenate([targets[k : k + 1], _trial_targets(flashlights, k)])
        many = np.repeat(flashlights.positions[k : k + 1], len(trials), 0)
        state = replace(flashlights, positions=many, targets=trials, log_power=np.zeros(len(trials)))
        residual = (thinned.log_grey[k] - level[some] - log_irradiance(state, thinned))[:, use]
        offset = np.median(residual, axis=1)
        size = np.median(np.abs(residual - offset[:, None]), axis=1)
        size += POWER_VOTE * np.minimum(np.abs(offset - common), 1)
        best = int(np.argmin(size))
        if size[best] < CLEARLY * size[0]:
            targets[k], power[k] = trials[best], offset[best]
    return replace(flashlights, targets=targets, log_power=power)


def _trial_targets(flashlights: Flashlights, k: int) -> Float[np.ndarray, "trials 3"]:
    """Return targets around where all aim on average, at rings of angles about the way there."""
    arm = flashlights.aim - flashlights.positions[k]
    reach = float(np.linalg.norm(arm))
    axis = arm / reach
    first, second = (one[0] for one in across(axis[None]))
    found = [axis]
    for ring, angle in enumerate(OFF_AXIS[1:], 1):
        turn = np.linspace(0, 2 * np.pi, PER_RING * ring, endpoint=False)[:, None]
        found += list(np.cos(angle) * axis + np.sin(angle) * (np.cos(turn) * first + np.sin(turn) * second))
    return flashlights.positions[k] + reach * np.array(found)
