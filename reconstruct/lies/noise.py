"""Which of two motions is better: a difference of errors, and how well it is known."""

import numpy as np
from jaxtyping import Float, Int


def mean_difference(
    a: Float[np.ndarray, " n"], b: Float[np.ndarray, " n"], group: Int[np.ndarray, " n"]
) -> tuple[float, float]:
    """Return the mean of a - b where both are known, and one sigma of it, from how it varies between groups.

    The ratio estimator of cluster sampling [Cochran 1977, 6.4]: errors inside a group may be correlated. 0 and 0 with
    fewer than two groups.

    Args:
        a, b: errors under two motions; nan where unknown.
        group: of each error, counted from 0.
    """
    known = np.isfinite(a) & np.isfinite(b)
    change, own = (a - b)[known], group[known]
    total, count = np.bincount(own, change), np.bincount(own)
    used = int((count > 0).sum())
    if used < 2:
        return 0.0, 0.0
    mean = float(change.mean())
    return mean, float(np.sqrt(used / (used - 1) * ((total - mean * count) ** 2).sum()) / known.sum())
