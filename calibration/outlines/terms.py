"""Outlines as residuals in another least-squares fit of the same lights."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from calibration.outlines.coherence import Residuals, residuals
from calibration.outlines.outline_maps import PIXEL_ERROR, OutlineMaps

DROP_OUTLINE = 1.5  # px: right lights stay below 0.6, but where the picture cuts a shadow
SERIES = 0.3  # spread of log distances of a handheld light from the object, as an arm moves
SAME = 3.0  # neighbouring rays that are wrong together


@dataclass(frozen=True)
class OutlineTerms:
    """The outlines of the photos of a fit, in its order; positions in the world frame."""

    maps: OutlineMaps
    eye: Float[np.ndarray, "3"]
    ground: float
    used: Bool[np.ndarray, " photos"]  # of all photos of the maps: those of the fit
    trusted: Bool[np.ndarray, " used"]  # of the fit's photos: the others neither prove space empty nor count

    def rows(self, positions: Float[np.ndarray, "used 3"]):
        """Return residuals in sigmas, Cauchy's weight applied, and derivatives (rows, used, 3) by the positions."""
        order = np.full(len(self.used) + 1, len(positions))
        order[np.flatnonzero(self.used)] = np.arange(len(positions))
        found = self._look(positions, self.trusted)
        sigma = PIXEL_ERROR * self.maps.pixel
        active = found.emptiness > 0
        size = found.emptiness[active] / sigma
        root = 1 / np.sqrt((1 + size**2) * SAME)
        slopes = np.zeros((len(size), len(positions) + 1, 3))
        place = np.arange(len(size))
        slopes[place, order[found.owner[active]]] += found.d_owner[active] * (root / sigma)[:, None]
        slopes[place, order[np.maximum(found.by[active], 0)]] += found.d_by[active] * (root / sigma)[:, None]
        arm, far = self._arms(positions)
        toward = np.zeros((len(positions), len(positions), 3))
        toward[np.arange(len(positions)), np.arange(len(positions))] = arm / (arm**2).sum(1, keepdims=True) / SERIES
        return np.concatenate([root * size, far]), np.concatenate([slopes[:, :-1], toward])

    def misfit(self, positions: Float[np.ndarray, "used 3"]) -> Float[np.ndarray, " used"]:
        """Return the 90th percentile of the emptiness of each photo's rays, px; 0 for a photo without rays.

        A photo that is not trusted is compared with the trusted ones.
        """
        misfit = np.zeros(len(positions))
        own = np.flatnonzero(self.used)
        together = self._look(positions, self.trusted)
        for number, photo in enumerate(own):
            found = together
            if not self.trusted[number]:
                found = self._look(positions, self.trusted | (np.arange(len(own)) == number))
            misfit[number] = found.misfit(int(photo)) / self.maps.pixel
        return np.nan_to_num(misfit, nan=0.0)

    def unusual(self, positions: Float[np.ndarray, "used 3"]) -> Float[np.ndarray, " used"]:
        """Return how much nearer or farther than usual in this series each light is, in sigmas."""
        return self._arms(positions)[1]

    def cost(self, positions: Float[np.ndarray, "used 3"]) -> float:
        """Return half the sum of squares whose weighted rows `rows` gives: Cauchy's function."""
        found = self._look(positions, self.trusted)
        size = np.maximum(found.emptiness, 0) / (PIXEL_ERROR * self.maps.pixel)
        return float(np.log1p(size**2).sum() / (2 * SAME) + 0.5 * (self._arms(positions)[1] ** 2).sum())

    def _arms(self, positions: Float[np.ndarray, "used 3"]):
        """Return vectors from the foot to the lights, and how unusual their lengths are in this series, in sigmas."""
        arm = positions - self.maps.foot
        log_distance = np.log(np.linalg.norm(arm, axis=1))
        return arm, (log_distance - np.median(log_distance)) / SERIES

    def _look(self, positions: Float[np.ndarray, "used 3"], takes_part: Bool[np.ndarray, " used"]) -> Residuals:
        lift = np.array([0.0, 0.0, self.ground])
        lights, used = np.ones((len(self.used), 3)), self.used.copy()
        lights[self.used] = positions - lift
        used[self.used] = takes_part
        return residuals(self.maps, lights, self.eye - lift, used)
