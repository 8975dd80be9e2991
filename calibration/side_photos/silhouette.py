"""The object's silhouette in a handheld photo in room light.

Where the object can be follows from its outline in the tripod's photos. There each pixel is compared with the bare
table as the tripod saw it, and with the colours found on either side; the cheapest cut divides the two [Boykov and
Jolly 2001; Rother, Kolmogorov and Blake 2004, who fit the colours in turn]. What stays the same when either side is
favoured is sure.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_fill_holes, convolve1d, label

from calibration.ground.min_cut import cheapest_region
from calibration.posed_camera import PosedCamera
from calibration.side_photos.ground_look import DARKEST, NARROWEST, SEEN_WIDTH, GroundLook, TripodView, ground_look
from capture.checks.robust import column_spread

BESIDE_FOUND = 0.5  # of what is found in the whole region: more of the object may lie beside it
WINDOW = 360  # px: longer side of the window that is cut
AROUND = 0.12  # of the region's size: table beside it that tells noise and colours
SLICES = 48  # of the space where the object may be
LARGEST = 9.0  # nats for one pixel: beyond, something else happened
SHADED = 1.0  # sigmas: what is darker than that may lie in the soft shadow of room light around the object
SHADE = 0.4  # nats of darkening for one nat of odds: few shadows of room light are much deeper
DARKER, BESIDE = 2.5, 3  # sigmas, px: table that is this much darker lies in a shadow, which may go on
ANYTHING = 3.0  # nats: what an object costs that may have any colour
UNSEEN = 1.5  # nats: what the tripod's picture does not show is rather more table
COLOURS = 12  # bins of each colour axis
LINK = 12.0  # nats: cost of a cut between alike pixels
ROUNDS = 3
FAVOUR = 1.5  # nats for one pixel
RIM = 3  # px to both sides of the outline in which it may lie
CLEAR = 6.0  # sigmas of the step there: the cut alone puts the outline at 2 to 3, half way up a step of 5
SMALLEST = 60  # px of the window
RIVAL = 0.1  # of the largest part's size: another that may be the object in its stead


@dataclass(frozen=True)
class Silhouette:
    """What of a window of a photo the object covers. `sure` of a pixel that has the same answer whoever is favoured."""

    mask: Bool[np.ndarray, "height width"]
    sure: Bool[np.ndarray, "height width"]
    window: tuple[int, int, int, int]  # left, top, width, height in px of the photo

    def sure_outline(self) -> float:
        """Return the share of the outline beside which the answer is sure."""
        rim = self.mask & ~(cv2.erode(self.mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
        return float((rim & self.sure).sum()) / max(int(rim.sum()), 1)

    def shows(self, pixels: Float[np.ndarray, "*batch 2"]) -> Bool[np.ndarray, "*batch"]:
        """Return whether the object covers pixels of the photo."""
        height, width = self.mask.shape
        left, up, *size = self.window
        at = np.floor((pixels - [left, up] + 0.5) * [width / size[0], height / size[1]]).astype(int)
        inside = np.asarray(((at >= 0) & (at < [width, height])).all(-1))
        at = np.where(inside[..., None], at, 0)
        return inside & self.mask[at[..., 1], at[..., 0]]


def possible_region(
    camera: PosedCamera, reach: Float[np.ndarray, "n 3"], eye: Float[np.ndarray, "3"], top: float
) -> Bool[np.ndarray, "height width"]:
    """Return where a photo may show what the tripod saw: the rays of its pixels from their ends up to `top`.

    Args:
        camera: of the side photo.
        reach: world points, at or above the table, where the tripod's rays through the object's pixels end.
        eye: the tripod's camera centre; top: world length above the table.
    """
    region = np.zeros((camera.camera.height, camera.camera.width), np.uint8)
    before = None
    for points in _levels(camera, reach, eye, top):
        pixels, depth = camera.project_with_depth(points)
        if (depth <= 0).any():
            before = None
            continue
        both = pixels if before is None else np.concatenate([before, pixels])
        hull = cv2.convexHull(np.clip(both, -1e4, 1e4).astype(np.float32))
        cv2.fillConvexPoly(region, hull.round().astype(np.int32), 1)
        before = pixels
    return region > 0


def share_shown(
    silhouette: Silhouette,
    camera: PosedCamera,
    outline: Float[np.ndarray, "n 3"],
    eye: Float[np.ndarray, "3"],
    top: float,
) -> float:
    """Return the share of the tripod's rays through the object's pixels that pass behind or before the silhouette.

    Args: as for possible_region, but for `outline`: world points where the rays meet the table.
    """
    found = np.zeros(len(outline), bool)
    for points in _levels(camera, outline, eye, top):
        pixels, depth = camera.project_with_depth(points)
        found |= (depth > 0) & silhouette.shows(pixels)
    return float(found.mean())


def _levels(
    camera: PosedCamera, reach: Float[np.ndarray, "n 3"], eye: Float[np.ndarray, "3"], top: float
) -> Iterator[Float[np.ndarray, "n 3"]]:
    """Yield world points on the rays from `reach` to the eye, level by level up to `top` above the table."""
    for height in np.linspace(0, top, SLICES):
        share = np.maximum(height - (reach[:, 2] - camera.ground_height), 0) / (eye[2] - reach[:, 2])
        yield reach + (eye - reach) * share[:, None]


def find_silhouette(
    rgb: Float[np.ndarray, "height width 3"],
    camera: PosedCamera,
    region: Bool[np.ndarray, "height width"],
    tripod: TripodView,
    foot: Float[np.ndarray, "3"],
) -> Silhouette | None:
    """Return the silhouette in a window around the object; None where nothing stands out.

    The object may be small in its region. What is found there is looked at again in a window that it fills.

    Args:
        rgb: linear, the whole photo; camera: of this photo.
        region: of possible_region.
        foot: world point on the table where the object stands: of several things there, that one is meant.
    """
    found = _cut_out(rgb, camera, region, tripod, foot)
    if found is None:
        return None
    left, up, width, height = found.window
    whole, near = np.zeros(region.shape, np.uint8), np.zeros_like(region)
    mask = cv2.resize(found.mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
    whole[up : up + height, left : left + width] = mask
    left, up, width, height = _window(whole > 0, BESIDE_FOUND)
    near[up : up + height, left : left + width] = True
    found = _cut_out(rgb, camera, region & near, tripod, foot)
    return None if found is None else Silhouette(found.mask, found.sure(), found.window)


@dataclass(frozen=True)
class _CutOut:
    """What is found in a window, and what it is found by."""

    window: tuple[int, int, int, int]
    mask: Bool[np.ndarray, "height width"]
    near: Bool[np.ndarray, "height width"]  # where the object may be
    odds: Float[np.ndarray, "height width"]  # by deviation and colours
    links: list[np.ndarray]
    place: Float[np.ndarray, "2"]  # pixel of the foot
    look: GroundLook

    def sure(self) -> Bool[np.ndarray, "height width"]:
        """Return where nothing else is found whoever is favoured, and neither shadow nor unseen table may mislead."""
        more, less = (_cut(self.odds, self.links, self.near, favour) for favour in (FAVOUR, -FAVOUR))
        # colours alone speak for the table, and an object has more than one
        unseen = self.near & ~self.look.known & ~self.mask
        apart = (_nearest(more, self.place) & ~self.mask) | (self.mask & ~less)
        return ~(apart | _maybe_shade(self.mask, self.look) | unseen)


def _cut_out(
    rgb: Float[np.ndarray, "height width 3"],
    camera: PosedCamera,
    region: Bool[np.ndarray, "height width"],
    tripod: TripodView,
    foot: Float[np.ndarray, "3"],
) -> _CutOut | None:
    """Return what is found in a window around the region; None where nothing stands out. Args: of find_silhouette."""
    if not region.any():
        return None
    left, up, width, height = _window(region, AROUND, 4)
    scale = min(1.0, WINDOW / max(width, height))
    size = (max(16, round(width * scale)), max(16, round(height * scale)))
    part = cv2.resize(rgb[up : up + height, left : left + width], size, interpolation=cv2.INTER_AREA)
    near = cv2.resize(region[up : up + height, left : left + width].astype(np.uint8), size) > 0
    view = camera.cropped(left, up, width, height).resized(*size)
    log = cv2.GaussianBlur(np.log(np.maximum(part, DARKEST)).astype(np.float32), (0, 0), SEEN_WIDTH)
    look = ground_look(log, view, near, tripod)
    odds = _table_odds(look)
    links, place = _links(log, look), view.project(foot)
    mask, colours = _nearest(_cut(odds, links, near, 0.0), place), np.zeros_like(odds)
    for _ in range(ROUNDS):
        if mask.sum() < SMALLEST:
            return None
        colours = _colour_odds(log, mask & (odds + colours >= 0), ~mask & (~near | (odds < -1)))
        mask = _nearest(_cut(odds + colours, links, near, 0.0), place)
    mask = _to_half_way(mask, log, look)
    if mask.sum() < SMALLEST:
        return None
    return _CutOut((left, up, width, height), mask, near, odds + colours, links, place, look)


def _to_half_way(
    mask: Bool[np.ndarray, "height width"], log: Float[np.ndarray, "height width 3"], look: GroundLook
) -> Bool[np.ndarray, "height width"]:
    """Return the mask with its outline where the photo is half way between the object's colour and the table's.

    A cut calls all that is surely not the bare table object, so that a strong edge lies at the outer end of its blur.
    """
    disc = np.ones((2 * RIM + 1, 2 * RIM + 1), np.uint8)
    inner, outer = cv2.erode(mask.astype(np.uint8), disc) > 0, cv2.dilate(mask.astype(np.uint8), disc) > 0
    rim, moved = outer & ~inner, mask.copy()
    plain = log[~outer]
    texture = column_spread(plain - np.median(plain, axis=0)) if len(plain) else np.full(3, np.inf)
    for values, error, seen in ((look.residual, look.error, look.known), (log, texture, np.ones_like(mask))):
        (thing, has_thing), (table, has_table) = (_mean_near(values, seen & side) for side in (inner, ~outer))
        step = thing - table
        share = ((values - table) * step).sum(-1) / np.maximum((step**2).sum(-1), NARROWEST**2)
        is_clear = (step**2).sum(-1) > ((CLEAR * error) ** 2).sum(-1)
        decided = rim & seen & has_thing & has_table & is_clear
        moved = np.where(decided, share > 0.5, moved)
        rim = rim & ~decided
    return moved


def _mean_near(
    values: Float[np.ndarray, "height width 3"], region: Bool[np.ndarray, "height width"]
) -> tuple[Float[np.ndarray, "height width 3"], Bool[np.ndarray, "height width"]]:
    """Return the mean of a region's values near each pixel, and where there are any."""
    weight = region.astype(np.float32)
    total, count = (
        cv2.GaussianBlur(one, (0, 0), RIM) for one in (values.astype(np.float32) * weight[..., None], weight)
    )
    return total / np.maximum(count, 1e-6)[..., None], count > 1e-2


