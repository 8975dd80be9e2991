"""The profile of a flashlight's beam: a smooth one in few terms, and splines for hot centres and rings.

log g(c) = m log c + r2 u^2 + r3 u^3 + r4 u^4 + sum of b_i B_i(u), c the cosine off the axis, u = 1 - c, B_i cubic
B-splines. An LED behind a lens has a hot centre and rings, which no low polynomial follows. Taken for a smooth beam,
these misplace lights by some 7 % and look like a phone that evens out brightness from photo to photo.
"""

from functools import cache

import numpy as np
from jaxtyping import Float

from calibration.light import log_beam_gain

EXTRA_TERMS = 3  # r2, r3, r4: fewer cannot follow a real beam (position errors of 2-6 % with none)
SMOOTH_TERMS = 1 + EXTRA_TERMS  # what comes after these are splines
RING_SPAN = 0.56  # of u that splines cover: up to 64 degrees off the axis
RING_TERMS = 32  # 2 degrees apart at 30 degrees, where LEDs have rings
PROFILE = 2000  # places at which the splines' sum is tabulated

Samples = Float[np.ndarray, "*batch"]


def log_gain(cosine: Samples, beam: Float[np.ndarray, " terms"]) -> Samples:
    """Return log g(c), with splines where the beam has them; cosines above 0."""
    smooth = log_beam_gain(cosine, beam[:SMOOTH_TERMS])
    if len(beam) <= SMOOTH_TERMS:
        return smooth
    profile = _tabulated(len(beam) - SMOOTH_TERMS) @ beam[SMOOTH_TERMS:]
    place = (1 - cosine) * (PROFILE - 1)  # equally spaced: numpy.interp, which searches, takes five times as long
    first = np.minimum(place.astype(np.intp), PROFILE - 2)
    return smooth + profile[first] + (place - first) * np.diff(profile)[first]


@cache
def _tabulated(count: int) -> Float[np.ndarray, "places terms"]:
    """Return the splines at PROFILE places from u = 0 to 1."""
    return _splines(np.linspace(0, 1, PROFILE), count)[0]


def derivatives(
    cosine: Samples, beam: Float[np.ndarray, " terms"]
) -> tuple[Samples, Float[np.ndarray, "*batch terms"]]:
    """Return the derivatives of log g by the cosine, and by each term."""
    u = 1 - cosine
    by_cosine = beam[0] / cosine
    for power, r in enumerate(beam[1:SMOOTH_TERMS], start=2):
        by_cosine = by_cosine - power * r * u ** (power - 1)
    by_term = _smooth_terms(cosine, min(len(beam), SMOOTH_TERMS))
    if len(beam) <= SMOOTH_TERMS:
        return by_cosine, by_term
    value, slope = _splines(u, len(beam) - SMOOTH_TERMS)
    return by_cosine - slope @ beam[SMOOTH_TERMS:], np.concatenate([by_term, value], -1)


def without_splines(
    beam: Float[np.ndarray, " terms"], cosine: Samples, weight: Samples, width: float
) -> tuple[tuple[float, ...], float]:
    """Return m, r2, r3, r4 of the beam without splines that is nearest at the samples, and what its logarithm lacks.

    It is what other parts know of the beam; all powers rise by the exponential of what it lacks.

    Args:
        width: prior sigma of each term, in log units of one sample's error.
    """
    if len(beam) <= SMOOTH_TERMS:
        return tuple(map(float, beam)), 0.0
    used = weight > 0
    root = np.sqrt(weight[used])
    columns = np.c_[_smooth_terms(cosine[used], SMOOTH_TERMS), np.ones_like(root)]
    held = float(np.sqrt(weight[used].mean())) / width * np.eye(SMOOTH_TERMS, SMOOTH_TERMS + 1)
    matrix = np.concatenate([root[:, None] * columns, held])
    found = np.linalg.lstsq(matrix, np.r_[root * log_gain(cosine[used], beam), np.zeros(SMOOTH_TERMS)], rcond=None)[0]
    return tuple(map(float, found[:-1])), float(found[-1])


def _smooth_terms(cosine: Samples, count: int) -> Float[np.ndarray, "*batch terms"]:
    """Return what m, r2, r3, ... are multiplied by: log c, u^2, u^3, ..."""
    u = 1 - cosine
    return np.stack([np.log(cosine), *(u**power for power in range(2, count + 1))], -1)


def _splines(u: Samples, count: int) -> tuple[Float[np.ndarray, "*batch n"], Float[np.ndarray, "*batch n"]]:
    """Return cubic B-splines of u, their middles equally far apart from u = 0 on, and their derivatives by u.

    See de Boor, A Practical Guide to Splines (1978).
    """
    step = RING_SPAN / count
    x = u / step
    first = x.astype(np.int64)
    t = x - first
    value = np.stack([(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, 3 * (t + t**2 - t**3) + 1, t**3], -1) / 6
    slope = np.stack([-((1 - t) ** 2), 3 * t**2 - 4 * t, 1 + 2 * t - 3 * t**2, t**2], -1) / (2 * step)
    place = np.clip(first[..., None] + np.arange(4), 0, count + 3)  # shifted by one, and three more beyond the last
    out = np.zeros((2, *u.shape, count + 4))
    np.put_along_axis(out[0], place, value, -1)
    np.put_along_axis(out[1], place, slope, -1)
    return out[0, ..., 1 : count + 1], out[1, ..., 1 : count + 1]
