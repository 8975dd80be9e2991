"""Shadows on the ground and the object's outline, from what deviates from the ground's field; no light is needed."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, Int32, UInt8
from scipy.ndimage import binary_fill_holes, find_objects, label

from calibration.ground.ground_field import GroundField, Maps
from calibration.ground.seams import LINE_GAP, without_seams
from capture.checks.robust import spread

DARK = -0.8  # log units: ground below is in shadow
USUAL_DARK = -1.8  # log level of a shadow where a photo shows none
FEWEST_DARK = 30  # pixels that measure a photo's dark level
NARROWEST = 0.02  # log units: noise of lit ground is not taken to be less
SHADOW_SHARE = 0.2  # prior of ground in shadow
DARK_WIDTH, OBJECT_WIDTH = 0.35, 0.9  # log units: how much shadows and the object's brightness vary
ODDS = 2.0  # largest log likelihood ratio that one photo may add
GROUND_LIKE = -0.3  # log likelihood ratio below which a pixel is ground
LIKELY = -0.1  # mean log likelihood ratio of a photo from which a pixel belongs to the object
FEWEST_PHOTOS = 3
AROUND = np.ones((9, 9), np.uint8)  # of a part: where its shadow begins
SHADOWED = 0.1  # of the most shadow beside any rival: less beside a part, and it throws none
RIVAL = 0.2  # of the largest part's size: another that may be the object in its stead
PLINTH_GAP = 0.02  # of the picture's long side: between a plinth's side and what stands on it
LEAST_STRIP = 0.3  # of the object's extent: a shorter part is no side of a plinth, and no box on a box
BENT = 1.5  # area of the convex hull of a plinth's side over its own; of a wall's foot: 1
SEAM = 0.006  # of the picture's long side, to both sides of the line where the ground ends
NEIGHBOURS = np.ones((3, 3), np.uint8)  # of a pixel, and itself
RIM = np.ones((7, 7), np.uint8)  # around a hole: where the ground beside it is looked at, two pixels wide
FRONT = 0.25  # of a top's rim, seen from above: its near edge is a third or more
RIM_PHOTOS = 2  # photos that show the ground behind a top in shadow, at least
RING, RING_GAP = 31, 5  # px: the ground around a hole, and between that and what is unlike ground
OTHER_LIGHT = 0.045  # log units over the photos: shadow loops, arches: up to .03; a chair's seat, boxes: .06 to .1


@dataclass(frozen=True)
class GroundShadows:
    """What GroundField's residuals mean, on its pixel grid."""

    visibility: Maps  # of ground: 1 lit, 0 in shadow, not clipped
    dark_level: Float[np.ndarray, " photos"]  # log brightness of shadows relative to lit ground: ambient, one bounce
    likelihood: Float[np.ndarray, "height width"]  # mean log likelihood ratio, object over ground
    object_mask: Bool[np.ndarray, "height width"]  # the largest part that throws shadows, not at the picture's border


def find_shadows(field: GroundField) -> GroundShadows:
    """Return the shadows and the object. The mask is empty where nothing deviates from the ground."""
    dark = np.array([_dark_level(*one) for one in zip(field.residual, field.usable, strict=True)])
    floor = np.exp(dark)[:, None, None]
    visibility = (np.exp(np.minimum(field.residual, 0.5)) - floor) / (1 - floor)
    likelihood = _likelihood(field, dark)
    if field.beyond is None:
        mask = _largest(likelihood, field)
    else:
        seam = _seam(field.beyond)
        mask = _largest(_across(likelihood, seam), field)
        likelihood = np.where(field.beyond | seam, np.float32(ODDS), likelihood)
    tops = _level_tops(field, likelihood, mask)
    tops |= _open_tops(field, likelihood, mask | tops)
    likelihood = np.where(tops, np.float32(ODDS), likelihood)
    return GroundShadows(visibility.astype(np.float32), dark, likelihood, mask | tops)


