"""Silhouette coherence: every dark ray must meet a point that no view proves empty.

Hernandez, Schmitt and Cipolla, Silhouette coherence for camera calibration under circular motion, PAMI 29 (2007);
for shadows Yamazaki, Narasimhan, Baker and Kanade, The theory and practice of coplanar shadowgram imaging, IJCV 81
(2009). A ray leads from a ground point in shadow to its light, or from the eye through the object to the ground. Its
emptiness is the least, over its points, of the largest distance by which another view proves the point empty. It is at
most 0 where the views agree. Differentiated at the deciding point and view (envelope theorem).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from calibration.outlines.outline_maps import OutlineMaps

HEIGHTS = 40  # points along a ray
TALLEST = 1.4  # of the silhouette's size: a taller object would be seen as such
PIXEL_ERROR = 0.4  # one sigma of an outline, px of the ground field
SLOPE_STEP = 0.5  # cells: half the step of the central differences


@dataclass(frozen=True)
class Residuals:
    """Emptiness of each ray that takes part (world length; positive: views contradict one another), its derivatives."""

    emptiness: Float[np.ndarray, " rays"]
    owner: Int[np.ndarray, " rays"]  # the photo of the ray; the number of photos for the camera
    by: Int[np.ndarray, " rays"]  # the deciding view; -1: none
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
) -> Residuals:
    """Return the emptiness of all rays.

    Args:
        lights: positions, world, z above the ground; eye: the camera's centre likewise.
        used: photos that take part.
    """
    from calibration.outlines.coherence_kernels import least_empty  # numba: help and refusals do not wait for it

    views = np.concatenate([lights, eye[None]])
    takes_part = np.append(used, True)
    chosen = takes_part[maps.owner]
    starts, owner = maps.starts[chosen], maps.owner[chosen]
    emptiness, height = np.empty(len(starts)), np.empty(len(starts))
    by = np.empty(len(starts), np.int64)
    heights = np.linspace(0, TALLEST * maps.size, HEIGHTS + 1)[1:]
    where = (maps.fields, maps.corner, maps.cell, heights)
    least_empty(starts, owner, views, takes_part.astype(np.uint8), *where, emptiness, height, by)
    d_owner, d_by = _derivatives(maps, views, starts, owner, by, height)
    return Residuals(emptiness, owner, by, d_owner, d_by)


def _derivatives(maps: OutlineMaps, views, starts, owner, by, height):
    """Differentiate emptiness = field(q) (z - h) / z, q the deciding light's shadow of the point at height h."""
    light, other, h = views[owner], views[by], height[:, None]
    at = starts + (light[:, :2] - starts) * h / light[:, 2:]
    above = other[:, 2:] - h
    shadow = at + (at - other[:, :2]) * h / above
    value, slope = _value(maps, by, shadow), _slope(maps, by, shadow)
    along = (slope * (light[:, :2] - starts)).sum(1, keepdims=True)
    d_owner = np.concatenate([slope * h / light[:, 2:], -along * h / light[:, 2:] ** 2], 1)
    away = (slope * (at - other[:, :2])).sum(1, keepdims=True)
    d_height = value[:, None] * h / other[:, 2:] ** 2 - away * h / (above * other[:, 2:])
    d_by = np.concatenate([-slope * h / other[:, 2:], d_height], 1)
    silent = by < 0
    d_owner[silent], d_by[silent] = 0.0, 0.0
    return d_owner, d_by


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
