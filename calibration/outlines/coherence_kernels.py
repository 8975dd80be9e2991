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


@njit(cache=True, nogil=True, inline="always")
def _proven(x, y, h, view, field, is_camera, corner, cell, softness):
    """How far a view proves the point (x, y, h) empty, in the units of its field at the point.

    Args:
        softness: variance of the edge over that of a sharp one.
    """
    rise = h / (view[2] - h)
    qx, qy = x + (x - view[0]) * rise, y + (y - view[1]) * rise
    value = _look(field, (qx - corner[0]) / cell - 0.5, (qy - corner[1]) / cell - 0.5, is_camera)
    return value * (view[2] - h) / view[2] / np.sqrt(softness)


@njit(cache=True, nogil=True, parallel=True)
def least_empty(starts, owner, views, used, fields, corner, cell, heights, soft, emptiness, height, by):
    """For each ray find the height where the view that proves it emptiest proves least; see coherence.residuals.

    Args:
        starts: (rays, 2) ground points; owner: (rays,) index of the view that a ray leads to.
        views: (views, 3) lights and eye, z above the ground; used: (views,) 1 if a view takes part.
        fields: (views, n, n) signed distances; corner, cell: of the maps.
        heights: (h,) above the ground.
        soft: (views,) softness of a view's edges per height; see coherence.softness.
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
                if view == own or used[view] == 0 or h >= 0.98 * views[view, 2]:
                    continue
                softness = 1 + h * h * (soft[own] ** 2 + soft[view] ** 2)
                is_camera = view == len(views) - 1
                value = _proven(x, y, h, views[view], fields[view], is_camera, corner, cell, softness)
                if value > worst:
                    worst, worst_view = value, view
                    if worst >= best:
                        break
            if worst < best:
                best, best_height, best_view = worst, h, worst_view
        emptiness[ray], height[ray], by[ray] = best, best_height, best_view


@njit(cache=True, nogil=True, parallel=True)
def proven_by_others(starts, owner, views, used, fields, corner, cell, heights, soft, without, worst):
    """For each ray and height find what all views but one light prove at most; see coherence.OneLight.

    Args: as for least_empty; without: the light; worst: (rays, h) output, inf where the ray has ended.
    """
    for ray in prange(len(starts)):
        own = owner[ray]
        for step in range(len(heights)):
            h = heights[step]
            worst[ray, step] = OUTSIDE
            if h >= 0.98 * views[own, 2]:
                worst[ray, step:] = np.inf
                break
            share = h / views[own, 2]
            x = starts[ray, 0] + (views[own, 0] - starts[ray, 0]) * share
            y = starts[ray, 1] + (views[own, 1] - starts[ray, 1]) * share
            for view in range(len(views)):
                if view in (own, without) or used[view] == 0 or h >= 0.98 * views[view, 2]:
                    continue
                softness = 1 + h * h * (soft[own] ** 2 + soft[view] ** 2)
                is_camera = view == len(views) - 1
                value = _proven(x, y, h, views[view], fields[view], is_camera, corner, cell, softness)
                worst[ray, step] = max(worst[ray, step], value)


@njit(cache=True, nogil=True, parallel=True)
def least_with_places(starts, owner, views, field, corner, cell, heights, soft, worst, places, own_soft, emptiness):
    """For each place of one light find the emptiness of the others' rays; see coherence.OneLight.

    Args: as for least_empty; field: of the light; worst: of proven_by_others; places: (places, 3) of the light;
        own_soft: (places,) its softness there; emptiness: (places, rays) output.
    """
    for ray in prange(len(starts)):
        own = owner[ray]
        for place in range(len(places)):
            best = 1e9
            for step in range(len(heights)):
                h = heights[step]
                if worst[ray, step] >= best:
                    continue
                share = h / views[own, 2]
                x = starts[ray, 0] + (views[own, 0] - starts[ray, 0]) * share
                y = starts[ray, 1] + (views[own, 1] - starts[ray, 1]) * share
                value = worst[ray, step]
                if h < 0.98 * places[place, 2]:
                    softness = 1 + h * h * (soft[own] ** 2 + own_soft[place] ** 2)
                    value = max(value, _proven(x, y, h, places[place], field, False, corner, cell, softness))
                best = min(best, value)
            emptiness[place, ray] = best