def _level_tops(
    field: GroundField, likelihood: Float[np.ndarray, "height width"], mask: Bool[np.ndarray, "height width"]
) -> Bool[np.ndarray, "height width"]:
    """Return the object's level tops: they are lit as the ground is, but the object and its shadows enclose them.

    A top is a hole in what is unlike the ground, or in that together with the shadows of all photos, and no wider than
    the object. Shadows alone enclose ground, too, as those of a thick head on a thin neck that meet behind it, or what
    is too dark to show them, as print. A top has the object's side below it, towards the camera: FRONT of its rim, or
    more. Then either of these tells it:

    - behind it the ground is hidden from many lights: half of the rest of its rim is dark in RIM_PHOTOS photos;
    - it lies nearer to the lights than the ground does: its brightness, relative to that of the ground around, differs
      from photo to photo (OTHER_LIGHT).

    Args:
        likelihood: mean log likelihood ratio, object over ground.
        mask: the object without these tops.
    """
    found = np.zeros(mask.shape, bool)
    if not mask.any():
        return found
    dark = (field.usable & (field.residual < DARK)).sum(0)
    unlike, widest, holes = _closed(likelihood > GROUND_LIKE), _extent(mask), np.empty(mask.shape, np.int32)
    seen = _joined(mask, unlike)
    for whole in (seen, _joined(mask, _closed(unlike | (dark > 0)))):
        label(np.asarray(binary_fill_holes(whole)) & ~whole, output=holes)
        for number, box in enumerate(find_objects(holes), 1):
            if max(side.stop - side.start for side in box) > widest:
                continue
            around = tuple(slice(max(side.start - RING, 0), side.stop + RING) for side in box)
            hole = (holes[around] == number).astype(np.uint8)
            edge = cv2.dilate(hole, NEIGHBOURS) > 0
            rim = (cv2.dilate(hole, RIM) > 0) & ~edge
            behind = rim & ~unlike[around]
            if seen[around][rim].mean() <= FRONT:
                continue
            is_shaded = not behind.any() or np.median(dark[around][behind]) >= RIM_PHOTOS
            if is_shaded or _is_lit_otherwise(_steps(field, around, hole > 0, _ring(hole, unlike[around]))):
                found[around] |= edge
    return found


def _open_tops(
    field: GroundField, likelihood: Float[np.ndarray, "height width"], mask: Bool[np.ndarray, "height width"]
) -> Bool[np.ndarray, "height width"]:
    """Return the object's level tops whose far edge is not seen: nothing encloses them, as a table's before the ground.

    They lie in what the object's convex hull has above the object in the picture. Ground that is seen there, past a
    handle or between ears, follows the light of the ground around; a top does not (OTHER_LIGHT).

    Args: as for _level_tops.
    """
    found, unlike = np.zeros(mask.shape, bool), _closed(likelihood > GROUND_LIKE) | mask
    if not mask.any():
        return found
    wide = _grown(mask)  # between the object's side and its top lies a pixel that is like neither
    for pocket in _long_parts(convex_hull(mask) & _over(mask) & ~unlike, mask):
        steps = _steps(field, (slice(None), slice(None)), pocket, _ring(pocket.astype(np.uint8), unlike))
        if _is_lit_otherwise(steps):
            top = _with_whole_top(field, steps, wide) & ~wide
            found |= (top | (_grown(top) & wide)) & ~mask
    return found


