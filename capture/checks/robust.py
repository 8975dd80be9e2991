"""Standard deviations, quantiles and weights that a few wrong values do not change."""

from collections.abc import Callable

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


def lower_median(values: Float[np.ndarray, "..."], axis: int) -> Float[np.ndarray, "..."]:
    """Return the lower median along an axis; NaN is left out, NaN where there is nothing else.

    Ten times as fast as numpy.nanmedian.
    """
    ordered = np.sort(values, axis=axis)
    count = np.isfinite(values).sum(axis, keepdims=True)
    return np.take_along_axis(ordered, np.maximum(count - 1, 0) // 2, axis).squeeze(axis)


def column_quantile(values: Float[np.ndarray, "rows ..."], share: float) -> Float[np.ndarray, "..."]:
    """Return the quantile of each column, linear between values; NaN is left out, NaN where a column has no value.

    The same as `np.nanquantile(values, share, axis=0)`, by one sort instead of one call per column.
    """
    ordered = np.sort(values, axis=0)  # NaN comes last
    rank = share * (np.maximum((~np.isnan(values)).sum(0), 1) - 1)
    below = np.floor(rank).astype(int)
    low, high = (np.take_along_axis(ordered, at[None], 0)[0] for at in (below, np.ceil(rank).astype(int)))
    return (low + (rank - below) * (high - low)).astype(values.dtype)


def reweighted_fit(
    basis: Float[np.ndarray, "n k"],
    values: Float[np.ndarray, "fits n"],
    weigh: Callable[[Float[np.ndarray, "fits n"]], Float[np.ndarray, "..."]],
    rounds: int,
    start: Float[np.ndarray, "fits n"],
    stiffness: float = 0.0,
) -> Float[np.ndarray, "fits k"]:
    """Return the factors of `basis` that fit rows of values, by iteratively reweighted least squares.

    Args:
        weigh: weights of what is left of the values, for all rows alike if it returns one.
        start: what the values are first compared with.
        stiffness: added to the normal equations: how strongly factors are held at 0.
    """
    factors = np.zeros((len(values), basis.shape[1]))
    for _ in range(rounds):
        weight = np.broadcast_to(weigh(values - start), values.shape)
        normal = np.einsum("fn,na,nb->fab", weight, basis, basis) + stiffness * np.eye(basis.shape[1])
        factors = np.linalg.solve(normal, ((weight * values) @ basis)[..., None])[..., 0]
        start = factors @ basis.T
    return factors


def cauchy(squares: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
    """Weights of Cauchy's loss in reweighted least squares; squares: of errors over their width."""
    return 1 / (1 + squares)


def geman_mcclure(squares: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
    """Weights of Geman and McClure's loss, as in `cauchy`: what is far off has no vote."""
    return 1 / (1 + squares) ** 2
