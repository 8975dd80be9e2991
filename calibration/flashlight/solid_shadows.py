"""Estimate a light from the shadows that upright solids of known place and size cast on the ground.

The shadow of a convex solid on a plane is the convex hull of its foot and of its top projected from the light. For the
light (x, y, z, w), z above the ground, a top point T of height h projects to
T_xy - ((x, y) - w T_xy) h / (z - w h). The brightness of the ground is fitted robustly as
dark + (lit - dark) sigmoid(distance to that hull / softness) over the pixels around the solids. Every edge of every
shadow counts, not only its tip.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import least_squares
from scipy.spatial import ConvexHull

from capture.checks.robust import spread
from capture.session.declared_objects import Solid

SIDES = 10  # of the prism that stands for a round peg: its radius is off by 4 % of a few millimetres
REACH = 5.0  # heights around a solid that are looked at: a light at 12 degrees
SOFTNESS = (3.0, 1.5, 1.0)  # px, from a first look to the edge itself; a peg's shadow is a few px wide
BAND = 8.0  # softnesses around the outline that take part: farther pixels no longer depend on the light
ROUNDS = 12  # of least squares per softness
FARTHEST = 0.4  # of the distance (or of a slope) from the start: beyond, the shadow would be another one
LEVELS = ((0.0, 0.8), (0.35, 1.25))  # least and most of dark and lit ground: light thrown by the object, a wrong beam
SOFT = 3.0  # NOISE: from here on a pixel counts as an outlier
NOISE = 0.08  # of lit ground: texture, penumbra and light thrown by the object
PIXELS_ALIKE = 6.0  # neighbours share the errors of an edge: so many count as one
PLACE_ERROR = 0.5  # mm, of where a solid stands and how high it is
RANGE_BELIEF = 0.5  # one sigma of log distance against where the search began: for what shadows leave free
DARK, LIT = 0.45, 0.7  # of lit ground: what a shadow may keep at most, and its surroundings at least
MIN_PIXELS = 12  # of shadow, and as many around it
STEEPEST = 12.0  # degrees: lower lights are not searched


@dataclass(frozen=True)
class GroundPixels:
    """Pixels around the solids: their ground points, and their brightness over the lit brightness there."""

    points: Float[np.ndarray, "pixels 2"]  # world x, y above the ground plane
    size: float  # of a pixel on the ground
    value: Float[np.ndarray, "photos pixels"]  # 1 = lit; NaN unknown


@dataclass(frozen=True)
class ShadowLight:
    """A light found from shadows: homogeneous, height above the ground, with the covariance of its three numbers.

    The numbers are a point's place, or (x / z, y / z, 1) of a direction; the third of a direction has no uncertainty.
    """

    light: Float[np.ndarray, "4"]
    covariance: Float[np.ndarray, "3 3"]


def footprint(solid: Solid) -> Float[np.ndarray, "corners 2"]:
    """Corners of the solid's foot, world x and y."""
    n = SIDES if solid.is_round else 4
    angle = 2 * np.pi * (np.arange(n) + 0.5) / n + solid.turn
    radius = solid.width / 2 if solid.is_round else solid.width / np.sqrt(2)
    return np.array([solid.x, solid.y]) + radius * np.stack([np.cos(angle), np.sin(angle)], -1)


def shadow_outline(solid: Solid, light: Float[np.ndarray, "4"]) -> Float[np.ndarray, "edges 3"]:
    """Return the shadow's convex outline as edges (a, b, c); a x + b y + c is the distance outside an edge.

    Args:
        light: homogeneous, its z above the ground and above the solid's top.
    """
    foot, h = footprint(solid), solid.height
    top = foot - (light[:2] - light[3] * foot) * h / max(light[2] - light[3] * h, 1e-3 * h)
    return ConvexHull(np.concatenate([foot, top])).equations


