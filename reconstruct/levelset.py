"""The grid as a level set: averaging, bounded steps with curvature flow, redistancing. Numba, voxels."""

import math

from numba import njit

from reconstruct.kernels import FAST


@njit(**FAST)
def smooth(source, target, active, start, stop):
    """One 7-point average of source into target on the active nodes (flat indices away from the box's faces)."""
    _, ny, nz = source.shape
    a, b = source.reshape(-1), target.reshape(-1)
    row = ny * nz
    for r in range(start, stop):
        i = active[r]
        around = a[i - 1] + a[i + 1] + a[i - nz] + a[i + nz] + a[i - row] + a[i + row]
        b[i] = 0.25 * a[i] + 0.125 * around


@njit(**FAST)
def merge(parts, target, active, start, stop):
    """Sum the threads' accumulators into target on the active nodes, in fixed order, and clear them."""
    flat = target.reshape(-1)
    for r in range(start, stop):
        i = active[r]
        value = 0.0
        for part in parts:
            accumulator = part.reshape(-1)
            value += accumulator[i]
            accumulator[i] = 0.0
        flat[i] = value


@njit(**FAST)
def level_set_step(phi, target, g, c, active, setting, start, stop):
    """phi - rate * (g - shrink) / (c + floor + shrink), then curvature flow: the curvature of an SDF is its Laplacian.

    A step is bounded by rate voxels; nodes that no ray touches only feel shrink and curvature.
    """
    rate, shrink, curvature = setting
    _, ny, nz = phi.shape
    a, b, gradient, count = phi.reshape(-1), target.reshape(-1), g.reshape(-1), c.reshape(-1)
    row = ny * nz
    for r in range(start, stop):
        i = active[r]
        value = a[i] - rate * (gradient[i] - shrink) / (count[i] + EVIDENCE_FLOOR + shrink)
        if abs(a[i]) < CURVATURE_BAND:
            around = a[i - 1] + a[i + 1] + a[i - nz] + a[i + nz] + a[i - row] + a[i + row]
            value += curvature * min(max(around - 6 * a[i], -0.5), 0.5)
        b[i] = value


@njit(**FAST)
def laplacian(phi, out, active, start, stop):
    """The Laplacian of phi on the active nodes near the surface, 0 beyond."""
    _, ny, nz = phi.shape
    a, b = phi.reshape(-1), out.reshape(-1)
    row = ny * nz
    for r in range(start, stop):
        i = active[r]
        b[i] = 0.0
        if abs(a[i]) < CURVATURE_BAND:
            b[i] = a[i - 1] + a[i + 1] + a[i - nz] + a[i + nz] + a[i - row] + a[i + row] - 6 * a[i]


@njit(**FAST)
def stiffen(phi, laplacians, c, active, amount, least, start, stop):
    """A step against bending: phi - amount * w * Laplacian(Laplacian phi), w = max(floor / (c + floor), least).

    Between the few rays that touch its hidden side the surface becomes that of a thin plate, not of a soap film. Where
    many rays pass, `least` smooths the noise they leave. Unlike curvature flow this does not shrink what is round: the
    Laplacian of a ball's SDF is 2 / r, and the Laplacian of that is zero.
    """
    _, ny, nz = phi.shape
    a, b, count = phi.reshape(-1), laplacians.reshape(-1), c.reshape(-1)
    row = ny * nz
    for r in range(start, stop):
        i = active[r]
        if abs(a[i]) < CURVATURE_BAND:
            around = b[i - 1] + b[i + 1] + b[i - nz] + b[i + nz] + b[i - row] + b[i + row]
            weight = max(EVIDENCE_FLOOR / (count[i] + EVIDENCE_FLOOR), least)
            a[i] -= amount * weight * (around - 6 * b[i])


EVIDENCE_FLOOR = 0.01  # ray weights per node: below this a node hardly moves
CURVATURE_BAND = 3.0  # voxels


@njit(**FAST)
def interface(phi, band, out, fixed):
    """Start of a redistancing: nodes beside the surface get |phi| / |grad phi| (no terracing), the others the band."""
    nx, ny, nz = phi.shape
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                f = phi[i, j, k]
                fixed[i, j, k] = 0
                out[i, j, k] = band
                if abs(f) > 2.5:
                    continue
                w, e = phi[max(i - 1, 0), j, k], phi[min(i + 1, nx - 1), j, k]
                d, u = phi[i, max(j - 1, 0), k], phi[i, min(j + 1, ny - 1), k]
                b, t = phi[i, j, max(k - 1, 0)], phi[i, j, min(k + 1, nz - 1)]
                if (f < 0) == (w < 0) == (e < 0) == (d < 0) == (u < 0) == (b < 0) == (t < 0):
                    continue
                gx = (e - w) * (0.5 if 0 < i < nx - 1 else 1.0)
                gy = (u - d) * (0.5 if 0 < j < ny - 1 else 1.0)
                gz = (t - b) * (0.5 if 0 < k < nz - 1 else 1.0)
                one_sided = max(abs(f - w), abs(e - f), abs(f - d), abs(u - f), abs(f - b), abs(t - f))
                slope = max(math.sqrt(gx * gx + gy * gy + gz * gz), 0.5 * one_sided, 1e-3)
                out[i, j, k] = min(abs(f) / slope, 1.0)
                fixed[i, j, k] = 1


@njit(**FAST)
def sweep(phi, out, fixed, near, order):
    """One Gauss-Seidel sweep of |grad d| = 1 (fast sweeping, Zhao 2005) over nodes marked near, in one of 8 orders."""
    nx, ny, nz = out.shape
    for a in range(nx):
        i = a if order & 1 else nx - 1 - a
        for b in range(ny):
            j = b if order & 2 else ny - 1 - b
            for c in range(nz):
                k = c if order & 4 else nz - 1 - c
                if near[i, j, k] == 0 or fixed[i, j, k] == 1:
                    continue
                x = min(out[max(i - 1, 0), j, k], out[min(i + 1, nx - 1), j, k])
                y = min(out[i, max(j - 1, 0), k], out[i, min(j + 1, ny - 1), k])
                z = min(out[i, j, max(k - 1, 0)], out[i, j, min(k + 1, nz - 1)])
                lo, hi = min(x, y, z), max(x, y, z)
                mid = x + y + z - lo - hi
                d = lo + 1
                if d > mid:
                    d = 0.5 * (lo + mid + math.sqrt(max(2 - (lo - mid) ** 2, 0.0)))
                    if d > hi:
                        q = (lo + mid + hi) ** 2 - 3 * (lo * lo + mid * mid + hi * hi - 1)
                        d = (lo + mid + hi + math.sqrt(max(q, 0.0))) / 3
                if d < out[i, j, k]:
                    out[i, j, k] = d