def _maybe_shade(mask: Bool[np.ndarray, "height width"], look: GroundLook) -> Bool[np.ndarray, "height width"]:
    """Return pixels of the mask beside darkened table: the object, or more of that shadow."""
    shade = ~mask & look.known & (look.residual.mean(-1) < -DARKER * look.error.mean(-1))
    shade = cv2.morphologyEx(shade.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    return mask & (cv2.dilate(shade, np.ones((2 * BESIDE + 1, 2 * BESIDE + 1), np.uint8)) > 0)


def _window(region: Bool[np.ndarray, "height width"], beside: float, least: int = 0) -> tuple[int, int, int, int]:
    """Return left, top, width and height of a window around a region that is not empty.

    Args:
        beside: how much more on each side, of the region's size, and `least`: px more than that.
    """
    rows, columns = np.flatnonzero(region.any(1)), np.flatnonzero(region.any(0))
    pad = round(beside * max(np.ptp(rows), np.ptp(columns))) + least
    up, left = max(int(rows[0]) - pad, 0), max(int(columns[0]) - pad, 0)
    down, right = min(int(rows[-1]) + pad, region.shape[0] - 1), min(int(columns[-1]) + pad, region.shape[1] - 1)
    return left, up, right - left + 1, down - up + 1


def _table_odds(look: GroundLook) -> Float[np.ndarray, "height width"]:
    """Return log odds of object over table from the deviation; 0 where the object hid the table from the tripod.

    Around an object its soft shadow and, on varnish, its mirror image darken the table: what is darker than the table
    may be either, and its colours decide, unless it is darker than such shadows are.
    """
    grey = look.residual.mean(-1)
    colour = ((look.residual - grey[..., None]) / look.error) ** 2
    noise = look.error.mean(-1)
    deviation = 0.5 * (colour.sum(-1) + (grey / noise) ** 2)
    odds = np.minimum(deviation, LARGEST) - ANYTHING
    shade = np.maximum(-grey / SHADE - ANYTHING, 0.0)
    odds = np.where(grey < -SHADED * noise, np.minimum(odds, shade), odds)
    return np.where(look.known, odds, np.where(look.hidden, 0.0, -UNSEEN))


def _links(log: Float[np.ndarray, "height width 3"], look: GroundLook):
    """Return costs of cuts between neighbours in a row and in a column: cheap across edges that the table has not."""
    out = []
    for axis in (1, 0):
        plain, other = np.diff(log, axis=axis), np.diff(look.residual, axis=axis)
        known = look.known[:, 1:] & look.known[:, :-1] if axis else look.known[1:] & look.known[:-1]
        step = (np.where(known[..., None], other, plain) ** 2).sum(-1)
        out.append(LINK * np.exp(-step / (2 * step.mean())))
    return out


def _colour_odds(log: np.ndarray, thing: np.ndarray, rest: np.ndarray) -> Float[np.ndarray, "height width"]:
    """Return log odds of object over the rest by colour: of smoothed histograms of brightness and two differences."""
    axes = np.stack([log.mean(-1), log[..., 0] - log[..., 2], log[..., 1] - 0.5 * (log[..., 0] + log[..., 2])], -1)
    low, high = np.quantile(axes, 0.005, axis=(0, 1)), np.quantile(axes, 0.995, axis=(0, 1))
    index = np.clip((axes - low) / np.maximum(high - low, 1e-3) * COLOURS, 0, COLOURS - 1).astype(int)
    counts = []
    for chosen in (thing, rest):
        cells = np.zeros((COLOURS,) * 3, np.float32)
        np.add.at(cells, tuple(index[chosen].T), 1.0)
        for axis in range(3):
            cells = convolve1d(cells, [0.25, 0.5, 0.25], axis, mode="nearest")
        counts.append(cells / max(cells.sum(), 1e-6) + 0.3 / COLOURS**3)
    odds = np.log(counts[0] / counts[1])
    return np.clip(odds[tuple(np.moveaxis(index, -1, 0))], -ANYTHING, ANYTHING)


def _cut(odds: np.ndarray, links: list[np.ndarray], region: np.ndarray, favour: float) -> Bool[np.ndarray, "h w"]:
    """Return the cheapest cut; outside the region there is no object."""
    return cheapest_region(np.where(region, odds + favour * (region & (np.abs(odds) < 20)), -20.0), *links)


def _nearest(mask: Bool[np.ndarray, "height width"], place: Float[np.ndarray, "2"]) -> Bool[np.ndarray, "height width"]:
    """Return the part of the mask, holes filled, that is nearest to a pixel; of those that are not small."""
    parts = np.empty(mask.shape, np.int32)
    label(mask, output=parts)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    if not sizes.any():
        return np.zeros_like(mask)
    rows, columns = np.nonzero(mask & (sizes[parts] >= RIVAL * sizes.max()))
    at = int(np.hypot(columns - place[0], rows - place[1]).argmin())
    return np.asarray(binary_fill_holes(parts == parts[rows[at], columns[at]]))