def distance_outside(
    points: Float[np.ndarray, "pixels 2"], solids: tuple[Solid, ...], light: Float[np.ndarray, "4"]
) -> Float[np.ndarray, " pixels"]:
    """Return the distance of points outside all shadows; negative inside."""
    nearest = np.full(len(points), np.inf)
    for solid in solids:
        edges = shadow_outline(solid, light)
        each = points @ edges[:, :2].T
        each += edges[:, 2]
        nearest = np.minimum(nearest, each.max(1))
    return nearest


def _predicted(points, solids: tuple[Solid, ...], light, levels, softness: float):
    inside = np.clip(distance_outside(points, solids, light) / softness, -30, 30)
    return levels[0] + (levels[1] - levels[0]) / (1 + np.exp(-inside))


def near_solids(points: Float[np.ndarray, "pixels 2"], solids: tuple[Solid, ...]) -> Bool[np.ndarray, " pixels"]:
    """Return which ground points a solid's shadow can reach."""
    out = np.zeros(len(points), bool)
    for solid in solids:
        away = np.linalg.norm(points - [solid.x, solid.y], axis=1)
        out |= away < REACH * solid.height + solid.width
    return out


def fit_light(
    pixels: GroundPixels, photo: int, solids: tuple[Solid, ...], start: Float[np.ndarray, "4"]
) -> ShadowLight | None:
    """Fit the light of one photo to the solids' shadows; None if no shadow is where it is expected.

    Args:
        start: homogeneous, z above the ground; points and directions are both searched near it.
    """
    known = np.isfinite(pixels.value[photo])
    points, value = pixels.points[known], np.clip(pixels.value[photo][known], 0.0, 1.3)
    problem = _Problem(points, value, solids, start)
    x, near, edge = np.r_[np.zeros(problem.free), 0.1, 1.0], np.ones(len(points), bool), problem
    for step in SOFTNESS:
        softness = step * pixels.size
        near &= np.abs(distance_outside(points, solids, problem.light(x))) < BAND * softness
        if near.sum() < MIN_PIXELS:
            return None
        edge = replace(problem, points=points[near], value=value[near])
        options = {"loss": "soft_l1", "f_scale": SOFT, "x_scale": 0.05, "max_nfev": ROUNDS, "bounds": problem.bounds()}
        x = least_squares(edge.residuals, x, edge.jacobian, args=(softness,), **options).x
    softness, light = SOFTNESS[-1] * pixels.size, problem.light(x)
    if light[2] <= 0:
        return None
    outside = distance_outside(points, solids, light)
    shadow, around = outside < -0.5 * softness, (outside > 2 * softness) & (outside < 10 * softness)
    if min(shadow.sum(), around.sum()) < MIN_PIXELS:
        return None
    if np.median(value[shadow]) > DARK or np.median(value[around]) < LIT:
        return None
    return ShadowLight(light, edge.covariance(x, softness))


