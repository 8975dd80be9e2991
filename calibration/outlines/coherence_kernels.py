"""Compiled search along the rays of outlines for the point that the fewest views prove empty."""

import numpy as np
from numba import njit, prange

OUTSIDE = -1e3  # of a map: unknown, so nothing is proven there


@njit(cache=True, nogil=True, inline="always")
def _look(field, x, y, is_camera):
    """Bilinear value at cell coordinates. Outside its map a light proves nothing, and the camera shows no object."""
    n, m = field.shape
    if is_camera:
        x, y = min(max(x, 0.0), n - 1.001), min(max(y, 0.0), m - 1.001)
    i, j = int(np.floor(x)), int(np.floor(y))
    if i < 0 or j < 0 or i >= n - 1 or j >= m - 1:
        return OUTSIDE
    a, b = x - i, y - j
    low = field[i, j] * (1 - b) + field[i, j + 1] * b
    return low * (1 - a) + (field[i + 1, j] * (1 - b) + field[i + 1, j + 1] * b) * a


@njit(cache=True, nogil=True, parallel=True)
def least_empty(starts, owner, views, used, fields, corner, cell, heights, emptiness, height, by):
    """For each ray find the height where the view that proves it emptiest proves least; see coherence.residuals.

    Args:
        starts: (rays, 2) ground points; owner: (rays,) index of the view that a ray leads to.
        views: (views, 3) lights and eye, z above the ground; used: (views,) 1 if a view takes part.
        fields: (views, n, n) signed distances; corner, cell: of the maps.
        heights: (h,) above the ground.
        emptiness, height, by: (rays,) outputs: world length, height, index of the deciding view (-1: none).
    """
    for ray in prange(len(starts)):
        own = owner[ray]
        px, py = starts[ray, 0], starts[ray, 1]
        best, best_height, best_view = 1e9, heights[0], -1
        for h in heights:
            if h >= 0.98 * views[own, 2]:
                break
            share = h / views[own, 2]
            x, y = px + (views[own, 0] - px) * share, py + (views[own, 1] - py) * share
            worst, worst_view = OUTSIDE, -1
            for number in range(len(views)):
                view = len(views) - 1 - number  # the camera first: it proves most of space empty
                z = views[view, 2]
                if view == own or used[view] == 0 or h >= 0.98 * z:
                    continue
                rise = h / (z - h)
                qx, qy = x + (x - views[view, 0]) * rise, y + (y - views[view, 1]) * rise
                x_cell, y_cell = (qx - corner[0]) / cell - 0.5, (qy - corner[1]) / cell - 0.5
                value = _look(fields[view], x_cell, y_cell, view == len(views) - 1)
                value *= (z - h) / z
                if value > worst:
                    worst, worst_view = value, view
                    if worst >= best:
                        break
            if worst < best:
                best, best_height, best_view = worst, h, worst_view
        emptiness[ray], height[ray], by[ray] = best, best_height, best_view
