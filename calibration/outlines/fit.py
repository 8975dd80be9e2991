"""Fit light positions to outlines and highlights alone, by robust least squares from a start of shadows."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from calibration.outlines.terms import OutlineTerms

BLURS, STEPS = (5.0, 20.0), 40  # factors of an outline's sigma at the beginning of a try: later 1
DIRECTION, LOG_HEIGHT = 0.2, 0.8  # prior sigmas of the start: radians, log z
LONGEST_STEP = 0.25  # of x / z, y / z and log z
TRIALS = 6  # of one step, each damped four times as much


@dataclass
class _Search:
    """The state of the fit in the coordinates (x / z, y / z, log z) about the foot; see fit_outlines."""

    terms: OutlineTerms
    foot: Float[np.ndarray, "3"]
    prior: Float[np.ndarray, "photos 3"]
    sigma: Float[np.ndarray, "photos 3"]  # of the prior
    state: Float[np.ndarray, "photos 3"]
    damping: float = 1e-2

    def positions(self, state: Float[np.ndarray, "photos 3"]) -> Float[np.ndarray, "photos 3"]:
        height = np.exp(state[:, 2:])
        return np.concatenate([state[:, :2] * height, height], 1) + self.foot

    def cost(self, state: Float[np.ndarray, "photos 3"], blur: float) -> float:
        """Return the negative log posterior: the terms', and Gaussian for the start."""
        return self.terms.cost(self.positions(state), blur) + 0.5 * (((state - self.prior) / self.sigma) ** 2).sum()

    def descend(self, blurs: Float[np.ndarray, " steps"]) -> None:
        """Take one Levenberg-Marquardt step for each blur."""
        for blur in blurs:
            matrix, slope = self._normal_equations(blur)
            before = self.cost(self.state, blur)
            for _ in range(TRIALS):
                step = -np.linalg.solve(matrix + self.damping * np.diag(np.diag(matrix)), slope).reshape(-1, 3)
                step *= np.minimum(1, LONGEST_STEP / np.maximum(np.abs(step).max(1, keepdims=True), 1e-12))
                if self.cost(self.state + step, blur) < before:
                    self.state, self.damping = self.state + step, max(self.damping / 3, 1e-4)
                    break
                self.damping *= 4

    def _normal_equations(self, blur: float):
        value, slopes = self.terms.rows(self.positions(self.state), blur)
        height = np.exp(self.state[:, 2])
        by_state = np.zeros((len(height), 3, 3))
        by_state[:, 0, 0] = by_state[:, 1, 1] = by_state[:, 2, 2] = height
        by_state[:, :2, 2] = self.state[:, :2] * height[:, None]
        rows = np.einsum("rka,kab->rkb", slopes, by_state).reshape(len(value), -1)
        matrix = rows.T @ rows + np.diag((self.sigma**-2).ravel())
        return matrix, rows.T @ value + ((self.state - self.prior) / self.sigma**2).ravel()


def fit_outlines(terms: OutlineTerms, start: Float[np.ndarray, "photos 3"]) -> Float[np.ndarray, "photos 3"]:
    """Fit the lights in the coordinates (x / z, y / z, log z) about the foot, in which the free homology is smooth.

    Levenberg-Marquardt with Cauchy weights; an outline's sigma falls to its own during the search. The start is a weak
    prior. The cost has many local minima: of several tries with different first sigmas the best is taken.

    Args:
        start: positions, world, of the photos of the terms.
    """
    foot = np.array([*terms.maps.foot[:2], terms.ground])
    arm = start - foot
    prior = np.concatenate([arm[:, :2] / arm[:, 2:], np.log(arm[:, 2:])], 1)
    slant = DIRECTION * (1 + (prior[:, :2] ** 2).sum(1, keepdims=True))
    sigma = np.concatenate([slant, slant, np.full_like(slant, LOG_HEIGHT)], 1)
    tries = []
    for blur in BLURS:
        search = _Search(terms, foot, prior, sigma, prior.copy())
        search.descend(np.geomspace(blur, 1.0, STEPS))
        tries.append((search.cost(search.state, 1.0), search.positions(search.state)))
    return min(tries, key=lambda one: one[0])[1]
