"""Numba kernels that cast many rays through one SDF grid, on all cores with the GIL released.

All quantities are in the grid frame: nodes have integer coordinates, lengths and SDF values are in voxels. The ground
is not in the grid. `reconstruct/torch_sdf/equations.py` computes the same in plain torch and is the reference of the
tests.

Transmittance. With the NeuS opacity [ShadowNeuS eq:neus_alpha] the product of [eq:shadow_ray_render] telescopes over
every run of falling SDF: T = prod_k Phi(s m_k) / Phi(s M_k), where m_k are the local minima along the ray and M_k the
maximum before each. Only the values at those few points need a gradient; by the envelope theorem, their positions do
not.

The argument `phi` is always the tuple of reconstruct/sdf/blocks.py, with overlapping blocks: an index of blocks of
SIDE^3 cells, a pool with the nodes of blocks near the surface, the grid's numbers of nodes, and |SDF| in blocks that
are not stored. Rays skip those. Gradients do not overlap: SIDE^3 nodes per block are used.

UNCOUNTED functions do without numba's counts of references to arrays, at which cores wait for each other. They cannot
make arrays, nor call methods of arrays that do, as max(). INNER functions are called by other kernels alone: no entry
for Python is compiled for them, and a call from Python would end the process.

The kernels are in one file because numba's cache detects changes of a kernel's own file, not of files it calls into,
nor where a named tuple that it takes is defined (CompiledRays): a move of that, too, has to change this file.
"""

import math
from typing import Any

import numpy as np
from numba import njit

FAST: dict[str, Any] = {
    "nogil": True,
    "cache": True,
    "fastmath": True,
    "error_model": "numpy",
    "no_cfunc_wrapper": True,
}
UNCOUNTED: dict[str, Any] = {**FAST, "_nrt": False}
INNER: dict[str, Any] = {**UNCOUNTED, "no_cpython_wrapper": True}
STEP = 0.7  # voxels: no interval between two nodes along an axis is skipped
MAX_MINIMA = 6  # per ray; more would need a ray through six sheets
DARK = -25.0  # log transmittance below which the rest of a ray has no influence
FAR = 1e8  # parameters beyond this mean "never" ...
NEVER = 1e9  # ... such as this
SHIFT = 3  # a node belongs to block (i >> SHIFT, j >> SHIFT, k >> SHIFT)
SIDE = 1 << SHIFT  # nodes: twice as many would store far more than the band, half as many cross more faces
WITHIN = SIDE - 1
REFRACTORY = 12.0  # a minimum with s * m above this absorbs less than 1e-5: not stored


@njit(forceinline=True, **INNER)
def _cell(nodes, x, y, z):
    """Return the cell of a point, clamped to the box, and the position within the cell."""
    x = min(max(x, 0.0), nodes[0] - 1.001)
    y = min(max(y, 0.0), nodes[1] - 1.001)
    z = min(max(z, 0.0), nodes[2] - 1.001)
    i, j, k = int(x), int(y), int(z)
    u, v, w = x - i, y - j, z - k
    return i, j, k, u, v, w


@njit(forceinline=True, **INNER)
def _beyond(block, far):
    """Return the SDF in a block that is not stored: odd numbers are inside."""
    return -far if block & 1 else far


@njit(forceinline=True, **INNER)
def _sample(phi, x, y, z):
    index, pool, nodes, far = phi
    i, j, k, u, v, w = _cell(nodes, x, y, z)
    block = index[i >> SHIFT, j >> SHIFT, k >> SHIFT]
    if block < 0:
        return _beyond(block, far)
    p, q, r = i & WITHIN, j & WITHIN, k & WITHIN
    a = pool[block, p, q, r] * (1 - w) + pool[block, p, q, r + 1] * w
    b = pool[block, p, q + 1, r] * (1 - w) + pool[block, p, q + 1, r + 1] * w
    c = pool[block, p + 1, q, r] * (1 - w) + pool[block, p + 1, q, r + 1] * w
    d = pool[block, p + 1, q + 1, r] * (1 - w) + pool[block, p + 1, q + 1, r + 1] * w
    return (a * (1 - v) + b * v) * (1 - u) + (c * (1 - v) + d * v) * u


