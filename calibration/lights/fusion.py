"""Combine several estimates of one light, each weighted by its covariance."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

DISAGREE = 16.3  # chi squared of three numbers: one pair in a thousand that agrees lies farther apart
LEAST_SIGMA = 1e-6  # of the opinion's size: a covariance with a known axis stays invertible


def fuse(
    places: Sequence[Float[np.ndarray, "3"]], covariances: Sequence[Float[np.ndarray, "3 3"]]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"], bool]:
    """Return the weighted mean of a place, its covariance, and whether the estimates contradict each other.

    With C = (sum C_i^-1)^-1 the mean is C sum C_i^-1 x_i. Estimates that lie farther apart than their covariances allow
    widen the result by the square root of chi squared per degree of freedom (Birge, Phys. Rev. 40, 1932).

    Args:
        places, covariances: two or more, in one frame and unit (world length).
    """
    size = max(float(np.linalg.norm(place)) for place in places)
    least = (LEAST_SIGMA * size) ** 2 * np.eye(3)
    inverses = [np.linalg.inv(covariance + least) for covariance in covariances]
    covariance = np.linalg.inv(np.sum(inverses, axis=0))
    mean = covariance @ np.sum([inverse @ place for inverse, place in zip(inverses, places, strict=True)], axis=0)
    chi2 = sum(float((p - mean) @ i @ (p - mean)) for p, i in zip(places, inverses, strict=True))
    ratio = chi2 / (3 * (len(places) - 1))
    return mean, covariance * max(ratio, 1.0), ratio > DISAGREE / 3
