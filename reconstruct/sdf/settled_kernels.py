"""Kernels that tell the rays which leave no gradient, in tiles of neighbours. Numba, grid frame, voxels.

Rays agree with a label of 0 or 1 as long as the SDF keeps its distance from 0 on them; see reconstruct/sdf/settled.py.
Where the march of a tile cannot tell, it says on which part of the ray: the tiles in it march along that part only.
"""

import math

import numpy as np
from numba import njit

from reconstruct.sdf.block_kernels import eikonal, value_at
from reconstruct.sdf.kernels import (
    EDGE,
    FAR,
    GROUND,
    INNER,
    NO_WEIGHT,
    OBJECT,
    STEP,
    UNCOUNTED,
    _clip,
    _gradient,
    _sample,
    _towards,
)  # fmt: skip

RISE = 0.1  # of the SDF along a ray from the surface, per voxel: with less, small changes bring the ray back to it
TILT = 0.05  # cosine by which a surface must face away from its light, or towards it, for good
LIT, SHADED = 0.999, 0.001  # visibility from which a label counts as fully lit, up to which as fully dark
LIFT = 1.0  # voxels along a ray from the surface before its SDF is compared with RISE
WIDE = 4  # nodes of the grid from one node of the wide field to the next
SHRINK = 0.8  # of its distances: sweeping and interpolation are too large by so much about tiny balls,
LESS = 1.5  # and by so many voxels
STRIDE = 0.4  # of a tile's reach: its shortest step
DISTANCE_TO = 5.9  # voxels: up to here the SDF is a distance, see level_set.BAND
WHOLE = 1e9  # a part's end beyond every ray's
LEAST_REACH = 1e-6  # of a tile: 0 is a single ray's
SETTLED, DOUBTFUL, UNSETTLED = 1, 0, 2  # all rays of a tile, on a part of them, none


@njit(**UNCOUNTED)
def widen(phi, out, fixed):
    """Write the SDF at every WIDE-th node to out, beyond the band as a lower bound of the distance, with its sign.

    Fast sweeping as in level_set_kernels.sweep, from the nodes within the band.

    Args:
        fixed: bool, as large as out, of use here only.
    """
    most = min(phi[3], DISTANCE_TO)
    for i, j, k in np.ndindex(out.shape):
        f = abs(_node(phi, i, j, k))
        fixed[i, j, k] = f < most
        out[i, j, k] = f if f < most else FAR
    for order in range(8):
        _sweep(out, fixed, order)
    for i, j, k in np.ndindex(out.shape):
        if not fixed[i, j, k]:
            out[i, j, k] = max(most, most + SHRINK * (out[i, j, k] - most) - LESS)
        if _node(phi, i, j, k) < 0:
            out[i, j, k] = -out[i, j, k]


@njit(**INNER)
def _sweep(out, fixed, order):
    """Do one Gauss-Seidel sweep of |grad d| = 1 over the nodes that are not fixed, in one of 8 orders."""
    nx, ny, nz = out.shape
    for a in range(nx):
        i = a if order & 1 else nx - 1 - a
        for b in range(ny):
            j = b if order & 2 else ny - 1 - b
            for c in range(nz):
                k = c if order & 4 else nz - 1 - c
                if not fixed[i, j, k]:
                    out[i, j, k] = min(out[i, j, k], _from_beside(out, i, j, k))


@njit(forceinline=True, **INNER)
def _node(phi, i, j, k):
    """Return the SDF at a node of the wide field; beyond the grid, that of its last node."""
    nx, ny, nz = phi[2]
    return value_at(phi, min(WIDE * i, nx - 1), min(WIDE * j, ny - 1), min(WIDE * k, nz - 1))


@njit(forceinline=True, **INNER)
def _from_beside(d, i, j, k):
    """Return the distance at a node of the wide field from its neighbours'; see `eikonal`."""
    nx, ny, nz = d.shape
    x = min(d[max(i - 1, 0), j, k], d[min(i + 1, nx - 1), j, k])
    y = min(d[i, max(j - 1, 0), k], d[i, min(j + 1, ny - 1), k])
    z = min(d[i, j, max(k - 1, 0)], d[i, j, min(k + 1, nz - 1)])
    return eikonal(x, y, z, float(WIDE))