@njit(forceinline=True, **INNER)
def _free(phi, x, y, z):
    """Return the distance that a point can move in any direction without reaching a stored block; 0 in one."""
    index, _, nodes, _ = phi
    i, j, k, _, _, _ = _cell(nodes, x, y, z)
    block = index[i >> SHIFT, j >> SHIFT, k >> SHIFT]
    return SIDE * ((-block >> 1) - 1.0) if block < 0 else 0.0


@njit(forceinline=True, **INNER)
def _gradient(phi, x, y, z):
    h = 0.5
    return (
        _sample(phi, x + h, y, z) - _sample(phi, x - h, y, z),
        _sample(phi, x, y + h, z) - _sample(phi, x, y - h, z),
        _sample(phi, x, y, z + h) - _sample(phi, x, y, z - h),
    )


@njit(forceinline=True, **INNER)
def _extended(phi, x, y, z):
    """Return the SDF; beyond the box, the nearest value plus the distance to the box."""
    nodes, f = phi[2], _sample(phi, x, y, z)
    u, v, w = max(-x, x - nodes[0] + 1.0, 0.0), max(-y, y - nodes[1] + 1.0, 0.0), max(-z, z - nodes[2] + 1.0, 0.0)
    return f + math.sqrt(u * u + v * v + w * w)


@njit(**UNCOUNTED)
def gradients(phi, points, h, out, start, stop):
    """Write the SDF's gradient at points to out: central differences over h voxels each way."""
    for r in range(start, stop):
        x, y, z = points[r, 0], points[r, 1], points[r, 2]
        out[r, 0] = (_extended(phi, x + h, y, z) - _extended(phi, x - h, y, z)) / (2 * h)
        out[r, 1] = (_extended(phi, x, y + h, z) - _extended(phi, x, y - h, z)) / (2 * h)
        out[r, 2] = (_extended(phi, x, y, z + h) - _extended(phi, x, y, z - h)) / (2 * h)


@njit(**INNER)
def _scatter(phi, sums, band, x, y, z, amount):
    """Add amount times the trilinear weights, and its absolute value, to the sums of nodes within the band."""
    index, pool, nodes, _ = phi
    i, j, k, u, v, w = _cell(nodes, x, y, z)
    size = abs(amount)
    for di in range(2):
        wi = u if di else 1 - u
        for dj in range(2):
            wj = v if dj else 1 - v
            for dk in range(2):
                block = index[(i + di) >> SHIFT, (j + dj) >> SHIFT, (k + dk) >> SHIFT]
                p, q, r = (i + di) & WITHIN, (j + dj) & WITHIN, (k + dk) & WITHIN
                if block >= 0 and abs(pool[block, p, q, r]) < band:
                    weight = wi * wj * (w if dk else 1 - w)
                    sums[block, p, q, r, 0] += weight * amount
                    sums[block, p, q, r, 1] += weight * size


@njit(forceinline=True, **INNER)
def _clip_axis(o, d, n, near, far):
    if abs(d) < 1e-9:
        if o < 0 or o > n - 1:
            return 1.0, 0.0
        return near, far
    a = -o / d
    b = (n - 1 - o) / d
    return max(near, min(a, b)), min(far, max(a, b))


@njit(**INNER)
def _clip(nodes, ox, oy, oz, dx, dy, dz, near, far):
    """Return the part of a ray inside the box; near > far if there is none."""
    near, far = _clip_axis(ox, dx, nodes[0], near, far)
    near, far = _clip_axis(oy, dy, nodes[1], near, far)
    return _clip_axis(oz, dz, nodes[2], near, far)


@njit(forceinline=True, **INNER)
def _log_phi(x):
    """Return the log of the sigmoid Phi, without overflow for large negative x."""
    if x > 0:
        return -math.log1p(math.exp(-x))
    return x - math.log1p(math.exp(x))


