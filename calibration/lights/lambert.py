"""Lambert's law fitted to distant lights pixel by pixel, with given powers or with a power per photo that is free."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

HIGH = 0.75  # quantile over photos: highlights are in fewer than a quarter of them, shadows in no more than most
LIT_SHARE = 0.25  # of a pixel's high sample: darker ones are shadow
OFF = 0.5  # residual over its model beyond which a sample is in shadow, or a highlight
ROUNDS = 8  # of weighing outliers down: the residual stands still
BRIGHT = 0.3  # of the brightest tenth: pixels that are lit well enough to be asked
EXPLAINED = 0.1  # relative misfit beyond which shading tells no power; a list in wrong order leaves 0.11 to 0.2
PIXELS = 800  # of the fit of powers
POWER_ROUNDS = 15  # of powers and normals together: the loop ends before, when nothing moves
STILL = 1e-3  # of log power
START_ROUNDS = 8  # of powers and normals in turn, by medians
SHARE = 0.03  # error of a sample relative to its model, beyond which its weight falls
PRIOR = 1.0  # spread of log powers before a photo was seen: it decides only what shading cannot
LEAST_SHARE = 0.02  # residual over its model below which samples weigh alike: what 8 bits resolve of a dark picture
NEIGHBOURS = 25.0  # thinned pixels that share the error of their surface: each counts as one over this
LEAST_COSINE = 0.1  # to the light, of samples whose ratio to the model tells a power


@dataclass(frozen=True)
class FreePowers:
    """Powers that make photos agree with Lambert's law; only their ratios are known."""

    log_power: Float[np.ndarray, " photos"]  # mean 0
    sigma: float  # of one log power, median
    misfit: float  # relative residual of the lit samples, median pixel


def high_samples(values: Float[np.ndarray, "photos pixels"]) -> Float[np.ndarray, " pixels"]:
    """Return how bright each pixel is where its light is good, highlights left out."""
    return np.quantile(values, HIGH, axis=0)


def asked_pixels(values: Float[np.ndarray, "photos pixels"]) -> Bool[np.ndarray, " pixels"]:
    """Return which pixels are lit well enough to be asked."""
    high = high_samples(values)
    return high > BRIGHT * np.quantile(high, 0.9)


def lambert(
    values: Float[np.ndarray, "photos pixels"],
    towards: Float[np.ndarray, "photos 3"],
    lit: Bool[np.ndarray, "photos pixels"] | None = None,
) -> tuple[Float[np.ndarray, "pixels 3"], Bool[np.ndarray, "photos pixels"]]:
    """Return albedo times normal of every pixel by least absolute residuals, and the samples taken as lit.

    I = albedo n . l (Woodham 1980), without samples in shadow. A highlight far above the model pulls no more than a
    sample just above it.

    Args:
        values: linear, over the lights' powers.
        towards: unit directions.
        lit: the samples to take; None: all that no shadow darkens.
    """
    bright = values > LIT_SHARE * high_samples(values) if lit is None else lit
    taken, scaled = bright, _solved(values, bright, towards)
    for _ in range(ROUNDS):
        model = towards @ scaled.T
        taken = bright & (values > (1 - OFF) * model) if lit is None else lit
        size = np.maximum(np.abs(model), LEAST_COSINE * np.linalg.norm(scaled, axis=1) + 1e-9)
        scaled = _solved(values, taken / np.maximum(np.abs(values - model) / size, LEAST_SHARE), towards)
    return scaled, taken


def relative_misfit(
    values: Float[np.ndarray, "photos pixels"],
    model: Float[np.ndarray, "photos pixels"],
    lit: Bool[np.ndarray, "photos pixels"],
) -> float:
    """Return the residual of the lit samples over their brightness, median over the pixels.

    A sample above its model counts no more than one at the edge of shadow: a highlight is not Lambert's to explain.
    """
    off = np.minimum(np.abs(values - model), OFF * np.abs(model))
    return float(np.median((off * lit).sum(0) / np.maximum((values * lit).sum(0), 1e-9)))


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
    """Return the sum over photos of weight row row^T, plus a least diagonal: that and its share of the trace."""
    outer = (rows[:, :, None] * rows[:, None, :]).reshape(len(rows), 9)
    gram = (weight.T @ outer).reshape(-1, 3, 3)
    return gram + least * (1 + np.trace(gram, axis1=1, axis2=2))[:, None, None] * np.eye(3)


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
