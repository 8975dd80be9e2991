"""Robust normals of single pixels, in loops over their photos. Numba; the equations are those of `normal_fit`.

Numbers are float32: eight photos at once fit into a register, and no sum has more terms than there are photos.
"""

import math

import numpy as np
from numba import njit

from reconstruct.sdf.kernels import INNER, UNCOUNTED

F = np.float32
ROUNDS = 7  # of reweighting; the accepted residual shrinks from WIDE (or NEAR) to NARROW sigmas meanwhile
WIDE, NEAR, NARROW = 8.0, 3.0, 2.0
INDIRECT_SHARE = 0.3  # one sigma of the light between surfaces, of its estimate
ALBEDO_SIGMA = 0.15  # of the neighbours' albedo: how alike neighbours are
NORMAL_SIGMA = 0.5  # rad: error of a surface's normal that shading has not corrected yet
SURELY_DIRECT = 0.25  # of albedo * irradiance: brighter than any light between surfaces
HIGHLIGHT_PATIENCE = 3.0  # times wider when brighter than expected: shadows are common, highlights are rare
FIRST_LIT_SHARE = 0.5  # of the third-brightest sample: darker ones are left out at first
CAST_SHADOW = 3.0  # -2 log of the odds that something else shadows a pixel facing its light: one in five
TAIL = 16.0  # squared sigmas: largest cost of an unexplained sample
DUST, RIDGE = 1e-6, 1e-4
NOTHING, HALF, ONE = F(0.0), F(0.5), F(1.0)


@njit(forceinline=True, **INNER)
def _length_and_normal(b0, b1, b2):
    length = F(math.sqrt(b0 * b0 + b1 * b1 + b2 * b2))
    size = max(length, F(DUST))
    return length, b0 / size, b1 / size, b2 / size


@njit(forceinline=True, **INNER)
def _unlit(given, rows, sky, bounce, stray, length, up, dark, variance):
    """Fill in each sample's value in shadow and its variance as a lit one.

    Args:
        given: the variance that does not depend on the result. rows: towards times strength, and the strength.
        sky, bounce: ambient irradiance, and that of lit ground. length, up: albedo, and the normal's z.
    """
    below = (ONE - up) * HALF
    for k in range(len(given)):
        dark[k] = length * (sky[k] + bounce[k] * below)
        own, other = stray * length * rows[3, k], F(INDIRECT_SHARE) * dark[k]
        variance[k] = given[k] + own * own + other * other


@njit(forceinline=True, **INNER)
def _solve(m, r):
    """Solve a symmetric 3 x 3 system (00, 01, 02, 11, 12, 22) by its adjugate."""
    c00 = m[3] * m[5] - m[4] * m[4]
    c01 = m[2] * m[4] - m[1] * m[5]
    c02 = m[1] * m[4] - m[2] * m[3]
    c11 = m[0] * m[5] - m[2] * m[2]
    c12 = m[1] * m[2] - m[0] * m[4]
    c22 = m[0] * m[3] - m[1] * m[1]
    one = 1.0 / (m[0] * c00 + m[1] * c01 + m[2] * c02)
    return (
        F((c00 * r[0] + c01 * r[1] + c02 * r[2]) * one),
        F((c01 * r[0] + c11 * r[1] + c12 * r[2]) * one),
        F((c02 * r[0] + c12 * r[1] + c22 * r[2]) * one),
    )


@njit(**INNER)
def _pulled(sums, normal, length, albedo, prior, to_albedo, has_prior):
    """Return the normal equations with the prior's part and a ridge, in double precision, and their right side."""
    m00, m01, m02, m11, m12, m22, r0, r1, r2 = sums
    x, y, z = normal
    if to_albedo:
        stiff = 1 / (ALBEDO_SIGMA * max(albedo, 1e-6)) ** 2
        m00, m01, m02 = m00 + stiff * x * x, m01 + stiff * x * y, m02 + stiff * x * z
        m11, m12, m22 = m11 + stiff * y * y, m12 + stiff * y * z, m22 + stiff * z * z
        stiff *= albedo
        r0, r1, r2 = r0 + stiff * x, r1 + stiff * y, r2 + stiff * z
    if has_prior:
        p, q, s = prior
        stiff = 1 / (NORMAL_SIGMA * max(albedo if to_albedo else length, 1e-6)) ** 2
        m00, m01, m02 = m00 + stiff * (1 - p * p), m01 - stiff * p * q, m02 - stiff * p * s
        m11, m12, m22 = m11 + stiff * (1 - q * q), m12 - stiff * q * s, m22 + stiff * (1 - s * s)
    ridge = RIDGE * max(m00 + m11 + m22, 1e-6)
    return (m00 + ridge, m01, m02, m11 + ridge, m12, m22 + ridge), (r0, r1, r2)