@njit(forceinline=True, **INNER)
def _phi_of(x):
    return 1.0 / (1.0 + math.exp(-x)) if x > -80 else 0.0


@njit(**INNER)
def _refine(phi, ox, oy, oz, dx, dy, dz, ta, fa, tb, fb, tc, fc):
    """Find the minimum near tb with the parabola through three samples; return parameter and value."""
    d1 = (fb - fa) / (tb - ta)
    d2 = (fc - fb) / (tc - tb)
    bend = 2 * (d2 - d1) / (tc - ta)
    if bend > 1e-6:
        slope = (d1 * (tc - tb) + d2 * (tb - ta)) / (tc - ta)
        t = min(max(tb - slope / bend, ta), tc)
        f = _sample(phi, ox + t * dx, oy + t * dy, oz + t * dz)
        if f < fb:
            return t, f
    return tb, fb


@njit(**INNER)
def _extrema(phi, ox, oy, oz, dx, dy, dz, near, far, s, jitter, lows, highs):
    """March one ray, and store the significant minima and the maximum before each.

    Returns: number of minima, log T, parameter and value of the global minimum (1e9 where the ray misses).
    """
    near, far = _clip(phi[2], ox, oy, oz, dx, dy, dz, near, far)
    n, log_t, best_t, best_f = 0, 0.0, 0.0, 1e9
    if near >= far:
        return n, log_t, best_t, best_f
    band = 5.0 / s + 1.0
    tb, tc = near, near
    fb = _sample(phi, ox + tb * dx, oy + tb * dy, oz + tb * dz)
    fc, ta, fa = fb, tb, fb
    best_t, best_f = tb, fb
    top_t, top_f = tb, fb
    falling = False
    first = True
    while tb < far:
        size = abs(fb)
        step = STEP if size < band else max(STEP, 0.95 * (size - band))
        if first:
            step *= jitter
            first = False
        elif size >= phi[3]:  # the SDF is constant there: the same steps, without sampling it
            leap = min(tb + _free(phi, ox + tb * dx, oy + tb * dy, oz + tb * dz), far)
            while tb + step < leap:
                tb += step
        tc = min(tb + step, far)
        fc = _sample(phi, ox + tc * dx, oy + tc * dy, oz + tc * dz)
        if fc < fb:
            if not falling:
                top_t, top_f, falling = tb, fb, True
            if tc >= far:  # still falling where the ray ends
                ta, fa, tb, fb = tb, fb, tc, fc
                tm, fm = tb, fb
            else:
                ta, fa, tb, fb = tb, fb, tc, fc
                continue
        elif falling:
            tm, fm = _refine(phi, ox, oy, oz, dx, dy, dz, ta, fa, tb, fb, tc, fc)
        else:
            ta, fa, tb, fb = tb, fb, tc, fc
            continue
        falling = False
        if fm < best_f:
            best_t, best_f = tm, fm
        if s * fm < REFRACTORY and n < MAX_MINIMA:
            lows[n, 0], lows[n, 1], highs[n, 0], highs[n, 1] = tm, fm, top_t, top_f
            n += 1
            log_t += _log_phi(s * fm) - _log_phi(s * top_f)
            if log_t < DARK:
                break
        ta, fa, tb, fb = tb, fb, tc, fc
    return n, log_t, best_t, best_f


@njit(forceinline=True, **INNER)
def _stride(f, half):
    """Return a camera ray's step where the SDF is f: up to the pixel's footprint of +- half, and short within it."""
    size = abs(f)
    return STEP if size < 2.0 + half else max(STEP, 0.95 * (size - 1.0 - half))


