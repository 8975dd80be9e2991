"""Standard deviations that a few wrong values do not change."""

import numpy as np
from jaxtyping import Float

MAD_TO_SIGMA = 1.4826  # median absolute deviation to standard deviation, of a normal distribution: 1 / 0.6745


def spread(values: Float[np.ndarray, "*batch"]) -> float:
    """Standard deviation about zero of all values, from the median of their sizes; NaN is left out, 0 without values.

    sigma = 1.4826 median |x|, Huber, Robust Statistics (1981), section 5.1. The unit is that of the values.
    """
    return float(MAD_TO_SIGMA * np.nanmedian(np.abs(values))) if np.size(values) else 0.0


def column_spread(values: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, " columns"]:
    """The spread of each column."""
    return MAD_TO_SIGMA * np.nanmedian(np.abs(values), axis=0) if len(values) else np.zeros(values.shape[1])
