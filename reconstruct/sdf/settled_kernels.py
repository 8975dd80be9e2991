"""Kernels that tell the rays which leave no gradient, in tiles of neighbours. Numba, grid frame, voxels.

Rays agree with a label of 0 or 1 as long as the SDF keeps its distance from 0 on them; see reconstruct/sdf/settled.py.
"""

import math

from numba import njit

from reconstruct.sdf.kernels import (
    EDGE,
    FAR,
    FAST,
    GROUND,
    NO_WEIGHT,
    OBJECT,
    STEP,
    _clip,
    _free,
    _gradient,
    _sample,
    _towards,
)  # fmt: skip

RISE = 0.1  # of the SDF along a ray from the surface, per voxel: with less, small changes bring the ray back to it
TILT = 0.05  # cosine by which a surface must face away from its light, or towards it, for good
LIT, SHADED = 0.999, 0.001  # visibility from which a label counts as fully lit, up to which as fully dark
LIFT = 1.0  # voxels along a ray from the surface before its SDF is compared with RISE


@njit(**FAST)
def _stays_clear(phi, ox, oy, oz, dx, dy, dz, far, reach, need, rise):
    """Return whether the SDF is at least `need` within `reach` of all points of a ray; near t = 0, `rise` t if not 0.

    The SDF changes by at most the distance. Beyond the box it is taken where the box is nearest: a projection onto
    a box brings no two points further apart, so the bound holds for the part of the neighbourhood in the box.
    """
    _, _, nodes, most = phi
    wide = 2 * reach
    around = (nodes[0] + wide, nodes[1] + wide, nodes[2] + wide)
    t, end = _clip(around, ox + reach, oy + reach, oz + reach, dx, dy, dz, 0.0, far)
    while t <= end:
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        f = _sample(phi, x, y, z)
        leap = 0.0
        if f >= most:
            leap = _free(phi, x, y, z)
            f += leap
        least = reach + (min(need, rise * (t - LIFT)) if rise > 0 else need)
        if f < least:
            return False
        t += max(STEP, leap, (f - least) / (1 + rise))
    return True


@njit(**FAST)
def _stays_blocked(phi, ox, oy, oz, dx, dy, dz, far, reach, need):
    """Return whether the SDF falls by `need` into the object on each ray within `reach` of a ray: T < Phi(-s need)."""
    t, end = _clip(phi[2], ox, oy, oz, dx, dy, dz, 0.0, far)
    if t >= end:
        return False
    top = -1e9
    while t <= end:
        f = _sample(phi, ox + t * dx, oy + t * dy, oz + t * dz)
        top = max(top, f)
        if min(top, reach) - f > need + 2 * reach:
            return True
        t += max(STEP, f)
    return False


@njit(**FAST)
def _is_settled(phi, start, kind, lights, k, reach, y, need, out):
    """Return whether rays that start within `reach` of a point keep their label.

    Args:
        kind: of the starts: GROUND, OBJECT on the surface (out: its unit normal), EDGE at a silhouette.
        need: voxels by which the SDF must stay away from 0.
    """
    x, y0, z = start[0], start[1], start[2]
    dx, dy, dz, far = _towards(lights, k, x, y0, z)
    facing = out[0] * dx + out[1] * dy + out[2] * dz
    tilt = TILT + RISE * reach
    if y < 0.5 and kind == OBJECT and facing < -tilt:
        return True
    if y < 0.5:
        return _stays_blocked(phi, x, y0, z, dx, dy, dz, far, reach, need)
    if kind == GROUND:
        return _stays_clear(phi, x, y0, z, dx, dy, dz, far, reach, need, 0.0)
    if kind == OBJECT and facing < tilt:
        return False
    return _stays_clear(phi, x, y0, z, dx, dy, dz, far, reach, need, RISE)


@njit(**FAST)
def ray_starts(phi, eye, directions, ground_t, hit, part_t, role, starts, kinds, normals, start, stop):
    """Write where each pixel's shadow rays start, and how; see _is_settled. Kind EDGE: two starts, or none."""
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


@njit(**FAST)
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


@njit(forceinline=True, **FAST)
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


@njit(**FAST)
def find_unsettled(phi, tiles, view, lights, label, confidence, need, found, start, stop):
    """Mark the rays that may leave a gradient, tile by tile: a tile of settled rays costs one march. Grid frame.

    Args:
        tiles: order of the pixels; then for each size, from coarse to fine, (first pixel, first finer tile, reach,
            middle pixel) of every tile. start .. stop - 1 number (light, coarsest tile).
        view: starts, kinds and normals of ray_starts.
        need: voxels by which the SDF must stay away from 0.
        found: uint8 (photos, pixels), set to 1.
    """
    order, coarse, middle, fine = tiles
    for r in range(start, stop):
        n = len(coarse[0]) - 1
        k, i = r // n, r % n
        if _tile_is_settled(phi, order, coarse, i, view, lights, k, label, confidence, need):
            continue
        for j in range(coarse[1][i], coarse[1][i + 1]):
            if _tile_is_settled(phi, order, middle, j, view, lights, k, label, confidence, need):
                continue
            for m in range(middle[1][j], middle[1][j + 1]):
                if _tile_is_settled(phi, order, fine, m, view, lights, k, label, confidence, need):
                    continue
                _mark(phi, order, fine[0][m], fine[0][m + 1], view, lights, k, label, confidence, need, found)


@njit(**FAST)
def _tile_is_settled(phi, order, tiles, i, view, lights, k, label, confidence, need):
    edges, _, reach, middle = tiles
    starts, kinds, normals = view
    y = _common_label(label, confidence, k, order, edges[i], edges[i + 1])
    if y == 2:
        return True
    if y < 0 or reach[i] < 0 or edges[i + 1] - edges[i] < 2:
        return False
    p = middle[i]
    return _is_settled(phi, starts[p], kinds[p], lights, k, reach[i], y, need, normals[p])


@njit(**FAST)
def _mark(phi, order, first, last, view, lights, k, label, confidence, need, found):
    starts, kinds, normals = view
    for i in range(first, last):
        p = order[i]
        if confidence[k, p] < NO_WEIGHT:
            continue
        y = label[k, p]
        found[k, p] = (
            kinds[p] == EDGE
            or (y < LIT and y > SHADED)
            or not _is_settled(phi, starts[p], kinds[p], lights, k, 0.0, y, need, normals[p])
        )


@njit(**FAST)
def find_unsettled_views(phi, eye, directions, ground_t, mask, confidence, need, found, start, stop):
    """Mark the pixels whose camera ray may leave a gradient in mask_pass. Grid frame."""
    for p in range(start, stop):
        found[p] = 0
        if confidence[p] < NO_WEIGHT:
            continue
        x, y, z = directions[p, 0], directions[p, 1], directions[p, 2]
        if mask[p] < SHADED:
            found[p] = not _stays_clear(phi, eye[0], eye[1], eye[2], x, y, z, ground_t[p], 0.0, need, 0.0)
        elif mask[p] > LIT:
            found[p] = not _stays_blocked(phi, eye[0], eye[1], eye[2], x, y, z, ground_t[p], 0.0, need)
        else:
            found[p] = 1
