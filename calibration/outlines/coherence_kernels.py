"""Compiled search along the rays of outlines for the point that the views prove least empty.

How far a view proves a point empty falls along a ray at most as fast as the two rays' slopes differ. So a search need
not look where the last proof still holds [Hart, Sphere tracing, The Visual Computer 12 (1996)]. It finds an edge that a
ray only grazes, which looks at fixed heights pass over.
"""

from typing import Any

import numpy as np
from numba import njit, prange

STRIDE = 5  # of the first look along a ray
OUTSIDE = -1e3  # of a map: unknown, so nothing is proven there
BY_SPACE = -2  # in place of a view: a posed camera from the side, or the object's height
BETTER = 0.02  # of the least that was found: less of an improvement is not looked for

# Called by kernels of this file alone: no entries for Python or C are compiled. A call from Python ends the process.
INNER: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "forceinline": True,
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
}


@njit(**INNER)
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


@njit(**INNER)
def _proven(x, y, h, view, field, is_camera, corner, cell, softness):
    """How far a view proves the point (x, y, h) empty, in the units of its field at the point.

    Args:
        softness: variance of the edge over that of a sharp one.
    """
    rise = h / (view[2] - h)
    qx, qy = x + (x - view[0]) * rise, y + (y - view[1]) * rise
    value = _look(field, (qx - corner[0]) / cell - 0.5, (qy - corner[1]) / cell - 0.5, is_camera)
    return value * (view[2] - h) / view[2] / np.sqrt(softness)


@njit(**INNER)
def _known_empty(space, x, y, z):
    """Trilinear value at node coordinates, at the nearest point of the box: the object lies in it."""
    n, m, k = space.shape
    x, y, z = min(max(x, 0.0), n - 1.001), min(max(y, 0.0), m - 1.001), min(max(z, 0.0), k - 1.001)
    i, j, h = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
    a, b, c = x - i, y - j, z - h
    total = 0.0
    for di in range(2):
        for dj in range(2):
            share = (a if di else 1 - a) * (b if dj else 1 - b)
            total += share * (space[i + di, j + dj, h] * (1 - c) + space[i + di, j + dj, h + 1] * c)
    return total


@njit(**INNER)
def _by_space(x, y, h, space, space_corner, space_cell, softness):
    """How far the point is proven empty by what is not a light; OUTSIDE where nothing is known besides lights."""
    if space.size == 0:
        return OUTSIDE
    at = (x - space_corner[0]) / space_cell, (y - space_corner[1]) / space_cell, (h - space_corner[2]) / space_cell
    return _known_empty(space, at[0], at[1], at[2]) / np.sqrt(softness)


