"""The motion of all lights together that outlines leave free, decided by the shading of all photos."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from calibration.flashlight.fit import FAR, NEAR, START_BEAM
from calibration.flashlight.model import (
    EXTRA_TERMS,
    Evidence,
    Flashlights,
    Priors,
    cell_residuals,
    free_tangent,
    refine,
)
from calibration.outlines.terms import OutlineTerms
from capture.checks.robust import spread

SPAN, TRIALS = np.full(4, 0.15), 60  # the search's first steps, shares of q; its trials
ALIKE = 40.0  # ground cells that are wrong together: a misfit is smooth over some 60 mm
LOOSE = Priors(log_power=0.1, beam=50.0, power_outlier=0.5)  # a hot centre, rings; a phone's tone differs by photo


def best_common_motion(
    lights: Float[np.ndarray, "photos 3"], evidence: Evidence, terms: OutlineTerms
) -> tuple[Flashlights, float]:
    """Return the flashlights where outlines and shading agree best among all that leave the shadows coherent.

    These are, in q = (x, y, 1) / z, a common scale and shift of q [Kriegman and Belhumeur 2001]: four numbers, of which
    the silhouette fixes three only loosely. Searched by Nelder and Mead's simplex; shading is refitted at every trial.
    Also returns the misfit of the shading, one sigma in log units.

    Args:
        lights: positions, world.
    """
    foot = np.array([*terms.maps.foot[:2], terms.ground])
    arm = lights - foot
    plane = np.concatenate([arm[:, :2], np.ones((len(arm), 1))], 1) / arm[:, 2:]
    unit = np.array([1.0, 1.0, float(np.median(plane[:, 2]))])
    evidence = replace(evidence, weight=evidence.weight * terms.trusted[:, None])
    cells = (evidence.weight > 0).sum() / ALIKE

    def moved(numbers: Float[np.ndarray, "4"]) -> Float[np.ndarray, "photos 3"]:
        found = np.exp(numbers[3]) * (plane + numbers[:3] * unit)
        height = 1 / np.maximum(found[:, 2], 0.2 * unit[2])
        return foot + np.stack([found[:, 0] * height, found[:, 1] * height, height], -1)

    def cost(numbers: Float[np.ndarray, "4"]) -> float:
        places = moved(numbers)
        return terms.cost(places) + cells * np.log(held_places(places, evidence)[1])

    simplex = np.concatenate([np.zeros((1, 4)), np.diag(SPAN)])
    best = minimize(cost, np.zeros(4), method="Nelder-Mead", options={"initial_simplex": simplex, "maxfev": TRIALS}).x
    return held_places(moved(best), evidence)


def held_places(places: Float[np.ndarray, "photos 3"], evidence: Evidence) -> tuple[Flashlights, float]:
    """Fit beam, aims and powers with the places held; return also the shading's misfit, log units."""
    n, centre = len(places), evidence.cells.centre
    beam = np.r_[START_BEAM, np.zeros(EXTRA_TERMS)]
    start = Flashlights(places, np.repeat(centre[None], n, 0), np.zeros(n), beam, 0.02, centre)
    flashlights, weight = refine(start, evidence, LOOSE, held_tangent, FAR[:8] + NEAR)
    return flashlights, spread(cell_residuals(flashlights, evidence, weight)[evidence.weight > 0])


def held_tangent(flashlights: Flashlights) -> Float[np.ndarray, "full reduced"]:
    """Return free_tangent without the places."""
    basis = free_tangent(flashlights)
    n, free = len(flashlights.positions), flashlights.per_flashlight() - 1
    columns = np.arange(basis.shape[1])
    return basis[:, (columns >= free * n) | (columns % free >= 3)]