@njit(**INNER)
def _reweighted(pixel, start, prior, rounds, weight, dark, variance):
    """Solve reweighted least squares from first weights; return albedo * normal, and leave the last weights in place.

    Args:
        pixel: value, usable, given variance, rows, sky, bounce, stray (see _unlit).
        start: albedo * normal, the widest accepted residual, sigmas, and whether the prior's albedo attracts.
        prior: its albedo, its normal, and whether there is one.
    """
    value, usable, given, rows, sky, bounce, stray = pixel
    b0, b1, b2, widest, to_albedo = start
    length, x, y, z = _length_and_normal(b0, b1, b2)
    _unlit(given, rows, sky, bounce, stray, length, z, dark, variance)
    for i in range(rounds):
        m00 = m01 = m02 = m11 = m12 = m22 = r0 = r1 = r2 = NOTHING
        for k in range(len(value)):
            u, v, t, w = rows[0, k], rows[1, k], rows[2, k], weight[k] / variance[k]
            wu, wv, wt, off = w * u, w * v, w * t, value[k] - dark[k]
            m00, m01, m02, r0 = m00 + wu * u, m01 + wu * v, m02 + wu * t, r0 + wu * off
            m11, m12, m22, r1, r2 = m11 + wv * v, m12 + wv * t, m22 + wt * t, r1 + wv * off, r2 + wt * off
        sums = (float(m00), float(m01), float(m02), float(m11), float(m12), float(m22), float(r0), float(r1), float(r2))
        b0, b1, b2 = _solve(*_pulled(sums, (x, y, z), length, prior[0], prior[1], to_albedo, prior[2]))
        length, x, y, z = _length_and_normal(b0, b1, b2)
        _unlit(given, rows, sky, bounce, stray, length, z, dark, variance)
        width = F((widest * (NARROW / widest) ** (i / (rounds - 1))) ** 2)
        patient = F(HIGHLIGHT_PATIENCE) * F(HIGHLIGHT_PATIENCE) * width
        for k in range(len(value)):
            direct = rows[0, k] * b0 + rows[1, k] * b1 + rows[2, k] * b2
            excess = value[k] - dark[k] - direct
            wide = patient if excess > NOTHING else width
            share = ONE / (ONE + excess * excess / (wide * variance[k]))
            weight[k] = share * share * usable[k] if direct > NOTHING else NOTHING
    return b0, b1, b2


@njit(forceinline=True, **INNER)
def _bounded(residual):
    patient = residual / F(HIGHLIGHT_PATIENCE) if residual > NOTHING else residual
    squared = patient * patient
    return F(TAIL) * squared / (F(TAIL) + squared)


@njit(**INNER)
def _improbability(pixel, solved, prior, dark, variance):
    """Return -2 log probability of albedo * normal: each sample is lit, in shadow or neither; plus the prior."""
    value, usable, _, rows = pixel[:4]
    b0, b1, b2 = solved
    length, x, y, z = _length_and_normal(b0, b1, b2)
    cost = NOTHING
    for k in range(len(value)):
        sigma = F(math.sqrt(variance[k]))
        direct = max(rows[0, k] * b0 + rows[1, k] * b1 + rows[2, k] * b2, NOTHING)
        above = value[k] - dark[k]
        cost += min(_bounded((above - direct) / sigma), _bounded(above / sigma) + F(CAST_SHADOW)) * usable[k]
    off = math.log(max(length, F(DUST)) / max(prior[0], F(DUST))) / ALBEDO_SIGMA
    total = cost + _bounded(F(-abs(off)))
    if prior[2]:
        p, q, s = prior[1]
        total += (2 - 2 * (x * p + y * q + z * s)) / NORMAL_SIGMA**2
    return total


@njit(**INNER)
def _bright(value, usable, strength, weight):
    """Fill in the first weights of a pixel that nothing else is known of: its bright samples."""
    first = second = third = NOTHING
    for k in range(len(value)):
        ratio = value[k] / max(strength[k], F(1e-12)) if usable[k] > NOTHING else NOTHING
        weight[k] = ratio
        if ratio > first:
            first, second, third = ratio, first, second
        elif ratio > second:
            second, third = ratio, second
        elif ratio > third:
            third = ratio
    least = third if len(value) > 2 else (second if len(value) > 1 else first)
    least = max(least, F(1e-12))
    for k in range(len(value)):
        ratio = weight[k]
        weight[k] = min(ratio / least, ONE) * usable[k] if ratio > F(FIRST_LIT_SHARE) * least else NOTHING


