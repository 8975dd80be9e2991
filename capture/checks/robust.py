"""Spread that a few wrong values do not change."""

MAD_TO_SIGMA = 1.4826  # median absolute deviation to standard deviation, of a normal distribution: 1 / 0.6745
