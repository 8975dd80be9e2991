"""Find where the surface crosses the blocks of a grid, and join each with its neighbours. Numba; see blocks.py."""

import math

from numba import njit

from reconstruct.sdf.kernels import FAST, INNER, SHIFT, SIDE, WITHIN


@njit(forceinline=True, **INNER)
def value_at(field, i, j, k):
    """Return the field's value at a node."""
    index, pool, _, far = field
    block = index[i >> SHIFT, j >> SHIFT, k >> SHIFT]
    if block < 0:
        return -far if block & 1 else far
    return pool[block, i & WITHIN, j & WITHIN, k & WITHIN]


@njit(forceinline=True, **INNER)
def eikonal(x, y, z, spacing):
    """Return the distance at a node that solves |grad d| = 1 (Godunov's scheme, Zhao 2005).

    Args:
        x, y, z: the smaller one of its two neighbours' distances along each axis, `spacing` away.
    """
    lo, hi = min(x, y, z), max(x, y, z)
    mid = x + y + z - lo - hi
    d = lo + spacing
    if d > mid:
        d = 0.5 * (lo + mid + math.sqrt(max(2 * spacing * spacing - (lo - mid) ** 2, 0.0)))
        if d > hi:
            q = (lo + mid + hi) ** 2 - 3 * (lo * lo + mid * mid + hi * hi - spacing * spacing)
            d = (lo + mid + hi + math.sqrt(max(q, 0.0))) / 3
    return d


@njit(**FAST)
def crossings(field, places, crossed):
    """Mark the blocks of both nodes of every change of sign between neighbours."""
    _, pool, (nx, ny, nz), _ = field
    for n in range(len(places)):
        a, b, c = places[n]
        for i in range(a * SIDE, min(a * SIDE + SIDE, nx)):
            for j in range(b * SIDE, min(b * SIDE + SIDE, ny)):
                for k in range(c * SIDE, min(c * SIDE + SIDE, nz)):
                    here = pool[n, i & WITHIN, j & WITHIN, k & WITHIN] < 0
                    for axis in range(3):
                        p, q, r = i + (axis == 0), j + (axis == 1), k + (axis == 2)
                        if p < nx and q < ny and r < nz and (value_at(field, p, q, r) < 0) != here:
                            crossed[a, b, c] = crossed[p >> SHIFT, q >> SHIFT, r >> SHIFT] = True


@njit(**FAST)
def overlap(field, places, out):
    """Copy each block, and the nodes after its last ones from the blocks beside it, to out[block], SIDE + 1 per axis.

    Beyond the grid's own nodes the last value is repeated; no cell lies there.
    """
    _, pool, (nx, ny, nz), _ = field
    for block in range(len(places)):
        i, j, k = places[block, 0] * SIDE, places[block, 1] * SIDE, places[block, 2] * SIDE
        for p in range(SIDE + 1):
            for q in range(SIDE + 1):
                if p < SIDE and q < SIDE:
                    for r in range(SIDE):
                        out[block, p, q, r] = pool[block, p, q, r]
                for r in range(SIDE if p < SIDE and q < SIDE else 0, SIDE + 1):
                    at = value_at(field, min(i + p, nx - 1), min(j + q, ny - 1), min(k + r, nz - 1))
                    out[block, p, q, r] = at
