"""Fit light positions to outlines alone, by robust least squares from a start of shadows."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from calibration.outlines.coherence import Residuals, residuals
from calibration.outlines.outline_maps import PIXEL_ERROR, OutlineMaps

COARSEST, STEPS = (5.0, 10.0, 20.0), 40  # pixels of misfit that count fully, at the beginning of a try: later 1
DIRECTION, LOG_HEIGHT = 0.1, 0.4  # prior sigmas of the start: radians, log z
ALONE, ALONE_STEPS = (0.3, 0.6), 18  # prior sigmas as above of a light that is fitted without the others; steps
LONGEST_STEP = 0.25  # of x / z, y / z and log z


@dataclass(frozen=True)
class OutlineFit:
    """Light positions, world, and how well outlines agree with them."""

    lights: Float[np.ndarray, "photos 3"]
    misfit: Float[np.ndarray, " photos"]  # 90th percentile of the emptiness of a photo's rays, px; nan without rays


@dataclass
class _Search:
    """The state of the fit in the coordinates (x / z, y / z, log z) about the foot; see fit_outlines."""

    maps: OutlineMaps
    base: Float[np.ndarray, "3"]
    eye: Float[np.ndarray, "3"]
    used: Bool[np.ndarray, " photos"]
    prior: Float[np.ndarray, "photos 3"]
    sigma: Float[np.ndarray, "photos 3"]  # of the prior
    state: Float[np.ndarray, "photos 3"]
    damping: float = 1e-2

    def look(self, state: Float[np.ndarray, "photos 3"]) -> Residuals:
        """Return the rays' residuals; the lights' z is their height above the ground."""
        along = np.array([*self.base[:2], 0.0])
        return residuals(self.maps, _upright(state) + along, self.eye - [0, 0, self.base[2]], self.used)

    def cost(self, found: Residuals, state: Float[np.ndarray, "photos 3"], scale: float) -> float:
        """Return twice the negative log posterior: Cauchy's for the rays, Gaussian for the start."""
        size = np.maximum(found.emptiness, 0) / scale
        return float(np.log1p(size**2).sum() + (((state - self.prior) / self.sigma) ** 2).sum())

    def descend(self, scales: Float[np.ndarray, " steps"]) -> None:
        """Take one Levenberg-Marquardt step for each scale, world length."""
        found = self.look(self.state)
        for scale in scales:
            matrix, slope = _normal_equations(found, self.state, scale)
            matrix += np.diag((self.sigma**-2).ravel())
            slope += ((self.state - self.prior) / self.sigma**2).ravel()
            before = self.cost(found, self.state, scale)
            for _ in range(6):
                step = -np.linalg.solve(matrix + self.damping * np.diag(np.diag(matrix)), slope).reshape(-1, 3)
                step *= np.minimum(1, LONGEST_STEP / np.maximum(np.abs(step).max(1, keepdims=True), 1e-12))
                trial = self.look(self.state + step)
                if self.cost(trial, self.state + step, scale) < before:
                    self.state, found, self.damping = self.state + step, trial, max(self.damping / 3, 1e-4)
                    break
                self.damping *= 4


def fit_outlines(
    maps: OutlineMaps,
    start: Float[np.ndarray, "photos 3"],
    eye: Float[np.ndarray, "3"],
    ground: float,
    used: Bool[np.ndarray, " photos"],
) -> OutlineFit:
    """Fit the lights in the coordinates (x / z, y / z, log z) about the foot, in which the free homology is smooth.

    Levenberg-Marquardt with Cauchy weights whose scale falls to 1 pixel; the start is a weak prior. The cost has many
    local minima: of several tries with different first scales the best is taken.
    """
    base = np.array([*maps.foot[:2], ground])
    prior = _slanted(start - base)
    slant = DIRECTION * (1 + (prior[:, :2] ** 2).sum(1, keepdims=True))
    sigma = np.concatenate([slant, slant, np.full_like(slant, LOG_HEIGHT)], 1)
    pixel = maps.pixel * PIXEL_ERROR
    tries = []
    for coarsest in COARSEST:
        search = _Search(maps, base, eye, used, prior, sigma, prior.copy())
        search.descend(np.geomspace(coarsest, 1.0, STEPS) * pixel)
        found = search.look(search.state)
        tries.append((search.cost(found, search.state, pixel), search.state, found))
    _, state, found = min(tries, key=lambda one: one[0])
    return OutlineFit(_upright(state) + base, np.array([found.misfit(k) for k in range(len(start))]) / maps.pixel)


def fit_alone(
    maps: OutlineMaps, photo: int, start: Float[np.ndarray, "3"], eye: Float[np.ndarray, "3"], ground: float
) -> tuple[Float[np.ndarray, "3"], float]:
    """Fit one light to its own shadow and to what is known without lights; return it and twice the rays' cost.

    Other lights take no part, so that their errors are not shared. Without `maps.space` this tells a direction only.
    """
    own = maps.owner == photo
    one = replace(
        maps,
        fields=maps.fields[[photo, -1]],
        dark=maps.dark[[photo]],
        known=maps.known[[photo]],
        is_cut=maps.is_cut[[photo]],
        starts=maps.starts[own],
        owner=np.zeros(int(own.sum()), np.int64),
    )
    base = np.array([*maps.foot[:2], ground])
    prior = _slanted((start - base)[None])
    slant = ALONE[0] * (1 + (prior[:, :2] ** 2).sum(1, keepdims=True))
    sigma = np.concatenate([slant, slant, np.full_like(slant, ALONE[1])], 1)
    search = _Search(one, base, eye, np.ones(1, bool), prior, sigma, prior.copy())
    pixel = maps.pixel * PIXEL_ERROR
    search.descend(np.geomspace(COARSEST[1], 1.0, ALONE_STEPS) * pixel)
    return _upright(search.state)[0] + base, search.cost(search.look(search.state), prior, pixel)


def _slanted(arm: Float[np.ndarray, "photos 3"]) -> Float[np.ndarray, "photos 3"]:
    return np.concatenate([arm[:, :2] / arm[:, 2:], np.log(arm[:, 2:])], 1)


def _upright(state: Float[np.ndarray, "photos 3"]) -> Float[np.ndarray, "photos 3"]:
    height = np.exp(state[:, 2:])
    return np.concatenate([state[:, :2] * height, height], 1)


def _normal_equations(found: Residuals, state: np.ndarray, scale: float):
    """Gauss-Newton matrix and slope of the Cauchy cost by (x / z, y / z, log z) of all lights."""
    n = len(state)
    size = np.maximum(found.emptiness, 0) / scale
    active = size > 0
    weight = active / (1 + size**2)
    height = np.exp(state[:, 2])
    by_state = np.zeros((n + 1, 3, 3))
    by_state[:n, 0, 0] = by_state[:n, 1, 1] = by_state[:n, 2, 2] = height
    by_state[:n, 0, 2], by_state[:n, 1, 2] = state[:, 0] * height, state[:, 1] * height
    rows = np.zeros((len(size), 3 * (n + 1)))
    place = np.arange(len(size))[:, None]
    for who, slope in ((found.owner, found.d_owner), (np.maximum(found.by, 0), found.d_by)):
        rows[place, 3 * who[:, None] + np.arange(3)] += np.einsum("ra,rab->rb", slope, by_state[who]) / scale
    rows = rows[active, : 3 * n]
    weight, size = weight[active], size[active]
    return rows.T @ (weight[:, None] * rows), rows.T @ (weight * size)