def _grown(region: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    return cv2.dilate(region.astype(np.uint8), NEIGHBOURS) > 0


def _ring(
    hole: UInt8[np.ndarray, "rows columns"], unlike: Bool[np.ndarray, "rows columns"]
) -> Bool[np.ndarray, "rows columns"]:
    """Return the ground around a hole."""
    near = cv2.dilate(hole | unlike.astype(np.uint8), np.ones((RING_GAP, RING_GAP), np.uint8)) > 0
    return (cv2.dilate(hole, np.ones((RING, RING), np.uint8)) > 0) & ~near


def _steps(
    field: GroundField,
    window: tuple[slice, ...],
    within: Bool[np.ndarray, "rows columns"],
    ground: Bool[np.ndarray, "rows columns"],
) -> Float[np.ndarray, "photos 2"]:
    """Return the median residual of the lit ground and how much more it is within; NaN where a photo shows too few."""
    found = []
    for residual, usable in zip(field.residual[:, *window], field.usable[:, *window], strict=True):
        lit = usable & (residual > DARK / 2)
        inside, outside = residual[lit & within], residual[lit & ground]
        few = min(inside.size, outside.size) < FEWEST_DARK
        found.append((np.nan,) * 2 if few else (np.median(outside), np.median(inside) - np.median(outside)))
    return np.array(found)


def _is_lit_otherwise(steps: Float[np.ndarray, "photos 2"]) -> bool:
    """Tell whether what _steps compares with the ground does not follow its light, by one sigma over the photos."""
    known = steps[np.isfinite(steps[:, 1]), 1]
    return len(known) >= FEWEST_PHOTOS and spread(known - np.median(known)) > OTHER_LIGHT


def _joined(
    mask: Bool[np.ndarray, "height width"], region: Bool[np.ndarray, "height width"]
) -> Bool[np.ndarray, "height width"]:
    """Return the mask with all of the region that hangs together with it."""
    parts = np.empty(mask.shape, np.int32)
    label(region | mask, NEIGHBOURS, output=parts)
    return np.isin(parts, parts[mask])


def _closed(region: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    return cv2.morphologyEx(region.astype(np.uint8), cv2.MORPH_CLOSE, NEIGHBOURS) > 0


def _seam(beyond: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """Return the pixels at the line where the ground ends, in which neither side's field holds."""
    disc = np.ones([2 * max(1, round(SEAM * max(beyond.shape))) + 1] * 2, np.uint8)
    return cv2.morphologyEx(beyond.astype(np.uint8), cv2.MORPH_GRADIENT, disc) > 0


def _across(
    likelihood: Float[np.ndarray, "height width"], seam: Bool[np.ndarray, "height width"]
) -> Float[np.ndarray, "height width"]:
    """Return the likelihood with that of the seam taken from beside it, where less of the object is seen."""
    disc = np.ones([2 * round(SEAM * max(seam.shape)) + 3] * 2, np.uint8)
    beside = cv2.erode(np.where(seam, np.float32(ODDS), likelihood), disc)
    return np.where(seam, beside, likelihood)


def _dark_level(residual: Float[np.ndarray, "height width"], usable: Bool[np.ndarray, "height width"]) -> float:
    below = residual[usable & (residual < DARK)]
    return float(np.median(below)) if below.size >= FEWEST_DARK else USUAL_DARK


def _likelihood(field: GroundField, dark: Float[np.ndarray, " photos"]) -> Float[np.ndarray, "height width"]:
    """Compare two models of each sample: ground (lit, in shadow, or seldom something else) and any brightness."""
    noise = max(NARROWEST, field.noise())
    if field.beyond is not None:
        noise = np.where(field.beyond, max(noise, field.noise(of_beyond=True)), noise)
    total, count = np.zeros_like(field.albedo), np.zeros_like(field.albedo)
    for residual, usable, level in zip(field.residual, field.usable, dark, strict=True):
        below = np.minimum(residual, level) - level  # deeper than the usual shadow is shadow, too
        shadow = gaussian(np.maximum(residual, level) - level, DARK_WIDTH)
        shadow = np.where(below < 0, gaussian(np.zeros_like(below), DARK_WIDTH), shadow)
        lit = 0.95 * gaussian(residual, 1.5 * noise) + 0.05 * gaussian(residual, 5 * noise)
        ground = (1 - SHADOW_SHARE) * lit + SHADOW_SHARE * shadow + 1e-3
        anything = 0.7 * gaussian(residual, OBJECT_WIDTH) + 0.3 * shadow
        total += np.clip(np.log(anything / ground), -ODDS, ODDS) * usable
        count += usable
    return cv2.GaussianBlur((total / np.maximum(count, 1)).astype(np.float32), (0, 0), 0.7)


def gaussian(values: np.ndarray, sigma: float | np.ndarray) -> np.ndarray:
    """Return the density of a normal distribution around 0."""
    return np.exp(-0.5 * (values / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi))


def _largest(likelihood: Float[np.ndarray, "height width"], field: GroundField) -> Bool[np.ndarray, "height width"]:
    likely = (likelihood > LIKELY) & (field.usable.sum(0) >= FEWEST_PHOTOS)
    likely = without_seams(likely) if field.beyond is None else likely
    parts = np.empty(likely.shape, np.int32)
    label(likely, output=parts)
    sizes = np.bincount(parts.ravel())
    border = np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]])
    sizes[0] = 0
    sizes[border] = 0
    if not sizes.any():
        return np.zeros(likely.shape, bool)
    chosen, free = parts == _shadowed(field, likely, parts, sizes), sizes[parts] > 0
    whole = _with_plinth(np.asarray(binary_fill_holes(chosen)), free & ~chosen)
    return _with_stacked(field, likelihood, whole, free & ~whole)


