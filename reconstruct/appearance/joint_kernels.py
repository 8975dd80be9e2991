"""Normals and albedos of single pixels under known lobes, each by its own damped Gauss-Newton steps. Numba.

The equations are those of `reconstruct.appearance.joint_fit.fit_normals`, with the slopes of the highlights in closed
form. A pixel's steps end when it rests; lobes of no weight are not computed.
"""

import math

import numpy as np
from numba import njit

from reconstruct.appearance.brdf import GRAZING
from reconstruct.sdf.kernels import FAST, INNER

MODEL_SHARE, STRAY_SHARE = 0.03, 0.02  # one sigma: of the value, and of the pixel's brightest prediction
WIDTH, HIGHLIGHT_PATIENCE = 2.5, 1.5  # sigmas that an outlier is off (Geman-McClure); times wider above the prediction
RIDGE, MOST_TURNED = 1e-3, 0.3  # beside the damped diagonal; rad: the largest turn in a step
FIRST_DAMPING, EASED, DAMPED = 1e-2, 0.3, 5.0  # Levenberg-Marquardt: at first, times after a good and after a bad step
AT_REST = 1e-4  # rad, and of the albedo: smaller steps are the last
DUST = 1e-5


@njit(**INNER)
def _predict(normal, albedo, towards, light, eye, lobes, out):
    """Fill in each photo's prediction, its gradient by the normal, and its slope by log albedo; return the brightest.

    Args:
        light: (photos, 2): irradiance of a surface that faces the light, and from elsewhere; means of RGB.
        lobes: (lobes, 3): sharpness, coefficient, and its Fresnel part at grazing light; means of RGB.
        out: (photos, 5).
    """
    x, y, z = normal
    facing_eye = x * eye[0] + y * eye[1] + z * eye[2]
    brightest = 0.0
    for k in range(len(towards)):
        lx, ly, lz = towards[k, 0], towards[k, 1], towards[k, 2]
        strength, indirect = light[k, 0], light[k, 1]
        facing = x * lx + y * ly + z * lz
        if facing <= 0:
            out[k, 0], out[k, 4] = albedo * indirect, albedo * indirect
            out[k, 1], out[k, 2], out[k, 3] = 0.0, 0.0, 0.0
            brightest = max(brightest, out[k, 0])
            continue
        arriving = facing * strength + indirect
        hx, hy, hz = lx + eye[0], ly + eye[1], lz + eye[2]
        length = max(math.sqrt(hx * hx + hy * hy + hz * hz), 1e-12)
        hx, hy, hz = hx / length, hy / length, hz / length
        off, along = x * hx + y * hy + z * hz - 1, min(max(lx * hx + ly * hy + lz * hz, GRAZING), 1.0)
        steepest = max(max(facing, facing_eye), GRAZING)
        grazing = (1 - along) ** 5
        total, slope = 0.0, 0.0
        for j in range(len(lobes)):
            value = math.exp(lobes[j, 0] * off) * (lobes[j, 1] + lobes[j, 2] * grazing)
            total += value
            slope += lobes[j, 0] * value
        factor = 1 / (along * steepest)
        mirrored = factor * total
        by_light, by_eye = albedo + mirrored, 0.0
        if steepest > GRAZING:
            if facing >= facing_eye:
                by_light -= facing * mirrored / steepest
            else:
                by_eye = -facing * mirrored / steepest
        by_half = facing * factor * slope
        out[k, 0] = albedo * arriving + mirrored * facing * strength
        out[k, 1] = strength * (by_light * lx + by_eye * eye[0] + by_half * hx)
        out[k, 2] = strength * (by_light * ly + by_eye * eye[1] + by_half * hy)
        out[k, 3] = strength * (by_light * lz + by_eye * eye[2] + by_half * hz)
        out[k, 4] = albedo * arriving
        brightest = max(brightest, out[k, 0])
    return brightest


@njit(**INNER)
def _judge(seen, expected, brightest, weight):
    """Fill in the weight of each sample, over its variance, and return the pixel's cost.

    Args:
        seen: (photos, 3): value, noise (one sigma), and whether it is usable.
    """
    cost = 0.0
    for k in range(len(seen)):
        value, noise = seen[k, 0], seen[k, 1]
        if seen[k, 2] <= 0:
            weight[k] = 0.0
            continue
        width = WIDTH * HIGHLIGHT_PATIENCE if value > expected[k, 0] else WIDTH
        variance = noise * noise + (MODEL_SHARE * value) ** 2 + (STRAY_SHARE * brightest) ** 2
        off = (value - expected[k, 0]) ** 2 / (variance * width * width)
        weight[k] = 1 / (variance * (1 + off) ** 2)
        cost += width * width * off / (1 + off)
    return cost


