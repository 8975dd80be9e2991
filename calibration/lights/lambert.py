"""Lambert's law fitted to distant lights pixel by pixel, with given powers or with a power per photo that is free."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

LIT_SHARE = 0.25  # of a pixel's brightest sample: darker ones are shadow
ROUNDS = 3  # of leaving shadows out
BRIGHT = 0.3  # of the brightest tenth: pixels that are lit well enough to be asked
PIXELS = 800  # of the fit of powers
POWER_ROUNDS = 15  # of powers and normals together: the loop ends before, when nothing moves
STILL = 1e-3  # of log power
START_ROUNDS = 8  # of powers and normals in turn, by medians
SHARE = 0.03  # error of a sample relative to its model, beyond which its weight falls
PRIOR = 1.0  # spread of log powers before a photo was seen: it decides only what shading cannot
NEIGHBOURS = 25.0  # thinned pixels that share the error of their surface: each counts as one over this
LEAST_COSINE = 0.1  # to the light, of samples whose ratio to the model tells a power


@dataclass(frozen=True)
class FreePowers:
    """Powers that make photos agree with Lambert's law; only their ratios are known."""

    log_power: Float[np.ndarray, " photos"]  # mean 0
    sigma: float  # of one log power, median
    misfit: float  # relative residual of the lit samples, median pixel


def asked_pixels(values: Float[np.ndarray, "photos pixels"]) -> Bool[np.ndarray, " pixels"]:
    """Return which pixels are lit well enough to be asked."""
    brightest = values.max(0)
    return brightest > BRIGHT * np.quantile(brightest, 0.9)


def lambert(
    values: Float[np.ndarray, "photos pixels"], towards: Float[np.ndarray, "photos 3"]
) -> tuple[Float[np.ndarray, "pixels 3"], Bool[np.ndarray, "photos pixels"]]:
    """Return albedo times normal of every pixel by least squares, and the samples taken as lit.

    I = albedo n . l (Woodham 1980), without samples in shadow.

    Args:
        values: linear, over the lights' powers.
        towards: unit directions.
    """
    lit = values > LIT_SHARE * values.max(0)
    scaled = np.zeros((values.shape[1], 3))
    for _ in range(ROUNDS):
        scaled = _solved(values, lit, towards)
        lit &= values > 0.5 * (towards @ scaled.T)
    return scaled, lit


def relative_misfit(
    values: Float[np.ndarray, "photos pixels"],
    model: Float[np.ndarray, "photos pixels"],
    lit: Bool[np.ndarray, "photos pixels"],
) -> float:
    """Return the residual of the lit samples over their brightness, median over the pixels."""
    off = np.where(lit, np.abs(values - model), 0).sum(0) / np.maximum((values * lit).sum(0), 1e-9)
    return float(np.median(off))


def unexplained_share(values: Float[np.ndarray, "photos pixels"], towards: Float[np.ndarray, "photos 3"]) -> float:
    """Return the residual of the lit samples over their own spread between photos, summed over the pixels asked.

    Other than the relative residual it does not shrink with the contrast, so it compares tone curves. Sums, because a
    flat ground, which may fill most of the picture, agrees with any curve once powers are free.

    Args:
        values, towards: as for lambert.
    """
    values = values[:, asked_pixels(values)]
    scaled, lit = lambert(values, towards)
    count = np.maximum(lit.sum(0), 1)
    spread = np.where(lit, np.abs(values - (values * lit).sum(0) / count), 0).sum(0)
    off = np.where(lit, np.abs(values - towards @ scaled.T), 0).sum(0)
    return float(off.sum() / max(spread.sum(), 1e-9))


