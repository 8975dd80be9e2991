"""Look for one light's place anew while the others are held: many places from coarse to fine, the best few kept."""

import numpy as np
from jaxtyping import Float
from scipy.ndimage import minimum_filter

from calibration.outlines.terms import OutlineTerms

TURNS, SLANTS, DISTANCES = 4, 3, 2  # steps of the first grid to each side
TURN, SLANT, FARTHER = 0.125, 0.25, 0.25  # one step: radians; log of x / z; log of the distance
MINIMA = 6  # of the grid, that are followed
BLURS = (6.0, 2.0, 1.0)  # of an outline's sigma, for steps that are 1, 1/3, 1/9 as wide


def likely_places(
    terms: OutlineTerms, lights: Float[np.ndarray, "photos 3"], k: int, starts: Float[np.ndarray, "starts 3"]
) -> Float[np.ndarray, "places 3"]:
    """Return places (world) where the outlines of the trusted photos agree best with light k, the best one first.

    These are refined local minima of a grid, and the further starts.

    Args:
        starts: the first is the middle of the grid; the others are tried as they are.
    """
    foot = terms.maps.foot
    grid = _around(starts[0] - foot, 1.0, (TURNS, SLANTS, DISTANCES)) + foot
    cost_at = terms.costs(lights, k)
    cost = cost_at(grid.reshape(-1, 3), BLURS[0]).reshape(grid.shape[:3])
    lowest = np.argwhere(cost == minimum_filter(cost, 3))
    lowest = lowest[np.argsort(cost[tuple(lowest.T)])][:MINIMA]
    found = [*grid[tuple(lowest.T)], *starts[1:]]
    costs = np.zeros(len(found))
    for level, blur in enumerate(BLURS[1:], 1):
        for number, place in enumerate(found):
            near = _around(place - foot, 3.0**-level, (1, 1, 1)).reshape(-1, 3) + foot
            cost = cost_at(near, blur)
            found[number], costs[number] = near[int(np.argmin(cost))], cost.min()
    return np.array(found)[np.argsort(costs)]


def _around(
    arm: Float[np.ndarray, "3"], width: float, steps: tuple[int, int, int]
) -> Float[np.ndarray, "turns slants distances 3"]:
    """Places turned about the foot, steeper and flatter, nearer and farther."""
    turn, slant, far = np.meshgrid(*(width * np.arange(-n, n + 1) for n in steps), indexing="ij")
    distance, azimuth = np.linalg.norm(arm), np.arctan2(arm[1], arm[0]) + TURN * turn
    flat = np.hypot(arm[0], arm[1]) / max(arm[2], 1e-9) * np.exp(SLANT * slant)
    height = distance * np.exp(FARTHER * far) / np.sqrt(1 + flat**2)
    return np.stack([height * flat * np.cos(azimuth), height * flat * np.sin(azimuth), height], -1)
