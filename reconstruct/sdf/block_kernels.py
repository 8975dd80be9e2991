"""Fill, unpack and move the blocks of a grid, and find where the surface crosses them. Numba; see blocks.py."""

import math

import numpy as np
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


@njit(**INNER)
def _is_even(values, i, j, k):
    """Return whether all cells of the block that begins at a node have the same value."""
    nx, ny, nz = values.shape
    first = values[i, j, k]
    for p in range(i, min(i + SIDE + 1, nx)):
        for q in range(j, min(j + SIDE + 1, ny)):
            for r in range(k, min(k + SIDE + 1, nz)):
                if values[p, q, r] != first:
                    return False
    return True


@njit(**FAST)
def survey(values, far, stored, inside):
    """Mark as stored the blocks with a cell that is not +-far everywhere, and as inside those whose first node is."""
    for a, b, c in np.ndindex(stored.shape):
        i, j, k = a * SIDE, b * SIDE, c * SIDE
        inside[a, b, c] = values[i, j, k] < 0
        stored[a, b, c] = abs(values[i, j, k]) < far or not _is_even(values, i, j, k)


@njit(**FAST)
def fill(values, index, pool):
    """Copy dense values to the pool of the stored blocks."""
    nx, ny, nz = values.shape
    for a, b, c in np.ndindex(index.shape):
        block = index[a, b, c]
        if block >= 0:
            i, j, k = a * SIDE, b * SIDE, c * SIDE
            for p in range(min(SIDE, nx - i)):
                for q in range(min(SIDE, ny - j)):
                    for r in range(min(SIDE, nz - k)):
                        pool[block, p, q, r] = values[i + p, j + q, k + r]


@njit(**FAST)
def unpack(field, out):
    """Copy a field's values to a dense array."""
    index, pool, _, far = field
    nx, ny, nz = out.shape
    for i in range(nx):
        for j in range(ny):
            for c in range(index.shape[2]):
                block, k = index[i >> SHIFT, j >> SHIFT, c], c * SIDE
                for r in range(min(SIDE, nz - k)):
                    if block >= 0:
                        out[i, j, k + r] = pool[block, i & WITHIN, j & WITHIN, r]
                    else:
                        out[i, j, k + r] = -far if block & 1 else far


@njit(**FAST)
def crossings(field, places, crossed):
    """Mark the blocks of both nodes of every change of sign between neighbours."""
    _, pool, (nx, ny, nz), _ = field
    for n in range(len(places)):
        a, b, c = places[n]
        for i in range(a * SIDE, min(a * SIDE + SIDE, nx)):
            for j in range(b * SIDE, min(b * SIDE + SIDE, ny)):
                for k in range(c * SIDE, min(c * SIDE + SIDE, nz)):
                    p, q, r = i & WITHIN, j & WITHIN, k & WITHIN
                    here = pool[n, p, q, r] < 0
                    east = pool[n, p + 1, q, r] if p < WITHIN else value_at(field, min(i + 1, nx - 1), j, k)
                    north = pool[n, p, q + 1, r] if q < WITHIN else value_at(field, i, min(j + 1, ny - 1), k)
                    above = pool[n, p, q, r + 1] if r < WITHIN else value_at(field, i, j, min(k + 1, nz - 1))
                    if i + 1 < nx and (east < 0) != here:
                        crossed[a, b, c] = crossed[(i + 1) >> SHIFT, b, c] = True
                    if j + 1 < ny and (north < 0) != here:
                        crossed[a, b, c] = crossed[a, (j + 1) >> SHIFT, c] = True
                    if k + 1 < nz and (above < 0) != here:
                        crossed[a, b, c] = crossed[a, b, (k + 1) >> SHIFT] = True


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


@njit(**FAST)
def move(field, index, pool):
    """Copy a field's values to the pool of another index."""
    old = field[0]
    for a, b, c in np.ndindex(index.shape):
        block, there = index[a, b, c], old[a, b, c]
        if block >= 0 and there >= 0:
            for p, q, r in np.ndindex(SIDE, SIDE, SIDE):  # numba compiles an array's assignment seven times as long
                pool[block, p, q, r] = field[1][there, p, q, r]
        elif block >= 0:
            pool[block] = -field[3] if there & 1 else field[3]