@njit(**INNER)
def _first_surface(phi, ox, oy, oz, dx, dy, dz, near, far, width):
    """Find the first full hit and the first partial one (a silhouette narrower than the pixel) of a camera ray.

    Args:
        width: pixel footprint per unit of t, voxels: the pixel spans +- width * t / 2 about the ray.

    Returns: t of the full hit (1e9 if none), t and value of the partial minimum before it (t = -1 if none).
    """
    near, far = _clip(phi[2], ox, oy, oz, dx, dy, dz, near, far)
    part_t, part_f = -1.0, 0.0
    if near >= far:
        return 1e9, part_t, part_f
    ta, tb = near, near
    fb = _sample(phi, ox + tb * dx, oy + tb * dy, oz + tb * dz)
    fa = fb
    cross = near if fb < 0 else -1.0
    while True:
        half = 0.5 * width * tb
        if cross >= 0 and fb < -half:
            return cross, part_t, part_f
        if tb >= far:
            break
        if fb >= phi[3]:  # the SDF is constant there: the same steps, without sampling it
            leap = min(tb + _free(phi, ox + tb * dx, oy + tb * dy, oz + tb * dz), far)
            while tb + _stride(fb, 0.5 * width * tb) < leap:
                tb += _stride(fb, 0.5 * width * tb)
            half = 0.5 * width * tb
        tc = min(tb + _stride(fb, half), far)
        fc = _sample(phi, ox + tc * dx, oy + tc * dy, oz + tc * dz)
        if fb >= 0 and fc < 0:
            cross = _root(phi, ox, oy, oz, dx, dy, dz, tb, fb, tc, fc)
        if fb <= fa and fb < fc and fb < half + 0.5:
            tm, fm = _refine(phi, ox, oy, oz, dx, dy, dz, ta, fa, tb, fb, tc, fc)
            if fm < -half:
                if cross < 0:
                    cross = tm
                return cross, part_t, part_f
            if fm < half and part_t < 0:
                part_t, part_f = tm, fm
            cross = -1.0
        ta, fa, tb, fb = tb, fb, tc, fc
    if cross >= 0:  # still inside where the ray meets the ground
        return cross, part_t, part_f
    return 1e9, part_t, part_f


@njit(**INNER)
def _root(phi, ox, oy, oz, dx, dy, dz, ta, fa, tb, fb):
    """Find the sign change between ta (outside) and tb (inside) by three steps of regula falsi with bisection."""
    t = ta
    for step in range(4):
        t = ta + (tb - ta) * fa / (fa - fb) if step < 3 else 0.5 * (ta + tb)
        f = _sample(phi, ox + t * dx, oy + t * dy, oz + t * dz)
        if abs(f) < 1e-3:
            return t
        if f > 0:
            ta, fa = t, f
        else:
            tb, fb = t, f
    return ta + (tb - ta) * fa / (fa - fb)


@njit(**FAST)
def transmittances(phi, points, lights, sharpness, out, start, stop):
    """Write the transmittance from each point to its homogeneous light to out. Grid frame, sharpness per voxel."""
    lows, highs = np.empty((MAX_MINIMA, 2)), np.empty((MAX_MINIMA, 2))
    for r in range(start, stop):
        x, y, z = points[r, 0], points[r, 1], points[r, 2]
        dx, dy, dz, far = _towards(lights, r, x, y, z)
        _, log_t, _, _ = _extrema(phi, x, y, z, dx, dy, dz, 0.0, far, sharpness, 1.0, lows, highs)
        out[r] = math.exp(log_t)


@njit(forceinline=True, **INNER)
def _towards(lights, k, x, y, z):
    """Return the unit direction from a point to a homogeneous light, and the distance (1e9 if directional)."""
    w = lights[k, 3]
    dx, dy, dz = lights[k, 0] - w * x, lights[k, 1] - w * y, lights[k, 2] - w * z
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    return dx / length, dy / length, dz / length, (length if w > 0 else 1e9)


@njit(**UNCOUNTED)
def first_surfaces(phi, origins, directions, far, width, hit, part_t, part_f, start, stop):
    """Find where rays meet the surface: hit (1e9 if nowhere up to far), and the partial minimum before. Grid frame."""
    for r in range(start, stop):
        x, y, z = origins[r, 0], origins[r, 1], origins[r, 2]
        dx, dy, dz = directions[r, 0], directions[r, 1], directions[r, 2]
        hit[r], part_t[r], part_f[r] = _first_surface(phi, x, y, z, dx, dy, dz, 0.0, far[r], width)


