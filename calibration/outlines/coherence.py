"""Silhouette coherence: every dark ray must meet a point that no view proves empty.

Hernandez, Schmitt and Cipolla, Silhouette coherence for camera calibration under circular motion, PAMI 29 (2007);
for shadows Yamazaki, Narasimhan, Baker and Kanade, The theory and practice of coplanar shadowgram imaging, IJCV 81
(2009). A ray leads from a ground point in shadow to its light, or from the eye through the object to the ground. Its
emptiness is the least, over its points, of the largest distance by which another view proves the point empty; 0 where
the views agree, that is where no view proves some point of the ray empty. Differentiated at the deciding point and
view (envelope theorem).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from calibration.outlines.outline_maps import PIXEL_ERROR, TALLEST, OutlineMaps

BY_SPACE = -2  # as in coherence_kernels: the space that photos from the side prove empty
FINE = 0.02  # px: an emptiness of less is none, far below the outlines' own error
PENUMBRA = 0.01  # of the object's size: how far the seen edge of a penumbra lies off
SLOPE_STEP = 0.5  # cells: half the step of the central differences


@dataclass(frozen=True)
class Residuals:
    """Emptiness of each ray that takes part (world length; 0 where the views agree), and its derivatives."""

    emptiness: Float[np.ndarray, " rays"]
    owner: Int[np.ndarray, " rays"]  # the photo of the ray; the number of photos for the camera
    by: Int[np.ndarray, " rays"]  # the deciding view; -1: none; BY_SPACE: what is known in millimetres
    d_owner: Float[np.ndarray, "rays 3"]  # by the position of the ray's own light
    d_by: Float[np.ndarray, "rays 3"]  # by the position of the deciding light

    def misfit(self, photo: int) -> float:
        """Return the 90th percentile of the emptiness of a photo's rays, world length; nan without rays."""
        rays = self.emptiness[self.owner == photo]
        return float(np.percentile(rays, 90)) if len(rays) else float("nan")


def residuals(
    maps: OutlineMaps,
    lights: Float[np.ndarray, "photos 3"],
    eye: Float[np.ndarray, "3"],
    used: Bool[np.ndarray, " photos"],
    coarse: float = 1.0,
    of: Bool[np.ndarray, " views"] | None = None,
) -> Residuals:
    """Return the emptiness of all rays, or of those of some views.

    Args:
        lights: positions, world, z above the ground; eye: the camera's centre likewise.
        used: photos that take part.
        coarse: factor of FINE, below which nothing is looked for.
        of: whose rays, the camera's last; None: of all, with those of photos from the side.
    """
    from calibration.outlines.coherence_kernels import least_empty  # numba: help and refusals do not wait for it

    views = np.concatenate([lights, eye[None]])
    takes_part = np.append(used, True)
    chosen = takes_part[maps.owner] if of is None else (takes_part & of)[maps.owner]
    starts, owner = maps.starts[chosen], maps.owner[chosen]
    emptiness, height = np.empty(len(starts)), np.empty(len(starts))
    by = np.empty(len(starts), np.int64)
    soft = np.append(softness(maps, lights), 0.0)
    where = _where(maps, views, takes_part.astype(np.uint8), soft)
    first = maps.first_height[chosen]
    least_empty(starts, owner, where, TALLEST * maps.size, FINE * coarse * maps.pixel, first, emptiness, height, by)
    maps.first_height[chosen] = first
    light, h = views[owner], height[:, None]
    at = np.concatenate([starts + (light[:, :2] - starts) * h / light[:, 2:], h], 1)
    slope, d_by = _derivatives(maps, views, at, by)
    along = (slope * (light[:, :2] - starts)).sum(1, keepdims=True)
    d_owner = np.concatenate([slope * h / light[:, 2:], -along * h / light[:, 2:] ** 2], 1)
    wide = _wide(soft, by, height, soft[owner])
    found = Residuals(emptiness, owner, by, d_owner / wide, d_by / wide)
    return found if maps.space is None or of is not None else _with_fixed_rays(found, maps, views, where)


def _wide(soft: np.ndarray, by: np.ndarray, height: np.ndarray, own_soft: np.ndarray | float):
    """Return by what penumbrae divide each ray's derivatives: (rays, 1)."""
    return np.sqrt(1 + (height * own_soft) ** 2 + (height * np.where(by < 0, 0, soft[by])) ** 2)[:, None]


