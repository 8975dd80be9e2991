"""Carve voxels by votes of lit ground, and compute the shadows that uneven ground casts on itself. Numba."""

import math

from numba import njit

from reconstruct.sdf.kernels import INNER, UNCOUNTED

NEVER = -1e9
CROSSING_STEPS = 12  # of a fixed point that contracts by slope * cot(elevation)
SETTLED = 0.02  # cells: a crossing that moves by less has converged
SURELY_EMPTY = 3.0  # nodes outside a cone: no crossing lies beside such a node, and no further light is asked
CROSSING_ERROR = 0.5  # cells: a crossing that still moves by more is not used


@njit(**INNER)
def _lookup(field, x, y):
    nx, ny = field.shape
    if x < 0 or y < 0 or x > nx - 1.001 or y > ny - 1.001:
        return NEVER
    i, j = int(x), int(y)
    u, v = x - i, y - j
    a = field[i, j] * (1 - v) + field[i, j + 1] * v
    b = field[i + 1, j] * (1 - v) + field[i + 1, j + 1] * v
    return a * (1 - u) + b * u


@njit(**INNER)
def _crossing(heights, u, gx, gy, z, dx, dy, dz, cell):
    """Find the u at which (gx, gy, z) - u * (dx, dy, dz) meets uneven ground; NEVER if there is none.

    gx, gy: in cells, at u = 0. The iteration is u = (z - height(u)) / dz; it diverges if the ground is as steep as the
    light.
    """
    moved = 0.0
    for _ in range(CROSSING_STEPS):
        height = _lookup(heights, gx - u * dx / cell, gy - u * dy / cell)
        if height == NEVER:
            return NEVER
        following = (z - height) / dz
        moved = abs(following - u) * dz
        u = following
        if moved < SETTLED * cell:
            break
    return u if moved < CROSSING_ERROR * cell else NEVER


@njit(**UNCOUNTED)
def above_ground(lit, points, lights, heights, origin, cell, top, skip, start, stop):
    """Set lit[k, p] = 1 if the ray from a point to a light stays above uneven ground, else 0; nan points stay 0.

    Args:
        lit: (lights, points) uint8, columns start .. stop - 1 are filled. points: (n, 3) world.
        heights: (gx, gy) world z at origin + cell * (i, j). top: its largest. skip: cells from the point to the start.
    """
    for p in range(start, stop):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        if not abs(z) < -NEVER:
            continue
        for k in range(len(lights)):
            w = lights[k, 3]
            dx, dy, dz = lights[k, 0] - w * x, lights[k, 1] - w * y, lights[k, 2] - w * z
            flat = math.sqrt(dx * dx + dy * dy)
            step = 0.5 * cell / max(flat, 1e-9 * abs(dz) + 1e-30)
            t = 2 * skip * step
            free = dz > 0
            while free and z + t * dz < top and not (w > 0 and t >= 1):
                height = _lookup(heights, (x + t * dx - origin[0]) / cell, (y + t * dy - origin[1]) / cell)
                if height == NEVER:
                    break
                free = z + t * dz >= height
                t += step
            lit[k, p] = 1 if free else 0


@njit(forceinline=True, **INNER)
def _insert(best, value):
    """Insert a value into the largest ones, if it is one of them."""
    m = len(best) - 1
    if value <= best[m]:
        return
    while m > 0 and best[m - 1] < value:
        best[m] = best[m - 1]
        m -= 1
    best[m] = value


@njit(**UNCOUNTED)
def carve(out, needed, denied, known, origin, spacing, lights, maps, field_origin, cell, ground, best, start, stop):
    """Compute each node's last of the largest distances to the shadow cones of the lights; positive = proven empty.

    Where it is more than SURELY_EMPTY nodes, it is a smaller one that is as sure, and the count of `needed` ends early.

    A node x is projected from light q to the ground; the signed distance there to the edge of the lit ground, scaled
    back to x (r_x / r_ground) and foreshortened (sine of the elevation), is how far x lies outside the shadow cone.

    Args:
        out, needed, denied: (nx, ny, nz) nodes, slabs start .. stop - 1 are filled; needed counts the lights under
            which a node's shadow would fall on ground that is seen dark; denied is 1 if under one it is seen lit.
        origin, spacing: world.
        known: such distances that already prove nodes empty; empty if nothing does.
        maps: fields, (lights, gx, gy) signed distance inside lit ground, world length, at field_origin + cell * (i, j);
            dark, the same of ground seen in shadow; heights, (gx, gy) of uneven ground there, empty for a plane.
        ground: height of the ground plane.
        best: of use here only, with room for as many distances as are compared.
    """
    fields, dark, heights = maps
    votes, enough = len(best), SURELY_EMPTY * spacing
    _, ny, nz = out.shape
    for i in range(start, stop):
        x = origin[0] + i * spacing
        for j in range(ny):
            y = origin[1] + j * spacing
            for k in range(nz):
                z = origin[2] + k * spacing
                if known.size > 0 and known[i, j, k] > enough:
                    out[i, j, k], needed[i, j, k], denied[i, j, k] = known[i, j, k], 0, 1
                    continue
                best[:] = NEVER
                count = 0
                for n in range(len(lights)):
                    w = lights[n, 3]
                    dx, dy, dz = lights[n, 0] - w * x, lights[n, 1] - w * y, lights[n, 2] - w * z
                    if dz <= 1e-6:
                        continue
                    u = (z - ground) / dz
                    if heights.size > 0:
                        at_x, at_y = (x - field_origin[0]) / cell, (y - field_origin[1]) / cell
                        u = _crossing(heights, u, at_x, at_y, z, dx, dy, dz, cell)
                        if u == NEVER:
                            continue
                    gx, gy = (x - u * dx - field_origin[0]) / cell, (y - u * dy - field_origin[1]) / cell
                    value = _lookup(fields[n], gx, gy)
                    if value == NEVER:
                        continue
                    count += dark[n, int(gx + 0.5), int(gy + 0.5)]
                    sine = dz / math.sqrt(dx * dx + dy * dy + dz * dz)
                    value *= sine / (1 + w * max(u, -0.5))
                    _insert(best, value)
                    if best[votes - 1] > enough:
                        break
                out[i, j, k] = best[votes - 1]
                needed[i, j, k], denied[i, j, k] = min(count, 255), best[0] > 0