EDGE, GROUND, OBJECT = 0, 1, 2  # content of a pixel: both or unknown, surely ground, surely object
GRAZING = 0.15  # cosine below which the intersection's derivative along the ray is too large
LEAST_SLOPE = 1e-6  # of the loss by the SDF at a point: less is not spread over the nodes
MAX_START = 2.0  # bound of the start-point gradient, voxels
WRONG = 0.5  # |T - label| above which a ray contradicts its label
PATIENCE = 6.0  # contradictions after which a ray's weight is halved
NO_WEIGHT = 1e-3  # rays of less weight are not cast
TURNS = 16  # sets of random numbers per iteration
JITTER, MASK_JITTER = 9, 12  # which of them: first steps of shadow rays, and of camera rays


@njit(**UNCOUNTED)
def samples(phi, points, out, start, stop):
    """Write the SDF at points to out."""
    for r in range(start, stop):
        out[r] = _sample(phi, points[r, 0], points[r, 1], points[r, 2])


@njit(**UNCOUNTED)
def scatter(phi, sums, band, points, amounts, start, stop):
    """Spread each amount over the nodes around its point: the adjoint of `samples`."""
    for r in range(start, stop):
        _scatter(phi, sums, band, points[r, 0], points[r, 1], points[r, 2], amounts[r])


@njit(**UNCOUNTED)
def march(phi, origins, lights, far, s, jitter, rays, found, start, stop):
    """March rays to their homogeneous lights, or as far as `far`, and keep their extrema.

    Args:
        rays: filled with direction and length; found: with the number of minima, log T, parameter and value of the
            least SDF, and rows of (t, value) of the minima and of the maxima before them.
    """
    count, log_t, best, lows, highs = found
    for r in range(start, stop):
        x, y, z = origins[r, 0], origins[r, 1], origins[r, 2]
        dx, dy, dz, length = _towards(lights, r, x, y, z)
        rays[r, 0], rays[r, 1], rays[r, 2], rays[r, 3] = dx, dy, dz, length
        count[r], log_t[r], best[r, 0], best[r, 1] = _extrema(
            phi, x, y, z, dx, dy, dz, 0.0, min(length, far[r]), s, jitter[r], lows[r], highs[r]
        )


@njit(**INNER)
def _scatter_extremum(phi, sums, band, origin, ray, t, part, back):
    """Scatter the slope `part` at one point of a ray, and add what moves the ray's start to back."""
    x, y, z = origin[0] + t * ray[0], origin[1] + t * ray[1], origin[2] + t * ray[2]
    _scatter(phi, sums, band, x, y, z, part)
    gx, gy, gz = _gradient(phi, x, y, z)
    rest = 1 - t / ray[3] if ray[3] < FAR else 1.0  # this point's shift if the start moves by 1
    back[0] += part * gx * rest
    back[1] += part * gy * rest
    back[2] += part * gz * rest


@njit(**UNCOUNTED)
def scatter_march(phi, sums, band, s, of_log, of_least, origins, rays, found, back, start, stop):
    """Scatter the gradient of marched rays, given d loss / d log T and, of rays without minima, d loss / d least SDF.

    back gets the gradient by a ray's start.
    """
    count, _, best, lows, highs = found
    for r in range(start, stop):
        for a in range(3):
            back[r, a] = 0.0
        if count[r] == 0 and of_least[r] != 0:
            _scatter_extremum(phi, sums, band, origins[r], rays[r], best[r, 0], of_least[r], back[r])
        for m in range(count[r]):
            low = of_log[r] * s * _phi_of(-s * lows[r, m, 1])
            if not abs(low) < LEAST_SLOPE:
                _scatter_extremum(phi, sums, band, origins[r], rays[r], lows[r, m, 0], low, back[r])
            high = -of_log[r] * s * _phi_of(-s * highs[r, m, 1])
            if highs[r, m, 0] > 0 and not abs(high) < LEAST_SLOPE:
                _scatter_extremum(phi, sums, band, origins[r], rays[r], highs[r, m, 0], high, back[r])