@dataclass(frozen=True)
class _Problem:
    """Least squares over one photo; unknowns: steps of a point (3) or direction (2), the dark and the lit level."""

    points: Float[np.ndarray, "pixels 2"]
    value: Float[np.ndarray, " pixels"]
    solids: tuple[Solid, ...]
    start: Float[np.ndarray, "4"]

    @property
    def free(self) -> int:
        """Unknowns of the light."""
        return 3 if self.start[3] else 2

    def bounds(self) -> tuple[list[float], list[float]]:
        """Lower and upper bounds of the unknowns."""
        (dark, lit), (dark_most, lit_most) = LEVELS
        return [*[-FARTHEST] * self.free, dark, lit], [*[FARTHEST] * self.free, dark_most, lit_most]

    def scale(self) -> float:
        """Length of a unit step: the light's distance, or 1 for slopes."""
        return float(np.linalg.norm(self.start[:3] - self._foot())) if self.start[3] else 1.0

    def _foot(self) -> Float[np.ndarray, "3"]:
        return np.array([np.mean([s.x for s in self.solids]), np.mean([s.y for s in self.solids]), 0.0])

    def light(self, x: Float[np.ndarray, " unknowns"]) -> Float[np.ndarray, "4"]:
        """Return the homogeneous light for the unknowns; a direction has z = 1."""
        if self.start[3]:
            return np.r_[self.start[:3] + self.scale() * x[:3], 1.0]
        return np.r_[self.start[:2] / self.start[2] + x[:2], 1.0, 0.0]

    def residuals(self, x: Float[np.ndarray, " unknowns"], softness: float) -> Float[np.ndarray, " rows"]:
        """Return the residuals of the pixels in units of NOISE, then that of the prior on distance."""
        light = self.light(x)
        misfit = (_predicted(self.points, self.solids, light, x[-2:], softness) - self.value) / NOISE
        if not self.start[3]:
            return misfit
        reach = max(float(np.linalg.norm(light[:3] - self._foot())), 1e-9)
        return np.append(misfit, np.log(reach / self.scale()) / RANGE_BELIEF)

    def covariance(self, x: Float[np.ndarray, " unknowns"], softness: float) -> Float[np.ndarray, "3 3"]:
        """Return the light's covariance: edge noise, and errors in the solids' places and heights."""
        n = len(self.points)
        jac, at = self.jacobian(x, softness), self.residuals(x, softness)[:n]
        vote = 1 / np.sqrt(1 + (at / SOFT) ** 2)  # soft_l1
        sigma = max(spread(at), 0.25)
        unit = PIXELS_ALIKE * sigma**2
        data, belief = jac[:n] * np.sqrt(vote)[:, None], jac[n:]
        inverse = np.linalg.pinv(data.T @ data / unit + belief.T @ belief)
        total = inverse.copy()
        for i, solid in enumerate(self.solids):
            for name in ("x", "y", "height"):
                moved = replace(solid, **{name: getattr(solid, name) + PLACE_ERROR})
                other = replace(self, solids=(*self.solids[:i], moved, *self.solids[i + 1 :]))
                change = other.residuals(x, softness)[:n] - at
                by = inverse @ (data.T @ (np.sqrt(vote) * change)) / unit
                total += np.outer(by, by)
        out = np.zeros((3, 3))
        out[: self.free, : self.free] = total[: self.free, : self.free] * self.scale() ** 2
        return out

    def jacobian(self, x: Float[np.ndarray, " unknowns"], softness: float) -> Float[np.ndarray, "rows unknowns"]:
        """Of the residuals, by central differences."""
        columns = []
        for i in range(len(x)):
            step = np.zeros(len(x))
            step[i] = 1e-3
            up, down = self.residuals(x + step, softness), self.residuals(x - step, softness)
            columns.append((up - down) / 2e-3)
        return np.stack(columns, -1)


def search_direction(pixels: GroundPixels, photo: int, solids: tuple[Solid, ...]) -> Float[np.ndarray, "4"]:
    """Search a coarse sky grid for the directional light whose shadows fit a photo best (median, then nearest)."""
    known = np.isfinite(pixels.value[photo])
    points, value = pixels.points[known], np.clip(pixels.value[photo][known], 0.0, 1.3)
    best, least = np.array([0.0, 0.0, 1.0, 0.0]), np.inf
    for elevation in np.radians(np.linspace(STEEPEST, 84.0, 13)):
        for azimuth in np.arange(0, 2 * np.pi, np.pi / 36):
            slope = np.array([np.cos(azimuth), np.sin(azimuth)]) / np.tan(elevation)
            light = np.r_[slope, 1.0, 0.0]
            predicted = _predicted(points, solids, light, (0.1, 1.0), SOFTNESS[-1] * pixels.size)
            misfit = float(np.minimum(np.abs(predicted - value), 0.5).sum())
            if misfit < least:
                best, least = light, misfit
    return best