@njit(**INNER)
def _axes(x, y, z):
    """Return two unit vectors across a unit vector."""
    if abs(x) <= abs(y) and abs(x) <= abs(z):
        size = math.sqrt(y * y + z * z)
        a, b, c = 0.0, -z / size, y / size
    elif abs(y) <= abs(z):
        size = math.sqrt(x * x + z * z)
        a, b, c = z / size, 0.0, -x / size
    else:
        size = math.sqrt(x * x + y * y)
        a, b, c = -y / size, x / size, 0.0
    return a, b, c, y * c - z * b, z * a - x * c, x * b - y * a


@njit(**INNER)
def _move(seen, expected, weight, axes, damping):
    """Return the damped Gauss-Newton step: two angles and log albedo."""
    m00 = m01 = m02 = m11 = m12 = m22 = r0 = r1 = r2 = 0.0
    for k in range(len(seen)):
        w = weight[k]
        if w <= 0:
            continue
        gx, gy, gz, c = expected[k, 1], expected[k, 2], expected[k, 3], expected[k, 4]
        a = gx * axes[0] + gy * axes[1] + gz * axes[2]
        b = gx * axes[3] + gy * axes[4] + gz * axes[5]
        error = w * (seen[k, 0] - expected[k, 0])
        m00, m01, m02 = m00 + w * a * a, m01 + w * a * b, m02 + w * a * c
        m11, m12, m22 = m11 + w * b * b, m12 + w * b * c, m22 + w * c * c
        r0, r1, r2 = r0 + a * error, r1 + b * error, r2 + c * error
    m00, m11, m22 = (m00 + damping * (m00 + RIDGE), m11 + damping * (m11 + RIDGE), m22 + damping * (m22 + RIDGE))
    root0 = math.sqrt(m00)
    l10, l20 = m01 / root0, m02 / root0
    root1 = math.sqrt(max(m11 - l10 * l10, 1e-12 * m11))
    l21 = (m12 - l10 * l20) / root1
    root2 = math.sqrt(max(m22 - l20 * l20 - l21 * l21, 1e-12 * m22))
    y0 = r0 / root0
    y1 = (r1 - l10 * y0) / root1
    y2 = (r2 - l20 * y0 - l21 * y1) / root2
    c = y2 / root2
    b = (y1 - l21 * c) / root1
    return (y0 - l10 * b - l20 * c) / root0, b, c


@njit(**FAST)
def fit_pixels(seen, light, towards, eye, lobes, steps, normals, albedos, costs, start, stop):
    """Fit normals and albedos of pixels start .. stop - 1, in place; fill in their costs.

    Args:
        seen: (pixels, photos, 3): value, noise (one sigma), weight 0 or 1. light: (pixels, photos, 2), see _predict.
        towards: (pixels, photos, 3), unit, world; eye: (pixels, 3). lobes: see _predict. steps: at most.
        normals: (pixels, 3), unit, world, to begin from. albedos: grey, to begin from.
    """
    photos = seen.shape[1]
    now, other = np.empty((photos, 5)), np.empty((photos, 5))
    weight, other_weight = np.empty(photos), np.empty(photos)
    for i in range(start, stop):
        x, y, z = normals[i, 0], normals[i, 1], normals[i, 2]
        albedo, damping = albedos[i], FIRST_DAMPING
        brightest = _predict((x, y, z), albedo, towards[i], light[i], eye[i], lobes, now)
        cost = _judge(seen[i], now, brightest, weight)
        for _ in range(steps):
            axes = _axes(x, y, z)
            a, b, c = _move(seen[i], now, weight, axes, damping)
            a, b = min(max(a, -MOST_TURNED), MOST_TURNED), min(max(b, -MOST_TURNED), MOST_TURNED)
            c = min(max(c, -MOST_TURNED), MOST_TURNED)
            p, q, r = x + a * axes[0] + b * axes[3], y + a * axes[1] + b * axes[4], z + a * axes[2] + b * axes[5]
            length = math.sqrt(p * p + q * q + r * r)
            p, q, r, scaled = p / length, q / length, r / length, max(albedo * math.exp(c), DUST)
            brightest = _predict((p, q, r), scaled, towards[i], light[i], eye[i], lobes, other)
            other_cost = _judge(seen[i], other, brightest, other_weight)
            if other_cost < cost:
                x, y, z, albedo, cost = p, q, r, scaled, other_cost
                now, other, weight, other_weight = other, now, other_weight, weight
                damping *= EASED
            else:
                damping *= DAMPED
            if max(abs(a), abs(b), abs(c)) < AT_REST:
                break
        normals[i, 0], normals[i, 1], normals[i, 2] = x, y, z
        albedos[i], costs[i] = albedo, cost