def _shadowed(
    field: GroundField,
    likely: Bool[np.ndarray, "height width"],
    parts: Int32[np.ndarray, "height width"],
    sizes: Int[np.ndarray, " parts"],
) -> int:
    """Return the number of the largest part that throws shadows, of those not far smaller than the largest.

    Black print on the ground may be too dark to be like ground, and larger than a black object beside it. In a typical
    photo an object has 2 to 24 % of the ground around it in its shadow, as the lights are high or low; such print has
    .1 % where the object beside it has 16 %. If no part has shadow beside it, the largest is meant.

    Args:
        likely: where any part may be.
        sizes: of the parts, px; 0 where one is out of the question.
    """
    dark = field.usable & (field.residual < DARK)
    rivals = [number for number in np.argsort(-sizes, kind="stable") if sizes[number] >= RIVAL * sizes.max()]
    shares = []
    for number in rivals:
        part = parts == number
        around = (cv2.dilate(part.astype(np.uint8), AROUND) > 0) & ~_grown(part) & ~likely
        shares.append(np.median(dark[:, around].mean(1)) if around.any() else 0.0)
    return int(rivals[int(np.argmax(np.array(shares) >= SHADOWED * max(shares)))])


def _with_plinth(
    chosen: Bool[np.ndarray, "height width"], others: Bool[np.ndarray, "height width"]
) -> Bool[np.ndarray, "height width"]:
    """Add the plinth on which the object stands: the other likely parts that bend around it, and what they enclose.

    A plinth's level top is lit like the ground. Only its side is not: a strip, apart from what stands on the top.
    """
    found = chosen.copy()
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, [2 * round(PLINTH_GAP * max(chosen.shape)) + 1] * 2)
    for strip in _long_parts(others, chosen):
        hull = convex_hull(strip)
        near, is_bent = cv2.dilate(hull.astype(np.uint8), disc) > 0, hull.sum() > BENT * strip.sum()
        if is_bent and chosen[hull].any():
            both = cv2.morphologyEx((found | hull).astype(np.uint8), cv2.MORPH_CLOSE, disc) > 0
            found |= (both & near) | hull
    return np.asarray(binary_fill_holes(found))


def _long_parts(
    others: Bool[np.ndarray, "height width"], mask: Bool[np.ndarray, "height width"]
) -> Iterator[Bool[np.ndarray, "height width"]]:
    """Yield the connected parts of a region that are not short beside the object: LEAST_STRIP of its extent."""
    parts, least = np.empty(mask.shape, np.int32), LEAST_STRIP * _extent(mask)
    label(others, output=parts)
    for number in np.flatnonzero(np.bincount(parts.ravel()) > least):
        if number > 0 and _extent(part := parts == number) >= least:
            yield part


