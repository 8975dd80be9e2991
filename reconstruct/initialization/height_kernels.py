"""Shadow rays over a height field. Numba.

Everything here is in the frame of a `reconstruct.initialization.height_view.HeightView`: pixels of its padded grid,
heights in pixels of inverse depth. In this frame a light ray is a straight line over a straight line of pixels. A pixel
is lit iff its margin is positive: the smallest distance by which the ray clears the matter. Only the two ends of that
distance have a gradient. Matter extends from the heights down to the undersides: a ray passes above or beneath it.
"""

import math

from numba import njit

from reconstruct.sdf.kernels import INNER, UNCOUNTED

TILE = 8  # pixels: side of the squares whose highest point lets a ray skip them
FIRST = 1.0  # px from the start to the first sample: nearer, the field is the pixel itself
FLATTEST, STEEPEST = 0.05, 2.0  # rise per pixel between which a ray's margin is measured along the field, not above it
THINNEST = 1.0  # px of height: matter that is seen is there
CLEAR = 8.0  # over the sharpness: margins beyond this give a gradient below 4e-4 and are not looked for


@njit(**UNCOUNTED)
def tile_tops(heights, tops):
    """Fill in the highest point of every tile, including the next row and column, which its last cells touch."""
    rows, columns = tops.shape
    for i in range(rows):
        for j in range(columns):
            top = -1e30
            for a in range(i * TILE, min(i * TILE + TILE + 1, heights.shape[0])):
                for b in range(j * TILE, min(j * TILE + TILE + 1, heights.shape[1])):
                    top = max(top, heights[a, b])
            tops[i, j] = top


@njit(**INNER)
def _highest(tops):
    """As tops.max(), which UNCOUNTED functions cannot call."""
    highest = tops[0, 0]
    for top in tops.flat:
        highest = max(highest, top)
    return highest


@njit(forceinline=True, **INNER)
def _at(field, x, y):
    i, j = int(y), int(x)
    u, v = y - i, x - j
    upper = field[i, j] * (1 - v) + field[i, j + 1] * v
    lower = field[i + 1, j] * (1 - v) + field[i + 1, j + 1] * v
    return upper * (1 - u) + lower * u


@njit(forceinline=True, **INNER)
def _steps_to_edge(x, dx, low, high):
    """Return the number of steps along dx until x leaves [low, high]."""
    if dx > 1e-12:
        return (high - x) / dx
    if dx < -1e-12:
        return (low - x) / dx
    return 1e9


@njit(forceinline=True, **INNER)
def _clearance(heights, undersides, ray, x, y):
    """Return the larger of a ray's clearances above and beneath the matter at a point, and whether it is beneath."""
    top = _at(heights, x, y)
    above = ray - top
    if above >= 0:
        return above, False
    beneath = min(_at(undersides, x, y), top - THINNEST) - ray
    return max(above, beneath), beneath > above


@njit(**INNER)
def _margin(heights, undersides, tops, summit, x0, y0, start, along_x, along_y, rise, last, limit):
    """Find a ray's smallest clearance, its step, and whether it is beneath; (limit, -1) if none is below limit.

    Args:
        summit: the highest point of all; start: height at (x0, y0); rise: of the ray per step; last: step at the light.
    """
    rows, columns = heights.shape
    last = min(last, _steps_to_edge(x0, along_x, 0.0, columns - 1.001))
    last = min(last, _steps_to_edge(y0, along_y, 0.0, rows - 1.001))
    best, place, is_beneath, step = limit, -1.0, False, FIRST
    while step <= last:
        ray = start + rise * step
        if rise > 0 and ray - summit >= best:
            break
        x, y = x0 + step * along_x, y0 + step * along_y
        i, j = int(y) // TILE, int(x) // TILE
        inside = min(
            _steps_to_edge(x, along_x, j * TILE, (j + 1) * TILE), _steps_to_edge(y, along_y, i * TILE, (i + 1) * TILE)
        )
        inside = max(inside, 0.0)
        if min(ray, ray + rise * inside) - tops[i, j] >= best:
            step += math.floor(inside) + 1.0
            continue
        end = min(step + inside, last)
        while step <= end:
            x, y = x0 + step * along_x, y0 + step * along_y
            margin, beneath = _clearance(heights, undersides, start + rise * step, x, y)
            if margin < best:
                best, place, is_beneath = margin, step, beneath
            step += 1.0
    return best, place, is_beneath


@njit(**INNER)
def _add(gradient, x, y, amount):
    """Add amount times the bilinear weights to the gradient."""
    i, j = int(y), int(x)
    u, v = y - i, x - j
    gradient[i, j] += amount * (1 - u) * (1 - v)
    gradient[i, j + 1] += amount * (1 - u) * v
    gradient[i + 1, j] += amount * u * (1 - v)
    gradient[i + 1, j + 1] += amount * u * v


