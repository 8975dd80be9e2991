"""How the brightness of pictures follows the light that falls on the ground: one curve for a whole series.

A phone bends contrast and lifts what is dark. With x the log of light times exposure, of its median over the series,
the log brightness of a patch of ground is, up to its albedo,

    f(x) = x + sum of s_i H_i(x), f'(x) = 1 + sum of s_i h_i(x)

with h_0 = 1, a contrast of all, the others hat functions one stop apart, and H_i their integrals [after Grossberg and
Nayar, Modeling the Space of Camera Response Functions, PAMI 26 (2004)]. The light counts and not the brightness,
because phones bend the mean of whole regions, in which the ground's texture vanishes.
"""

from functools import cache

import numpy as np
from jaxtyping import Float

STOP = np.log(2.0)
KNOTS = np.arange(-3, 4) * STOP  # eight bits and a table's light span six stops
TERMS = 1 + len(KNOTS)
WIDTHS = np.r_[0.1, np.full(len(KNOTS), 0.2)]  # prior sigmas: a phone's contrast settings; its tone mapping
STEEPEST = 0.6  # of each term: the curve keeps rising
ENDS, PLACES = 8 * STOP, 513  # of the table of H; beyond the ends, where nothing is measured, H stays

Samples = Float[np.ndarray, "*batch"]


def slopes(light: Samples) -> Float[np.ndarray, "*batch terms"]:
    """Return h_i at log light about its median; beyond the last knots the slope stays."""
    inside = np.clip(light, KNOTS[0], KNOTS[-1])
    hats = np.maximum(1 - np.abs(inside[..., None] - KNOTS) / STOP, 0.0)
    return np.concatenate([np.ones_like(hats[..., :1]), hats], -1)


def integrals(light: Samples) -> Float[np.ndarray, "*batch terms"]:
    """Return H_i at log light about its median, where it is 0."""
    return _between(light, _table())


def bend(light: Samples, response: Float[np.ndarray, " terms"]) -> Samples:
    """Return f(x) - x at log light about its median."""
    return _between(light, _table() @ response)


def _between(light: Samples, table: np.ndarray) -> np.ndarray:
    """Return the table's entries at the places of log light: equally spaced, which numpy.interp does not use."""
    place = (np.clip(light, -ENDS, ENDS) / ENDS + 1) / 2 * (PLACES - 1)
    first = np.minimum(place.astype(np.intp), PLACES - 2)
    part = (place - first).reshape(place.shape + (1,) * (table.ndim - 1))
    return table[first] + part * np.diff(table, axis=0)[first]


@cache
def _table() -> Float[np.ndarray, "places terms"]:
    at = np.linspace(-ENDS, ENDS, PLACES)
    height = slopes(at)
    total = np.concatenate([0 * height[:1], np.cumsum((height[1:] + height[:-1]) / 2 * (at[1] - at[0]), axis=0)])
    return total - total[PLACES // 2]
