"""Votes of every pixel on every node of a box, and the shadows of chosen nodes on the ground. Numba."""

import math

from numba import njit

from reconstruct.sdf.kernels import FAST, INNER


@njit(**FAST)
def count_votes(n_dark, n_lit, origin, spacing, lights, shadow, silent, cells, corner, cell, ground, start, stop):
    """Count the lights that cast a node's shadow on a pixel that is dark under them, and on one that is lit.

    Args:
        n_dark, n_lit: (nx, ny, nz) int16 nodes at origin + spacing * (i, j, k); slabs start .. stop - 1 are filled.
        shadow: (lights, pixels) uint8, 1 = dark. silent: (pixels,) uint8, 1 = does not vote.
        cells: (gx, gy) int32, the pixel that shows the ground at corner + cell * (i, j); -1: none does.
    """
    gx, gy = cells.shape
    _, ny, nz = n_dark.shape
    for i in range(start, stop):
        for j in range(ny):
            for k in range(nz):
                z = origin[2] + k * spacing
                dark = lit = 0
                for n in range(len(lights)):
                    w = lights[n, 3]
                    dz = lights[n, 2] - w * z
                    if dz <= 1e-6:
                        continue
                    u = (z - ground) / dz
                    x, y = origin[0] + i * spacing, origin[1] + j * spacing
                    a = math.floor((x - u * (lights[n, 0] - w * x) - corner[0]) / cell + 0.5)
                    b = math.floor((y - u * (lights[n, 1] - w * y) - corner[1]) / cell + 0.5)
                    if a < 0 or b < 0 or a >= gx or b >= gy:
                        continue
                    pixel = cells[a, b]
                    if pixel < 0 or silent[pixel]:
                        continue
                    if shadow[n, pixel]:
                        dark += 1
                    else:
                        lit += 1
                n_dark[i, j, k], n_lit[i, j, k] = dark, lit


@njit(forceinline=True, **INNER)
def _is_blocked(solid, x, y, z, dx, dy, dz, first, last):
    """Return whether a solid node lies on x + t * d, first <= t <= last; all in nodes, d of unit length."""
    nx, ny, nz = solid.shape
    for place, step, count in ((x, dx, nx), (y, dy, ny), (z, dz, nz)):
        if abs(step) < 1e-12:
            if place < -0.5 or place > count - 0.5:
                return False
            continue
        a, b = (-0.5 - place) / step, (count - 0.5 - place) / step
        first, last = max(first, min(a, b)), min(last, max(a, b))
    t = first
    while t <= last:
        i, j, k = int(x + t * dx + 0.5), int(y + t * dy + 0.5), int(z + t * dz + 0.5)
        if 0 <= i < nx and 0 <= j < ny and 0 <= k < nz and solid[i, j, k]:
            return True
        t += 0.5
    return False


@njit(**FAST)
def cast_shadows(dark, wanted, points, lights, solid, origin, spacing, start, stop):
    """Set dark[k, p] = 1 where a solid node lies between a ground point and a light; unwanted entries stay unchanged.

    Args:
        dark, wanted: (lights, pixels) uint8, columns start .. stop - 1. points: (pixels, 3) world, finite where wanted.
        solid: (nx, ny, nz) uint8 nodes at origin + spacing * (i, j, k).
    """
    for p in range(start, stop):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        for n in range(len(lights)):
            if not wanted[n, p]:
                continue
            w = lights[n, 3]
            dx, dy, dz = lights[n, 0] - w * x, lights[n, 1] - w * y, lights[n, 2] - w * z
            length = math.sqrt(dx * dx + dy * dy + dz * dz)
            u, v, h = (x - origin[0]) / spacing, (y - origin[1]) / spacing, (z - origin[2]) / spacing
            last = length / spacing if w > 0 else 1e9
            blocked = _is_blocked(solid, u, v, h, dx / length, dy / length, dz / length, 1.0, last)
            dark[n, p] = 1 if blocked else 0