@njit(forceinline=True, **INNER)
def _far_sample(phi, wide, x, y, z):
    """Return the trilinear SDF, and beyond the band that of the wide field."""
    f = _sample(phi, x, y, z)
    if abs(f) < min(phi[3], DISTANCE_TO):
        return f
    nodes = phi[2]
    x = min(max(x, 0.0), nodes[0] - 1.0) / WIDE
    y = min(max(y, 0.0), nodes[1] - 1.0) / WIDE
    z = min(max(z, 0.0), nodes[2] - 1.0) / WIDE
    i, j, k = int(x), int(y), int(z)
    u, v, w = x - i, y - j, z - k
    a = wide[i, j, k] * (1 - w) + wide[i, j, k + 1] * w
    b = wide[i, j + 1, k] * (1 - w) + wide[i, j + 1, k + 1] * w
    c = wide[i + 1, j, k] * (1 - w) + wide[i + 1, j, k + 1] * w
    d = wide[i + 1, j + 1, k] * (1 - w) + wide[i + 1, j + 1, k + 1] * w
    g = (a * (1 - v) + b * v) * (1 - u) + (c * (1 - v) + d * v) * u
    return max(f, g) if f > 0 else min(f, g)


@njit(**INNER)
def _not_clear(phi, wide, origin, ray, part, reach, need, rise):
    """Return from where to where on a part of a ray the SDF may be below `need` within `reach` of it; or below rise t.

    The SDF changes by at most the distance. Beyond the box it is taken where the box is nearest: a projection onto
    a box brings no two points further apart, so the bound holds for the part of the neighbourhood in the box.

    Args:
        rise: 0, or how steeply the SDF must rise from the surface near t = 0, instead of being `need` there.

    Returns: first and last parameter; the last is -1 where there are none. A single ray's (reach 0): the first one.
    """
    nodes, around = phi[2], 2 * reach
    box = (nodes[0] + around, nodes[1] + around, nodes[2] + around)
    near = (origin[0] + reach, origin[1] + reach, origin[2] + reach)
    t, end = _clip(box, near[0], near[1], near[2], ray[0], ray[1], ray[2], part[0], part[1])
    first, last = FAR, -1.0
    shortest = max(STEP, STRIDE * reach)
    spare = 0.5 * (shortest - STEP)  # the SDF falls by no more between two points of such a step
    while t <= end:
        f = _far_sample(phi, wide, origin[0] + t * ray[0], origin[1] + t * ray[1], origin[2] + t * ray[2])
        gap = f - reach - spare - (min(need, rise * (t - LIFT)) if rise > 0 else need)
        step = max(shortest, abs(gap) / (1 + rise))
        if gap < 0:
            if first == FAR:
                first = max(t - shortest, part[0])
            last = t + step
            if reach == 0:
                break
        t += step
    return first, last


@njit(**INNER)
def _not_blocked(phi, wide, origin, ray, part, reach, need):
    """Return whether every ray within `reach` of a part of a ray is blocked: the SDF falls by `need` below 0 on it.

    Then T < Phi(-s need).

    Returns: if so; else from where to where rays within reach may be in the object, the last -1 where none can be.
    """
    t, end = _clip(phi[2], origin[0], origin[1], origin[2], ray[0], ray[1], ray[2], part[0], part[1])
    first, last = FAR, -1.0
    if t >= end:
        return False, first, last
    shortest = max(STEP, STRIDE * reach)
    top, before = -FAR, t
    while t <= end:
        f = _far_sample(phi, wide, origin[0] + t * ray[0], origin[1] + t * ray[1], origin[2] + t * ray[2])
        top = max(top, f)
        if min(top, reach) - f > need + 2 * reach:
            return True, first, last
        if f <= 2 * reach + 0.5 * shortest:
            first, last = min(first, before), t + shortest
        before = t
        t += max(shortest, f + need + reach)
    return False, first, last