def softness(maps: OutlineMaps, lights: Float[np.ndarray, "photos 3"]) -> Float[np.ndarray, " photos"]:
    """Return the sigma of a shadow's edge per height of what casts it, over that of a sharp edge, 1 / world length.

    A flashlight is no point: an edge at height h casts a penumbra, R h / (z - h) wide across the light and longer by
    distance / z along it, and where its middle is seen depends on the tone curve. At the height of the edge this is
    R h / z times that. A light near the horizon therefore tells less than one overhead.

    Args:
        lights: positions, z above the ground.
    """
    reach = np.linalg.norm(lights - [*maps.foot[:2], 0.0], axis=1)
    return PENUMBRA * maps.size * reach / np.maximum(lights[:, 2], 1e-9) ** 2 / (PIXEL_ERROR * maps.pixel)


def _where(maps: OutlineMaps, views: np.ndarray, used: np.ndarray, soft: np.ndarray):
    """Return what the kernels need of views and maps."""
    if maps.space is None:
        space = np.zeros((0, 0, 0), np.float32), np.zeros(3), 1.0
    else:
        space = maps.space.field, maps.space.corner, maps.space.cell
    return views, used, maps.fields, maps.corner, maps.cell, soft, *space


def _with_fixed_rays(found: Residuals, maps: OutlineMaps, views: Float[np.ndarray, "views 3"], where) -> Residuals:
    """Return the residuals with those of rays that no light moves: of photos from the side. Owner: the camera."""
    from calibration.outlines.coherence_kernels import least_empty_points

    space = maps.space
    assert space is not None
    n = len(space.ends) - 1
    emptiness, chosen, by = np.empty(n), np.empty(n, np.int64), np.empty(n, np.int64)
    least_empty_points(space.points, space.ends, where, emptiness, chosen, by)
    _, d_by = _derivatives(maps, views, space.points[chosen], by)
    d_by = d_by / _wide(where[5], by, space.points[chosen, 2], 0.0)
    owner = np.full(n, len(views) - 1)
    rows = (emptiness, owner, by, np.zeros((n, 3)), d_by)
    old = (found.emptiness, found.owner, found.by, found.d_owner, found.d_by)
    return Residuals(*(np.concatenate(pair) for pair in zip(old, rows, strict=True)))


def _derivatives(maps: OutlineMaps, views, at: Float[np.ndarray, "rays 3"], by: Int[np.ndarray, " rays"]):
    """Differentiate emptiness = field(q) (z - h) / z, q the deciding light's shadow of a point at height h.

    Returns:
        the derivatives by x and y of the point (rays, 2), and by the position of the deciding light (rays, 3).
    """
    other, h = views[by], at[:, 2:]
    above = other[:, 2:] - h
    shadow = at[:, :2] + (at[:, :2] - other[:, :2]) * h / above
    value, slope = _value(maps, by, shadow), _slope(maps, by, shadow)
    away = (slope * (at[:, :2] - other[:, :2])).sum(1, keepdims=True)
    d_height = value[:, None] * h / other[:, 2:] ** 2 - away * h / (above * other[:, 2:])
    d_by = np.concatenate([-slope * h / other[:, 2:], d_height], 1)
    silent = by < 0
    slope[silent], d_by[silent] = 0.0, 0.0
    if maps.space is not None:
        slope[by == BY_SPACE] = maps.space.slope(at[by == BY_SPACE])
    return slope, d_by


def _value(maps: OutlineMaps, view: np.ndarray, points: np.ndarray) -> np.ndarray:
    place = np.clip((points - maps.corner) / maps.cell - 0.5, 0, maps.fields.shape[1] - 1.001)
    low = place.astype(int)
    a, b = (place - low).T
    i, j = low.T
    field = maps.fields
    near = field[view, i, j] * (1 - b) + field[view, i, j + 1] * b
    return near * (1 - a) + (field[view, i + 1, j] * (1 - b) + field[view, i + 1, j + 1] * b) * a


def _slope(maps: OutlineMaps, view: np.ndarray, points: np.ndarray) -> np.ndarray:
    step = SLOPE_STEP * maps.cell
    sides = [
        (_value(maps, view, points + step * axis) - _value(maps, view, points - step * axis)) / (2 * step)
        for axis in np.eye(2)
    ]
    return np.stack(sides, -1)