@njit(**INNER)
def _coarse_first(step, count):
    """The step-th number of 0 .. count - 1 in strides: a good point is known early, and most others end at one view."""
    long = count % STRIDE  # strides with one number more
    each = count // STRIDE
    if step < long * (each + 1):
        return (step // (each + 1)) + (step % (each + 1)) * STRIDE
    rest = step - long * (each + 1)
    return long + rest // max(each, 1) + (rest % max(each, 1)) * STRIDE


@njit(**INNER)
def _emptiest(x, y, h, own, best, first, views, used, fields, corner, cell, soft, space, space_corner, space_cell):
    """Return by how far the point is proven empty, and the deciding view; ends early when it is at least `best`.

    Args:
        own: the view that is not asked; -1, whose softness is the camera's, for none.
        first: the view that is asked first; -1 for none. One that proved a point near this one empty often ends it.
    """
    worst = _by_space(x, y, h, space, space_corner, space_cell, 1 + h * h * soft[own] ** 2)
    worst_view = BY_SPACE if worst > OUTSIDE else -1
    if worst >= best:
        return worst, worst_view
    for number in range(-1, len(views)):
        view = first if number < 0 else len(views) - 1 - number  # the camera before the lights: it proves most empty
        if view < 0 or (number >= 0 and view == first):
            continue
        if view == own or used[view] == 0 or h >= 0.98 * views[view, 2]:
            continue
        softness = 1 + h * h * (soft[own] ** 2 + soft[view] ** 2)
        is_camera = view == len(views) - 1
        value = _proven(x, y, h, views[view], fields[view], is_camera, corner, cell, softness)
        if value > worst:
            worst, worst_view = value, view
            if worst >= best:
                break
    return worst, worst_view


@njit(**INNER)
def _fall(x, y, h, value, own, view, views, soft, across, up):
    """Return by how much per height what a view proves along a ray can fall.

    Args:
        value: what it proves at the point; across, up: the ray's slope, horizontal lengths per height.
    """
    if view < 0:
        return np.sqrt(1 + across * across + up * up)
    left = views[view, 2] - h
    apart = np.hypot(across - (views[view, 0] - x) / left, up - (views[view, 1] - y) / left)
    softer = h * (soft[own] ** 2 + soft[view] ** 2)
    return apart + abs(value) * (1 / views[view, 2] + softer / (1 + h * softer))


@njit(cache=True, nogil=True, parallel=True)
def least_empty(starts, owner, where, top, fine, first_height, emptiness, height, by):
    """For each ray find the height where the view that proves it emptiest proves least; see coherence.residuals.

    Where a point is found that no view proves empty, the search ends: emptiness 0, by no view.

    Args:
        starts: (rays, 2) ground points; owner: (rays,) index of the view that a ray leads to.
        where: of the views and what they prove:
        views: (views, 3) lights and eye, z above the ground; used: (views,) 1 if a view takes part.
        fields: (views, n, n) signed distances; corner, cell: of the maps.
        soft: (views,) softness of a view's edges per height; see coherence.softness; the camera's, the last, is 0.
        space: (x, y, z) what is proven without lights, or of size 0; space_corner, space_cell: of its nodes.
        top: the greatest height; fine: an emptiness of less is none, world length.
        first_height: (rays,) height that is looked at first, replaced by the one found: a good height that is known
            early lets the search skip most others.
        emptiness, height, by: (rays,) outputs: world length, height, index of the deciding view (-1: none, BY_SPACE).
    """
    views, used, fields, corner, cell, soft, space, space_corner, space_cell = where
    for ray in prange(len(starts)):
        own = owner[ray]
        across = (views[own, 0] - starts[ray, 0]) / views[own, 2]
        up = (views[own, 1] - starts[ray, 1]) / views[own, 2]
        highest = min(top, 0.98 * views[own, 2])
        best, best_height, best_view, last = 1e9, 0.0, -1, -1
        h, is_first = min(first_height[ray], highest), True
        while h <= highest:
            x, y = starts[ray, 0] + across * h, starts[ray, 1] + up * h
            worst, last = _emptiest(
                x, y, h, own, best, last, views, used, fields, corner, cell, soft, space, space_corner, space_cell
            )
            if worst < best:
                best, best_height, best_view = worst, h, last
            if best <= 0:
                best, best_view = 0.0, -1
                break
            if is_first:
                h, is_first = 0.0, False
            else:
                promise = worst - (1 - BETTER) * best + fine
                h += promise / max(_fall(x, y, h, worst, own, last, views, soft, across, up), 1e-6)
        emptiness[ray], height[ray], by[ray] = best, best_height, best_view
        first_height[ray] = best_height


@njit(cache=True, nogil=True)  # little work: in parallel it would take longer to compile than it saves
def least_empty_points(points, ends, where, emptiness, chosen, by):
    """As least_empty, for rays that are given by their points: ray k has points[ends[k] : ends[k + 1]], z above ground.

    Args:
        chosen: (rays,) output: index of the point that is proven empty least.
    """
    views, used, fields, corner, cell, soft, space, space_corner, space_cell = where
    for ray in range(len(ends) - 1):
        best, best_point, best_view, last = 1e9, ends[ray], -1, -1
        for step in range(ends[ray + 1] - ends[ray]):
            k = ends[ray] + _coarse_first(step, ends[ray + 1] - ends[ray])
            x, y, h = points[k, 0], points[k, 1], points[k, 2]
            worst, last = _emptiest(
                x, y, h, -1, best, last, views, used, fields, corner, cell, soft, space, space_corner, space_cell
            )
            if worst < best:
                best, best_point, best_view = worst, k, last
            if best <= 0:
                best, best_view = 0.0, -1
                break
        emptiness[ray], chosen[ray], by[ray] = best, best_point, best_view