@njit(**INNER)
def _examine(phi, wide, start, kind, light, part, reach, y, need, out):
    """Return whether rays that start within `reach` of a point keep their label, and on which part of them not.

    Args:
        kind: of the starts: GROUND, OBJECT on the surface (out: its unit normal), EDGE at a silhouette.
        light: lights and the number of one.
        part: of the rays, where a larger tile did not settle them: of the way to a point, or along a direction.
        need: voxels by which the SDF must stay away from 0.

    Returns: SETTLED, DOUBTFUL or UNSETTLED, and the part of the rays that leaves the doubt.
    """
    dx, dy, dz, far = _towards(light[0], light[1], start[0], start[1], start[2])
    facing = out[0] * dx + out[1] * dy + out[2] * dz
    tilt = TILT + RISE * reach
    if y < 0.5 and kind == OBJECT and facing < -tilt:
        return SETTLED, part
    if y > 0.5 and kind == OBJECT and facing < tilt:
        return (UNSETTLED if reach == 0 else DOUBTFUL), part
    unit = far if far < FAR else 1.0  # rays to one point approach each other on the way
    here, ray = (part[0] * unit, min(part[1] * unit, far)), (dx, dy, dz)
    origin = (start[0], start[1], start[2])
    if y < 0.5:
        blocked, first, last = _not_blocked(phi, wide, origin, ray, here, reach, need)
        if blocked:
            return SETTLED, part
        return (UNSETTLED if last < 0 or reach == 0 else DOUBTFUL), (first / unit, last / unit)
    rise = RISE if kind != GROUND else 0.0
    first, last = _not_clear(phi, wide, origin, ray, here, reach, need, rise)
    if last < 0:
        return SETTLED, part
    return (UNSETTLED if reach == 0 else DOUBTFUL), (first / unit, min(last / unit, part[1]))


@njit(**UNCOUNTED)
def ray_starts(phi, eye, directions, ground_t, hit, part_t, role, starts, kinds, normals, start, stop):
    """Write where each pixel's shadow rays start, and how; see _examine. Kind EDGE: two starts, or none."""
    for p in range(start, stop):
        is_hit = hit[p] < FAR and role[p] != GROUND
        end = hit[p] if is_hit else ground_t[p]
        kinds[p] = OBJECT if is_hit else GROUND
        if end > FAR or (role[p] == OBJECT and not is_hit) or (part_t[p] > 0 and role[p] != GROUND):
            kinds[p] = EDGE
        for a in range(3):
            starts[p, a] = eye[a] + min(end, FAR) * directions[p, a]
            normals[p, a] = 0.0
        if kinds[p] == OBJECT:
            gx, gy, gz = _gradient(phi, starts[p, 0], starts[p, 1], starts[p, 2])
            size = max(math.sqrt(gx * gx + gy * gy + gz * gz), 1e-9)
            normals[p, 0], normals[p, 1], normals[p, 2] = gx / size, gy / size, gz / size


