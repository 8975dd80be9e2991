"""Outlines as residuals in another least-squares fit of the same lights."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from calibration.outlines.coherence import Residuals, residuals
from calibration.outlines.outline_maps import OutlineMaps

PIXEL_ERROR = 1.0  # one sigma of an outline, px of the ground field
SAME = 3.0  # neighbouring rays that are wrong together


@dataclass(frozen=True)
class OutlineTerms:
    """The outlines of the photos of a fit, in its order; positions in the world frame."""

    maps: OutlineMaps
    eye: Float[np.ndarray, "3"]
    ground: float
    used: Bool[np.ndarray, " photos"]  # of all photos of the maps: those of the fit

    def rows(self, positions: Float[np.ndarray, "used 3"]):
        """Return residuals in sigmas, Cauchy's weight applied, and their derivatives (rows, used, 3) by the positions."""
        order = np.full(len(self.used) + 1, len(positions))
        order[np.flatnonzero(self.used)] = np.arange(len(positions))
        found = self._look(positions)
        sigma = PIXEL_ERROR * self.maps.pixel
        active = found.emptiness > 0
        size = found.emptiness[active] / sigma
        root = 1 / np.sqrt((1 + size**2) * SAME)
        slopes = np.zeros((len(size), len(positions) + 1, 3))
        place = np.arange(len(size))
        slopes[place, order[found.owner[active]]] += found.d_owner[active] * (root / sigma)[:, None]
        slopes[place, order[np.maximum(found.by[active], 0)]] += found.d_by[active] * (root / sigma)[:, None]
        return root * size, slopes[:, :-1]

    def misfit(self, positions: Float[np.ndarray, "used 3"]) -> Float[np.ndarray, " used"]:
        """Return the 90th percentile of the emptiness of each photo's rays, px; 0 for a photo without rays."""
        found = self._look(positions)
        owner = np.flatnonzero(self.used)
        rays = [found.emptiness[found.owner == k] for k in owner]
        return np.array([np.percentile(one, 90) / self.maps.pixel if len(one) else 0.0 for one in rays])

    def cost(self, positions: Float[np.ndarray, "used 3"]) -> float:
        """Return half the sum of squares whose weighted rows `rows` gives: Cauchy's function."""
        found = self._look(positions)
        size = np.maximum(found.emptiness, 0) / (PIXEL_ERROR * self.maps.pixel)
        return float(np.log1p(size**2).sum() / (2 * SAME))

    def _look(self, positions: Float[np.ndarray, "used 3"]) -> Residuals:
        lift = np.array([0.0, 0.0, self.ground])
        lights = np.ones((len(self.used), 3))
        lights[self.used] = positions - lift
        return residuals(self.maps, lights, self.eye - lift, self.used)
