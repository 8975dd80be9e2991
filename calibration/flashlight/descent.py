"""Robust least squares over flashlights: Levenberg and Marquardt's steps, bent along curved valleys, and weights."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_array

from calibration.flashlight.model import (
    Evidence,
    Flashlights,
    Priors,
    Samples,
    Tangent,
    cell_residuals,
    cost,
    jacobian,
    normal_equations,
    pulled,
)
from capture.checks.robust import cauchy, spread

TRIES = 6  # dampings, each four times the last, until a step lowers the cost
SETTLED = 1e-6  # of the cost: a step that promises less is not taken
PART = 0.1  # of a step, for the differences that tell how residuals bend along it
MOST_BENT = 0.375  # of a step's size, by which it bends at most: beyond, the series that it is taken from says nothing


@dataclass(frozen=True)
class RobustWeights:
    """Robust weights of the samples by residual: Cauchy far from the solution, Tukey (which drops outliers) near it."""

    cut: float  # in robust standard deviations of all residuals
    forgets: bool
    narrowest: float = 0.003  # log units; residuals of a perfect capture must not shrink the scale to nothing

    def __call__(self, residual: Samples, evidence: Evidence) -> Samples:
        known = evidence.weight > 0
        sigma = max(spread(residual[known]), self.narrowest)
        x = residual / (self.cut * sigma)
        vote = np.where(np.abs(x) < 1, (1 - x**2) ** 2, 0.0) if self.forgets else cauchy(x**2)
        return evidence.weight * vote


def descend(
    flashlights: Flashlights, evidence: Evidence, weight: Samples, priors: Priors, tangent: Tangent, damping: float
):
    """Take one Levenberg-Marquardt step with fixed weights; return state (unchanged if no step is better) and damping.

    Marquardt, SIAM J. Appl. Math. 11 (1963): the damping scales the diagonal. Distance, aim, beam and power stand in
    for one another along curved valleys, which straight steps leave: each step bends with the residuals' second
    derivative along it (geodesic acceleration) [Transtrum and Sethna, Improvements to the Levenberg-Marquardt algorithm
    for nonlinear least-squares minimization, arXiv:1201.5885 (2012)].
    """
    slopes = jacobian(flashlights, evidence)
    matrix, downhill = normal_equations(flashlights, evidence, weight, priors, slopes)
    basis = csr_array(tangent(flashlights))  # a few entries per row: dense products would cost as much as all the rest
    matrix, downhill = basis.T @ matrix @ basis, basis.T @ downhill
    before = cost(flashlights, evidence, weight, priors)
    for _ in range(TRIES):
        damped = cho_factor(matrix + damping * np.diag(np.diag(matrix)) + 1e-12 * np.eye(len(matrix)))
        step = cho_solve(damped, downhill)
        if step @ downhill < SETTLED * before:
            break
        curved = _curvature(flashlights, evidence, weight, basis @ step)
        bend = cho_solve(damped, basis.T @ pulled(slopes, weight * curved / 2))
        size, bent = (float(np.linalg.norm(np.sqrt(np.diag(matrix)) * one)) for one in (step, bend))
        step += min(1.0, MOST_BENT * size / max(bent, 1e-30)) * bend
        trial = flashlights.moved(basis @ step, evidence.height)
        if cost(trial, evidence, weight, priors) <= before:
            return trial, max(damping / 16, 1e-10)
        damping *= 4
    return flashlights, damping


def _curvature(
    flashlights: Flashlights, evidence: Evidence, weight: Samples, step: Float[np.ndarray, " full"]
) -> Samples:
    """Return the second derivative of the cells' residuals along a step, by central differences."""
    ends = (flashlights.moved(share * step, evidence.height) for share in (PART, -PART))
    ahead, back = (cell_residuals(one, evidence, weight) for one in ends)
    return (ahead - 2 * cell_residuals(flashlights, evidence, weight) + back) / PART**2


def ground_cells_of(weight: Samples, evidence: Evidence) -> Bool[np.ndarray, " cells"]:
    """Return which cells behave like ground: at least 3 of their photos, and a quarter, keep 0.3 of their weight."""
    least = 0.25  # an object's cell agrees with the ground's shading by chance in fewer photos
    valid = (weight > 0.3 * evidence.weight) & (evidence.weight > 0)
    return valid.sum(0) >= np.maximum(least * (evidence.weight > 0).sum(0), 3)


def refine(
    flashlights: Flashlights, evidence: Evidence, priors: Priors, tangent: Tangent, schedule: tuple[RobustWeights, ...]
):
    """Take one Levenberg-Marquardt step per entry of the schedule; return the state and the samples' final weights."""
    damping, weight = 1e-2, evidence.weight
    residual = cell_residuals(flashlights, evidence, np.zeros_like(weight))
    for votes in schedule:
        weight = votes(residual, evidence)
        weight = weight * ground_cells_of(weight, evidence)
        flashlights, damping = descend(flashlights, evidence, weight, priors, tangent, damping)
        residual = cell_residuals(flashlights, evidence, weight)
    return flashlights, weight
