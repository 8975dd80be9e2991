"""Look for one light's place anew while the others are held: many places from coarse to fine, the best few kept."""

import numpy as np
from jaxtyping import Float
from scipy.ndimage import minimum_filter

from calibration.outlines.terms import OutlineTerms

SLANT, FARTHER = 0.25, 0.25  # one step of a grid: log of x / z; log of the distance
NEAR_BY = (0.125, (4, 3, 2))  # radians of one step of turning; steps to each side: turned, slanted, farther, ...
ALL_AROUND = (np.pi / 12, (12, 5, 3))  # ... and of a coarse grid, for starts that are wrong
MINIMA = 6  # of each grid, that are followed, ...
LOWEST = 60  # ... of its lowest places
APART = 0.03  # of the distance from the foot: nearer places are one
BLURS = (6.0, 2.0, 1.0)  # of an outline's sigma, for steps that are 1, 1/3, 1/9 as wide


def likely_places(
    terms: OutlineTerms, lights: Float[np.ndarray, "photos 3"], k: int, starts: Float[np.ndarray, "starts 3"]
) -> Float[np.ndarray, "places 3"]:
    """Return places (world) where the outlines of the trusted photos agree best with light k, the best one first.

    These are refined local minima of two grids, a fine one about the first start and a coarse one all around the foot,
    and the further starts; each place once.

    Args:
        starts: the first is the middle of the grids; the others are tried as they are.
    """
    foot = terms.maps.foot
    cost_at = terms.costs(lights, k)
    found = []
    for turning, steps in (NEAR_BY, ALL_AROUND):
        grid = _around(starts[0] - foot, 1.0, steps, turning) + foot
        cost = cost_at.lowest(grid.reshape(-1, 3), BLURS[0], LOWEST).reshape(grid.shape[:3])
        lowest = np.argwhere(cost == minimum_filter(cost, 3))
        lowest = lowest[np.argsort(cost[tuple(lowest.T)])][:MINIMA]
        found.extend(grid[tuple(lowest.T)])
    found.extend(starts[1:])
    costs = np.zeros(len(found))
    for level, blur in enumerate(BLURS[1:], 1):
        for number, place in enumerate(found):
            near = _around(place - foot, 3.0**-level, (1, 1, 1)).reshape(-1, 3) + foot
            cost = cost_at.lowest(near, blur, 1)
            found[number], costs[number] = near[int(np.argmin(cost))], cost.min()
    apart: list[np.ndarray] = []
    for number in np.argsort(costs):
        one = found[number]
        if all(np.linalg.norm(one - other) > APART * np.linalg.norm(one - foot) for other in apart):
            apart.append(one)
    return np.array(apart)


def _around(
    arm: Float[np.ndarray, "3"], width: float, steps: tuple[int, int, int], turning: float = NEAR_BY[0]
) -> Float[np.ndarray, "turns slants distances 3"]:
    """Places turned about the foot, steeper and flatter, nearer and farther."""
    turn, slant, far = np.meshgrid(*(width * np.arange(-n, n + 1) for n in steps), indexing="ij")
    distance, azimuth = np.linalg.norm(arm), np.arctan2(arm[1], arm[0]) + turning * turn
    flat = np.hypot(arm[0], arm[1]) / max(arm[2], 1e-9) * np.exp(SLANT * slant)
    height = distance * np.exp(FARTHER * far) / np.sqrt(1 + flat**2)
    return np.stack([height * flat * np.cos(azimuth), height * flat * np.sin(azimuth), height], -1)