@njit(**INNER)
def _lit_for(pixel, level, guess, weight):
    """Fill in first weights: samples that are lit if the albedo is `level` and the normal `guess`; return their middle.

    The middle is the unit mean of their lights' directions.
    """
    value, usable, _, rows, sky, bounce, _ = pixel
    below = (ONE - guess[2]) * HALF
    x = y = z = NOTHING
    for k in range(len(value)):
        strength = max(rows[3, k], F(1e-12))
        direct = (value[k] - level * (sky[k] + bounce[k] * below)) / (level * strength)
        lit = min(direct, ONE) * usable[k] if direct > F(SURELY_DIRECT) else NOTHING
        weight[k] = lit
        lit /= strength
        x, y, z = x + rows[0, k] * lit, y + rows[1, k] * lit, z + rows[2, k] * lit
    size = max(F(math.sqrt(x * x + y * y + z * z)), F(1e-12))
    return x / size, y / size, z / size


@njit(**INNER)
def _best_start(pixel, prior, has_guess, rounds, weights, scratch):
    """Return albedo * normal of the most probable of three starts, and leave the weights in the first row."""
    dark, variance, own, kept = scratch[0], scratch[1], weights[1], weights[0]
    value, usable, rows, level = pixel[0], pixel[1], pixel[3], prior[0]
    x = y = z = NOTHING
    best, cost = (x, y, z), 0.0
    for number in range(2 + has_guess):
        first, widest = (x, y, z), NEAR
        if number == 0:
            _bright(value, usable, rows[3], own)
            widest = WIDE
        elif number == 1:
            first = _lit_for(pixel, level, first, own)
        else:
            first = prior[1]
            _lit_for(pixel, level, first, own)
        start = (level * first[0], level * first[1], level * first[2], widest, number > 0)
        other = _reweighted(pixel, start, prior, rounds, own, dark, variance)
        other_cost = _improbability(pixel, other, prior, dark, variance)
        if number == 0:
            _, x, y, z = _length_and_normal(other[0], other[1], other[2])
        if number == 0 or other_cost < cost:
            best, cost = other, other_cost
            for k in range(len(value)):
                kept[k] = own[k]
    return best


@njit(**INNER)
def _read(samples, towards, i, rows):
    """Fill in a pixel's rows, see _unlit; return its value, usable, given variance and ambient irradiance."""
    for k in range(towards.shape[1]):
        strength = samples[2, i, k]
        rows[0, k], rows[1, k] = towards[i, k, 0] * strength, towards[i, k, 1] * strength
        rows[2, k], rows[3, k] = towards[i, k, 2] * strength, strength
    return samples[0, i], samples[1, i], samples[3, i], samples[4, i]


@njit(**UNCOUNTED)
def fit_pixels(samples, towards, bounce, stray, albedos, guesses, kind, room, solved, weights, start, stop):
    """Fit albedo * normal of pixels start .. stop - 1 as `normal_fit.fit_normals` does, or `robust_normals`; in place.

    Args:
        samples: (5, pixels, photos): value, usable, strength, given variance, ambient irradiance.
        towards: (pixels, photos, 3). bounce: (photos).
        albedos, guesses: of the prior; guesses 0 where there are none.
        kind: 0: one start from bright samples, without a prior; 1 and 2: the best of two or three starts, the third
            from the guess; from 3, `kind` rounds from the given solution and weights, with a prior for normals.
        room: (8, photos), for what is computed of a pixel.
        solved, weights: (pixels, 3), (pixels, photos): filled in; 0 at first, unless they are given.
    """
    photos = towards.shape[1]
    rows, scratch, own = room[:4], room[4:6], room[6:]
    rounds, widest = (ROUNDS, WIDE) if kind < 3 else (kind, NEAR)
    for i in range(start, stop):
        value, usable, given, sky = _read(samples, towards, i, rows)
        pixel = (value, usable, given, rows, sky, bounce, stray)
        guess = (guesses[i, 0], guesses[i, 1], guesses[i, 2])
        known = kind > 1 and (guess[0] != 0 or guess[1] != 0 or guess[2] != 0)
        prior = (albedos[i], guess, known)
        if 1 <= kind <= 2:
            found = _best_start(pixel, prior, kind - 1, rounds, own, scratch)
        else:
            if kind == 0:
                _bright(value, usable, rows[3], own[0])
            else:
                for k in range(photos):
                    own[0, k] = weights[i, k]
            first = (solved[i, 0], solved[i, 1], solved[i, 2], widest, kind < 0)
            found = _reweighted(pixel, first, prior, rounds, own[0], scratch[0], scratch[1])
        solved[i, 0], solved[i, 1], solved[i, 2] = found
        for k in range(photos):
            weights[i, k] = own[0, k]