def _with_stacked(
    field: GroundField,
    likelihood: Float[np.ndarray, "height width"],
    mask: Bool[np.ndarray, "height width"],
    others: Bool[np.ndarray, "height width"],
) -> Bool[np.ndarray, "height width"]:
    """Add the likely parts that a level top parts from the object, with that top: what stands on it, or bears it.

    A box on a box: between the sides of both lies the lower one's top, which is lit as the ground is. What lies between
    the object and another thing on the ground is ground, lit as that beside both; a top is nearer to the lights, see
    _level_tops. Parts that are small beside the object are left out: they are often noise.

    Args:
        likelihood: mean log likelihood ratio, object over ground.
        mask: the object without these parts.
        others: the other likely parts.
    """
    no_ground = _closed(likelihood > GROUND_LIKE) | (False if field.beyond is None else field.beyond)
    found, picture = mask.copy(), (slice(None), slice(None))
    for part in _long_parts(others, mask):
        top = ((_under(part) & _over(found)) | (_under(found) & _over(part))) & ~no_ground & ~found
        if not top.any() or _extent(top) > _extent(found):
            continue
        rows = cv2.dilate(top.astype(np.uint8), np.ones((RING, 1), np.uint8)).any(1, keepdims=True)
        beside = _ring(convex_hull(found | part).astype(np.uint8), no_ground) & rows
        if _is_lit_otherwise(steps := _steps(field, picture, top, beside)):
            found = _with_whole_top(field, steps, found | part | top)
    return np.asarray(binary_fill_holes(found))


def _with_whole_top(
    field: GroundField, steps: Float[np.ndarray, "photos 2"], found: Bool[np.ndarray, "height width"]
) -> Bool[np.ndarray, "height width"]:
    """Return the object with what hangs together with it, lies above, and is lit as a known part of a level top is.

    Nothing beside the object or higher in the picture is taken in. Over the photos, a pixel shows all of that part's
    steps in brightness where it is as high, and none on the ground.

    Args:
        steps: of that part, see _steps.
    """
    shown, whole = np.zeros_like(field.albedo), np.zeros_like(field.albedo)
    for residual, usable, (ground, step) in zip(field.residual, field.usable, steps, strict=True):
        if np.isfinite(step):
            lit = usable & (residual > DARK / 2)
            shown += np.where(lit, (residual - ground) * step, 0)
            whole += lit * step**2
    shown, whole = (cv2.GaussianBlur(one, (0, 0), 1.0) for one in (shown, whole))
    within = _over(found) & _under(found).any(1, keepdims=True)
    return _joined(found, (shown > whole / 2) & within)


def _under(region: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """Return the region and all pixels below it in the picture."""
    return np.logical_or.accumulate(region, 0)


def _over(region: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """Return the region and all pixels above it in the picture."""
    return np.logical_or.accumulate(region[::-1], 0)[::-1]


def convex_hull(region: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """Return the pixels inside the convex hull of a region that is not empty."""
    hull = np.zeros(region.shape, np.uint8)
    cv2.fillConvexPoly(hull, cv2.convexHull(np.argwhere(region)[:, ::-1].astype(np.int32)), 1)
    return hull > 0


def _extent(region: Bool[np.ndarray, "height width"]) -> int:
    rows, columns = np.nonzero(region)
    return int(max(np.ptp(rows), np.ptp(columns))) + 1


def of_one_ground(shadows: GroundShadows) -> GroundShadows:
    """Return the shadows with all that a line across the picture parts from the ground marked as no ground.

    Behind the foot of a wall or the edge of a table there may be another surface whose light is as smooth.
    """
    line = (shadows.likelihood > GROUND_LIKE).astype(np.uint8)
    line = cv2.morphologyEx(
        np.pad(line, LINE_GAP, constant_values=1), cv2.MORPH_CLOSE, np.ones((LINE_GAP, LINE_GAP), np.uint8)
    )
    line = (line[LINE_GAP:-LINE_GAP, LINE_GAP:-LINE_GAP] > 0) | shadows.object_mask
    parts = np.empty(line.shape, np.int32)
    label(~line, output=parts)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    border = np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]])
    beyond = np.setdiff1d(border, [0, int(sizes.argmax())])
    return replace(shadows, likelihood=np.where(np.isin(parts, beyond), np.float32(ODDS), shadows.likelihood))