@njit(**UNCOUNTED)
def height_pass(field, labels, lights, frame, setting, for_heights, for_undersides, start, stop):
    """Cast shadow rays of the pixels in rows start .. stop - 1: error, and its gradient on both sides of the matter.

    With the margin m in pixels along the field, C = Phi(s m) and label y, the gradient of a ray is C - y at its start
    and the opposite at its closest approach. A lit ray deep in the matter probably passes a structure that a height
    field cannot represent, such as a gap behind a gap: its gradient falls with (1 + |m| / gamma)^-2.

    Args:
        field: heights, undersides, tops of the heights' tiles. labels: visibility, confidence (photos, rows, columns).
        lights: homogeneous, camera axes. frame: focal, reference depth, centre x, y of the picture, padding. px, world.
        setting: sharpness s per px, gamma in px.

    Returns: sum of confidence * |C - y|, and the sum of confidences.
    """
    heights = field[0]
    visibility, confidence = labels
    pad = frame[4]
    sharpness, gamma = setting
    summit = _highest(field[2])
    total, weights = 0.0, 0.0
    for i in range(start, stop):
        for j in range(visibility.shape[2]):
            here = heights[i + pad, j + pad]
            for k in range(len(lights)):
                weight = confidence[k, i, j]
                if weight <= 0:
                    continue
                margin, place, x, y, share, beneath = _ray(field, summit, i, j, here, lights[k], frame, sharpness)
                target = visibility[k, i, j]
                seen = 1 / (1 + math.exp(-sharpness * margin))
                total += weight * abs(seen - target)
                weights += weight
                if place < 0:
                    continue
                amount = weight * (seen - target)
                if margin < 0:
                    amount *= 1 - target + target / (1 - margin / gamma) ** 2
                if beneath:
                    for_heights[i + pad, j + pad] -= amount * share
                    _add(for_undersides, x, y, amount)
                else:
                    for_heights[i + pad, j + pad] += amount * share
                    _add(for_heights, x, y, -amount)
    return total, weights


@njit(forceinline=True, **INNER)
def _ray_slopes(i, j, here, light, frame):
    """Return a ray's direction over the field, rise per step, the step at the light, and |D| (see _ray)."""
    focal, reference, centre_x, centre_y, _ = frame
    towards_x, towards_y = focal * light[0] - (j - centre_x) * light[2], focal * light[1] - (i - centre_y) * light[2]
    length = max(math.sqrt(towards_x * towards_x + towards_y * towards_y), 1e-9)
    rise = (light[3] * focal * reference - light[2] * (focal + here)) / length
    last = length / light[2] if light[3] > 0 and light[2] > 0 else 1e9
    return towards_x / length, towards_y / length, rise, last, length


@njit(**UNCOUNTED)
def _ray(field, summit, i, j, here, light, frame, sharpness):
    """Trace a pixel's ray to a light: margin (px along the field), its step (-1: clear), place, d margin/d start, side.

    The ray runs over the pixels along D = focal * (Lx, Ly) - (p - centre) * Lz; per pixel it rises by
    (w * focal * reference - Lz * (focal + H)) / |D|, for a homogeneous light (Lx, Ly, Lz, w).
    """
    heights, undersides, tops = field
    pad = frame[4]
    along_x, along_y, rise, last, length = _ray_slopes(i, j, here, light, frame)
    scale = min(max(abs(rise), FLATTEST), STEEPEST)
    x, y = float(j + pad), float(i + pad)
    margin, place, beneath = _margin(
        heights, undersides, tops, summit, x, y, here, along_x, along_y, rise, last, CLEAR * scale / sharpness
    )
    x, y = x + place * along_x, y + place * along_y
    return margin / scale, place, x, y, 1 - light[2] * place / length, beneath


@njit(**UNCOUNTED)
def passing_heights(field, labels, lights, frame, lowest, start, stop):
    """Raise `lowest` to the highest light ray that passes beneath the matter at each pixel: below it must be empty.

    Args:
        field, labels, lights, frame: as in height_pass, of the rays from rows start .. stop - 1.
        lowest: filled beforehand with a height below everything; raised in place.
    """
    heights, pad = field[0], frame[4]
    summit = _highest(field[2])
    for i in range(start, stop):
        for j in range(labels[0].shape[2]):
            here = heights[i + pad, j + pad]
            for k in range(len(lights)):
                if labels[1][k, i, j] <= 0 or labels[0][k, i, j] < 0.5:
                    continue
                along_x, along_y, rise, last, _ = _ray_slopes(i, j, here, lights[k], frame)
                x0, y0 = float(j + pad), float(i + pad)
                last = min(last, _steps_to_edge(x0, along_x, 0.0, heights.shape[1] - 1.001))
                last = min(last, _steps_to_edge(y0, along_y, 0.0, heights.shape[0] - 1.001))
                blocked = _margin(heights, field[1], field[2], summit, x0, y0, here, along_x, along_y, rise, last, 0.0)
                if blocked[1] >= 0:  # proves nothing
                    continue
                step = FIRST
                while step <= last and here + rise * step < summit:
                    ray, x, y = here + rise * step, x0 + step * along_x, y0 + step * along_y
                    if ray < _at(heights, x, y):
                        a, b = int(y + 0.5), int(x + 0.5)
                        lowest[a, b] = max(lowest[a, b], ray)
                    step += 1.0
