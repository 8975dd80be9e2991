"""Votes of the lit ground on every voxel. Numba."""

import math

import numpy as np
from numba import njit

from reconstruct.kernels import FAST

NEVER = -1e9


@njit(**FAST)
def _lookup(field, x, y):
    nx, ny = field.shape
    if x < 0 or y < 0 or x > nx - 1.001 or y > ny - 1.001:
        return NEVER
    i, j = int(x), int(y)
    u, v = x - i, y - j
    a = field[i, j] * (1 - v) + field[i, j + 1] * v
    b = field[i + 1, j] * (1 - v) + field[i + 1, j + 1] * v
    return a * (1 - u) + b * u


@njit(**FAST)
def carve(out, needed, origin, spacing, lights, fields, dark, field_origin, cell, ground, votes, start, stop):
    """The votes-th largest distance of each node to the shadow cones of the lights; positive = proven empty.

    A node x is projected from light q to the ground; the signed distance there to the edge of the lit ground, scaled
    back to x (r_x / r_ground) and foreshortened (sine of the elevation), is how far x lies outside the shadow cone.

    Args:
        out, needed: (nx, ny, nz) nodes, slabs start .. stop - 1 are filled; needed counts the lights under which the
            node's shadow would fall on ground that is seen to be dark. origin, spacing: world.
        fields: (lights, gx, gy) signed distance inside lit ground, world length, at field_origin + cell * (i, j).
        dark: (lights, gx, gy) ground seen in shadow.
        ground: height of the ground plane.
    """
    _, ny, nz = out.shape
    best = np.empty(votes)
    for i in range(start, stop):
        x = origin[0] + i * spacing
        for j in range(ny):
            y = origin[1] + j * spacing
            for k in range(nz):
                z = origin[2] + k * spacing
                best[:] = NEVER
                count = 0
                for n in range(len(lights)):
                    w = lights[n, 3]
                    dx, dy, dz = lights[n, 0] - w * x, lights[n, 1] - w * y, lights[n, 2] - w * z
                    if dz <= 1e-6:
                        continue
                    u = (z - ground) / dz
                    gx, gy = (x - u * dx - field_origin[0]) / cell, (y - u * dy - field_origin[1]) / cell
                    value = _lookup(fields[n], gx, gy)
                    if value == NEVER:
                        continue
                    count += dark[n, int(gx + 0.5), int(gy + 0.5)]
                    sine = dz / math.sqrt(dx * dx + dy * dy + dz * dz)
                    value *= sine / (1 + w * max(u, -0.5))
                    m = votes - 1
                    if value <= best[m]:
                        continue
                    while m > 0 and best[m - 1] < value:
                        best[m] = best[m - 1]
                        m -= 1
                    best[m] = value
                out[i, j, k] = best[votes - 1]
                needed[i, j, k] = min(count, 255)