def free_powers(values: Float[np.ndarray, "photos pixels"], towards: Float[np.ndarray, "photos 3"]) -> FreePowers:
    """Return a power per photo, up to their common factor, from shading: semi-calibrated photometric stereo.

    I_kp = e_k l_k . b_p (Cho, Matsushita, Tai and Kweon, ECCV 2016) with Cauchy weights for highlights and shadows:
    first in turn, by medians, then by Gauss-Newton steps of log e with b eliminated (variable projection), which also
    follow the directions that fits in turn hardly move along. A flat surface leaves three of them open; a wide prior
    holds these, and sigma tells.

    Args:
        values: linear.
        towards: unit directions, at least 4 of which no three lie in one plane.
    """
    chosen = np.flatnonzero(asked_pixels(values))
    values = values[:, chosen[:: max(1, len(chosen) // PIXELS)]]
    log_power = _in_turn(values, towards)
    covariance = np.eye(len(values))
    for _ in range(POWER_ROUNDS):
        step, covariance = _step(values, towards, log_power)
        log_power = log_power + step
        if np.abs(step).max() < STILL:
            break
    log_power = log_power - log_power.mean()
    plain = values / np.exp(log_power)[:, None]
    scaled, lit = lambert(plain, towards)
    sigma = float(np.median(np.sqrt(np.diag(covariance))))
    return FreePowers(log_power, sigma, relative_misfit(plain, towards @ scaled.T, lit))


def _solved(
    values: Float[np.ndarray, "photos pixels"],
    weight: Bool[np.ndarray, "photos pixels"] | Float[np.ndarray, "photos pixels"],
    rows: Float[np.ndarray, "photos 3"],
) -> Float[np.ndarray, "pixels 3"]:
    """Return the weighted least squares solution of rows b = values, for every pixel."""
    right = (weight * values).T @ rows
    return np.linalg.solve(_gram(weight, rows, 1e-6), right[..., None])[..., 0]


def _gram(
    weight: Bool[np.ndarray, "photos pixels"] | Float[np.ndarray, "photos pixels"],
    rows: Float[np.ndarray, "photos 3"],
    least: float,
) -> Float[np.ndarray, "pixels 3 3"]:
    """Return the sum over photos of weight row row^T, plus a least diagonal."""
    outer = (rows[:, :, None] * rows[:, None, :]).reshape(len(rows), 9)
    return (weight.T @ outer).reshape(-1, 3, 3) + least * np.eye(3)


def _in_turn(
    values: Float[np.ndarray, "photos pixels"], towards: Float[np.ndarray, "photos 3"]
) -> Float[np.ndarray, " photos"]:
    """Return log powers from medians over lit pixels and normals, in turn; the start of the steps."""
    log_power = np.log(np.maximum(np.median(values, axis=1), 1e-9))
    log_power = (log_power - log_power.mean()) / 2  # half of what the photos' brightness says: the rest is shading
    for _ in range(START_ROUNDS):
        plain = values / np.exp(log_power)[:, None]
        scaled, lit = lambert(plain, towards)
        model = towards @ scaled.T
        lit &= model > LEAST_COSINE * np.linalg.norm(scaled, axis=1)
        logs = np.ma.masked_array(np.log(np.where(lit, plain / np.where(lit, model, 1.0), 1.0)), ~lit)
        log_power = log_power + np.asarray(np.ma.median(logs, axis=1).filled(0.0))
        log_power -= log_power.mean()
    return log_power


def _step(
    values: Float[np.ndarray, "photos pixels"],
    towards: Float[np.ndarray, "photos 3"],
    log_power: Float[np.ndarray, " photos"],
) -> tuple[Float[np.ndarray, " photos"], Float[np.ndarray, "photos photos"]]:
    """Return a Gauss-Newton step of the log powers, and their covariance without the common factor."""
    n = len(values)
    power = np.exp(log_power)
    rows = power[:, None] * towards
    scaled, lit = lambert(values / power[:, None], towards)
    level = np.median(np.linalg.norm(scaled, axis=1))
    model = rows @ scaled.T
    weight = np.zeros_like(values)
    for _ in range(ROUNDS):
        sigma = SHARE * np.maximum(np.abs(model), LEAST_COSINE * level * power[:, None])
        weight = lit / (sigma**2 * (1 + ((values - model) / sigma) ** 2)) / NEIGHBOURS
        scaled = _solved(values, weight, rows)
        model = rows @ scaled.T
    cross = (weight * model).T[:, :, None] * rows  # pixels, photos, 3
    half = cross @ np.linalg.inv(_gram(weight, rows, 1e-9))
    left = np.diag((weight * model**2).sum(1)) - np.tensordot(half, cross, ((0, 2), (0, 2)))
    right = (weight * model * (values - model)).sum(1)  # of the pixels' own part nothing is left at their optimum
    left = left + np.eye(n) / PRIOR**2
    right = right - log_power / PRIOR**2
    covariance = np.linalg.inv(left)
    centred = np.eye(n) - 1 / n
    return np.clip(centred @ covariance @ right, -1, 1), centred @ covariance @ centred