@njit(**UNCOUNTED)
def tile_reach(order, edges, starts, kinds, normals, reach, middle, start, stop):
    """Write each tile's middle pixel, and how far its rays start from that one's; -1 if they are of several kinds."""
    for tile in range(start, stop):
        a, b = edges[tile], edges[tile + 1]
        m = order[(a + b) // 2]
        middle[tile] = m
        largest = 0.0
        for i in range(a, b):
            p = order[i]
            x, y, z = starts[p, 0] - starts[m, 0], starts[p, 1] - starts[m, 1], starts[p, 2] - starts[m, 2]
            largest = max(largest, x * x + y * y + z * z)
            alike = normals[p, 0] * normals[m, 0] + normals[p, 1] * normals[m, 1] + normals[p, 2] * normals[m, 2]
            if kinds[p] != kinds[m] or kinds[p] == EDGE or (kinds[p] == OBJECT and alike < 0.9):
                largest = 1e9
        reach[tile] = math.sqrt(largest) if largest < 1e9 else -1.0


@njit(forceinline=True, **INNER)
def _common_label(label, confidence, k, order, a, b):
    """Return 1 or 0 if all labels with weight are fully lit or fully dark, -1 if not, 2 if none has weight."""
    common = 2
    for i in range(a, b):
        p = order[i]
        if confidence[k, p] < NO_WEIGHT:
            continue
        own = 1 if label[k, p] > LIT else (0 if label[k, p] < SHADED else -1)
        if own < 0 or (common != 2 and common != own):
            return -1
        common = own
    return common


@njit(**UNCOUNTED)
def find_unsettled(phi, wide, tiles, view, lights, label, confidence, need, found, start, stop):
    """Mark the rays that may leave a gradient, tile by tile: a tile of settled rays costs one march. Grid frame.

    Args:
        wide: see `widen`.
        tiles: order of the pixels; then for each size, from coarse to fine, (first pixel, first finer tile, reach,
            middle pixel) of every tile. start .. stop - 1 number (light, coarsest tile).
        view: starts, kinds and normals of ray_starts.
        need: voxels by which the SDF must stay away from 0.
        found: bool (photos, pixels), set to True.
    """
    order, coarse, middle, fine = tiles
    rays, whole = (view, label, confidence), (0.0, WHOLE)
    for r in range(start, stop):
        n = len(coarse[0]) - 1
        light, i = (lights, r // n), r % n
        state, part = _examine_tile(phi, wide, order, coarse, i, rays, light, whole, need)
        if state == SETTLED:
            continue
        for j in range(coarse[1][i], coarse[1][i + 1]):
            above = state, part
            if state != UNSETTLED:
                above = _examine_tile(phi, wide, order, middle, j, rays, light, part, need)
            if above[0] == SETTLED:
                continue
            for m in range(middle[1][j], middle[1][j + 1]):
                own = above
                if own[0] != UNSETTLED:
                    own = _examine_tile(phi, wide, order, fine, m, rays, light, above[1], need)
                if own[0] != SETTLED:
                    _mark(phi, wide, order, (fine[0][m], fine[0][m + 1]), rays, light, own, need, found)


@njit(**INNER)
def _examine_tile(phi, wide, order, tiles, i, rays, light, part, need):
    """Return what _examine does for the rays of a tile; of various labels or kinds all is doubtful."""
    edges, _, reach, middle = tiles
    (starts, kinds, normals), label, confidence = rays
    y = _common_label(label, confidence, light[1], order, edges[i], edges[i + 1])
    if y == 2:
        return SETTLED, part
    if y < 0 or reach[i] < 0 or edges[i + 1] - edges[i] < 2:
        return DOUBTFUL, (0.0, WHOLE)
    p = middle[i]
    return _examine(phi, wide, starts[p], kinds[p], light, part, max(reach[i], LEAST_REACH), y, need, normals[p])


@njit(**INNER)
def _mark(phi, wide, order, pixels, rays, light, above, need, found):
    """Mark the single rays of a tile that are not settled, given the result of _examine for it."""
    (starts, kinds, normals), label, confidence = rays
    k = light[1]
    for i in range(pixels[0], pixels[1]):
        p = order[i]
        if confidence[k, p] < NO_WEIGHT:
            continue
        y = label[k, p]
        if above[0] == UNSETTLED or kinds[p] == EDGE or (y < LIT and y > SHADED):
            found[k, p] = True
            continue
        state, _ = _examine(phi, wide, starts[p], kinds[p], light, above[1], 0.0, y, need, normals[p])
        found[k, p] = state != SETTLED


@njit(**UNCOUNTED)
def find_unsettled_views(phi, wide, eye, directions, ground_t, mask, confidence, need, found, start, stop):
    """Mark the pixels whose camera ray may leave a gradient. Grid frame."""
    for p in range(start, stop):
        found[p] = 0
        if confidence[p] < NO_WEIGHT:
            continue
        ray, origin = (directions[p, 0], directions[p, 1], directions[p, 2]), (eye[0], eye[1], eye[2])
        if mask[p] < SHADED:
            found[p] = _not_clear(phi, wide, origin, ray, (0.0, ground_t[p]), 0.0, need, 0.0)[1] >= 0
        elif mask[p] > LIT:
            found[p] = not _not_blocked(phi, wide, origin, ray, (0.0, ground_t[p]), 0.0, need)[0]
        else:
            found[p] = 1
