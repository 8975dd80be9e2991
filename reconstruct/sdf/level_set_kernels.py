"""Redistancing of a level set. Numba, voxels, on Blocks; pools are those of reconstruct/sdf/blocks.py."""

import math

import numpy as np
from numba import njit

from reconstruct.sdf.block_kernels import eikonal, value_at
from reconstruct.sdf.kernels import FAST, INNER, SHIFT, SIDE, WITHIN

LEAST_STEP = 0.57  # voxels: a node's distance exceeds its nearest neighbour's by at least 1 / sqrt(3)
BESIDE = 2.5  # voxels: beyond this a node has no neighbour on the other side


@njit(**FAST)
def interface(field, places, band, out, fixed, start, stop):
    """Initialise a redistancing: nodes beside the surface get |phi| / |grad phi| (no terracing), all others the band.

    Nodes of a block that lie beyond the grid are fixed at the band.
    """
    nx, ny, nz = field[2]
    for block in range(start, stop):
        for p, q, r in np.ndindex(SIDE, SIDE, SIDE):
            i, j, k = places[block, 0] * SIDE + p, places[block, 1] * SIDE + q, places[block, 2] * SIDE + r
            out[block, p, q, r] = band
            fixed[block, p, q, r] = i >= nx or j >= ny or k >= nz
            f = field[1][block, p, q, r]
            if fixed[block, p, q, r] or abs(f) > BESIDE:
                continue
            w, e = value_at(field, max(i - 1, 0), j, k), value_at(field, min(i + 1, nx - 1), j, k)
            d, u = value_at(field, i, max(j - 1, 0), k), value_at(field, i, min(j + 1, ny - 1), k)
            b, t = value_at(field, i, j, max(k - 1, 0)), value_at(field, i, j, min(k + 1, nz - 1))
            if (f < 0) == (w < 0) == (e < 0) == (d < 0) == (u < 0) == (b < 0) == (t < 0):
                continue
            gx = (e - w) * (0.5 if 0 < i < nx - 1 else 1.0)
            gy = (u - d) * (0.5 if 0 < j < ny - 1 else 1.0)
            gz = (t - b) * (0.5 if 0 < k < nz - 1 else 1.0)
            one_sided = max(abs(f - w), abs(e - f), abs(f - d), abs(u - f), abs(f - b), abs(t - f))
            slope = max(math.sqrt(gx * gx + gy * gy + gz * gz), 0.5 * one_sided, 1e-3)
            out[block, p, q, r] = min(abs(f) / slope, 1.0)
            fixed[block, p, q, r] = 1


@njit(**INNER)
def _surrounded(index, out, nodes, band, a, b, c, local):
    """Copy a block of distances and the nodes beside its six faces to `local`, its own nodes at 1 ... SIDE.

    Return the least of them. Loops here and in `sweep` compile in a fraction of the time that slices take.
    """
    i, j, k = a * SIDE - 1, b * SIDE - 1, c * SIDE - 1
    own = index[a, b, c]
    least = band
    for p in range(SIDE + 2):
        for q in range(SIDE + 2):
            for r in range(SIDE + 2):
                beyond = (p % (SIDE + 1) == 0) + (q % (SIDE + 1) == 0) + (r % (SIDE + 1) == 0)
                if beyond > 1:  # edges and corners: never read
                    continue
                if beyond == 0:
                    value = out[own, p - 1, q - 1, r - 1]
                else:
                    value = _distance(index, out, nodes, band, i + p, j + q, k + r)
                local[p, q, r] = value
                least = min(least, value)
    return least


@njit(forceinline=True, **INNER)
def _distance(index, out, nodes, band, i, j, k):
    """Return the current distance at a node; the band where none is stored, and beyond the grid."""
    if i < 0 or j < 0 or k < 0 or i >= nodes[0] or j >= nodes[1] or k >= nodes[2]:
        return band
    block = index[i >> SHIFT, j >> SHIFT, k >> SHIFT]
    return out[block, i & WITHIN, j & WITHIN, k & WITHIN] if block >= 0 else band


@njit(**FAST)
def sweep(index, out, nodes, fixed, band, order):
    """Do one Gauss-Seidel sweep of |grad d| = 1 (fast sweeping, Zhao 2005) over the stored nodes, in one of 8 orders.

    It runs block by block. Every node still comes after all nodes before it in the order, so this equals a sweep over
    all nodes.
    """
    local = np.full((SIDE + 2, SIDE + 2, SIDE + 2), band, np.float32)
    nx, ny, nz = index.shape
    for i in range(nx):
        a = i if order & 1 else nx - 1 - i
        for j in range(ny):
            b = j if order & 2 else ny - 1 - j
            for k in range(nz):
                c = k if order & 4 else nz - 1 - k
                own = index[a, b, c]
                if own >= 0 and _surrounded(index, out, nodes, band, a, b, c, local) < band:
                    _sweep_block(local, fixed, own, order)
                    for p, q, r in np.ndindex(SIDE, SIDE, SIDE):
                        out[own, p, q, r] = local[p + 1, q + 1, r + 1]


@njit(**INNER)
def _sweep_block(out, fixed, own, order):
    for a in range(SIDE):
        i = a + 1 if order & 1 else SIDE - a
        for b in range(SIDE):
            j = b + 1 if order & 2 else SIDE - b
            for c in range(SIDE):
                k = c + 1 if order & 4 else SIDE - c
                if fixed[own, i - 1, j - 1, k - 1] == 1:
                    continue
                x = min(out[i - 1, j, k], out[i + 1, j, k])
                y = min(out[i, j - 1, k], out[i, j + 1, k])
                z = min(out[i, j, k - 1], out[i, j, k + 1])
                if min(x, y, z) + LEAST_STEP > out[i, j, k]:
                    continue
                d = eikonal(x, y, z, 1.0)
                if d < out[i, j, k]:
                    out[i, j, k] = d
