"""The object's silhouette in a handheld photo in room light.

Where the object can be follows from its outline in the tripod's photos. There each pixel is compared with the bare
table as the tripod saw it, and with the colours found on either side; the cheapest cut divides the two [Boykov and
Jolly 2001; Rother, Kolmogorov and Blake 2004, who fit the colours in turn]. What stays the same when either side is
favoured is sure.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_fill_holes, label

from calibration.posed_camera import PosedCamera
from calibration.side_photos.ground_look import DARKEST, SEEN_WIDTH, GroundLook, TripodView, ground_look
from calibration.side_photos.min_cut import cheapest_region

WINDOW = 360  # px: longer side of the window that is cut
AROUND = 0.12  # of the region's size: table beside it that tells noise and colours
SLICES = 24  # of the space where the object may be
LARGEST = 9.0  # nats for one pixel: beyond, something else happened
SHADED = 1.0  # sigmas: what is darker than that may lie in the soft shadow of room light around the object
DARKER, BESIDE = 2.5, 3  # sigmas, px: table that is this much darker lies in a shadow, which may go on
ANYTHING = 3.0  # nats: what an object costs that may have any colour
COLOURS = 12  # bins of each colour axis
COLOUR_SHARE = 1.0  # of the colours' odds where the table is known as well
LINK = 12.0  # nats: cost of a cut between alike pixels
ROUNDS = 3
FAVOUR = 1.5  # nats for one pixel
SMALLEST = 60  # px of the window


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


def possible_region(
    camera: PosedCamera,
    outline: Float[np.ndarray, "n 3"],
    eye: Float[np.ndarray, "3"],
    top: float,
) -> Bool[np.ndarray, "height width"]:
    """Return where a photo may show what the tripod saw: the rays of its outline between table and `top`.

    Args:
        camera: of the side photo.
        outline: world points where rays of the object's pixels in the tripod's photo meet the table.
        eye: the tripod's camera centre; top: world length above the table.
    """
    region = np.zeros((camera.camera.height, camera.camera.width), np.uint8)
    before = None
    for height in np.linspace(0, top, SLICES):
        points = outline + (eye - outline) * (height / (eye[2] - camera.ground_height))
        pixels, depth = camera.project_with_depth(points)
        if (depth <= 0).any():
            before = None
            continue
        both = pixels if before is None else np.concatenate([before, pixels])
        hull = cv2.convexHull(np.clip(both, -1e4, 1e4).astype(np.float32))
        cv2.fillConvexPoly(region, hull.round().astype(np.int32), 1)
        before = pixels
    return region > 0


def find_silhouette(
    rgb: Float[np.ndarray, "height width 3"],
    camera: PosedCamera,
    region: Bool[np.ndarray, "height width"],
    tripod: TripodView,
) -> Silhouette | None:
    """Return the silhouette in a window around the region; None where nothing stands out.

    Args:
        rgb: linear, the whole photo; camera: of this photo.
        region: of possible_region.
    """
    window = _window(region)
    if window is None:
        return None
    left, up, width, height = window
    scale = min(1.0, WINDOW / max(width, height))
    size = (max(16, round(width * scale)), max(16, round(height * scale)))
    part = cv2.resize(rgb[up : up + height, left : left + width], size, interpolation=cv2.INTER_AREA)
    near = cv2.resize(region[up : up + height, left : left + width].astype(np.uint8), size) > 0
    view = camera.cropped(left, up, width, height).resized(*size)
    log = cv2.GaussianBlur(np.log(np.maximum(part, DARKEST)).astype(np.float32), (0, 0), SEEN_WIDTH)
    look = ground_look(log, view, near, tripod)
    odds = _table_odds(look)
    links = _links(log, look)
    mask, colours = _cut(odds, links, near, 0.0), np.zeros_like(odds)
    for _ in range(ROUNDS):
        if mask.sum() < SMALLEST:
            return None
        colours = _colour_odds(log, mask & (odds + colours >= 0), ~mask & (~near | (odds < -1)))
        mask = _cut(_together(odds, colours, look), links, near, 0.0)
    both = _together(odds, colours, look)
    more, less = (_cut(both, links, near, favour) for favour in (FAVOUR, -FAVOUR))
    mask = _largest(mask)
    if mask.sum() < SMALLEST:
        return None
    apart = (_largest(more) & ~mask) | (mask & ~less) | _maybe_shade(mask, look)
    return Silhouette(mask, ~apart, window)


def _maybe_shade(mask: Bool[np.ndarray, "height width"], look: GroundLook) -> Bool[np.ndarray, "height width"]:
    """Return pixels of the mask beside darkened table: the object, or more of that shadow."""
    shade = ~mask & look.known & (look.residual.mean(-1) < -DARKER * look.error.mean(-1))
    shade = cv2.morphologyEx(shade.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    return mask & (cv2.dilate(shade, np.ones((2 * BESIDE + 1, 2 * BESIDE + 1), np.uint8)) > 0)


def _window(region: Bool[np.ndarray, "height width"]) -> tuple[int, int, int, int] | None:
    """Return left, top, width and height of a window around the region."""
    rows, columns = np.flatnonzero(region.any(1)), np.flatnonzero(region.any(0))
    if len(rows) == 0:
        return None
    pad = round(AROUND * max(np.ptp(rows), np.ptp(columns))) + 4
    up, left = max(int(rows[0]) - pad, 0), max(int(columns[0]) - pad, 0)
    down, right = min(int(rows[-1]) + pad, region.shape[0] - 1), min(int(columns[-1]) + pad, region.shape[1] - 1)
    return left, up, right - left + 1, down - up + 1


def _table_odds(look: GroundLook) -> Float[np.ndarray, "height width"]:
    """Return log odds of object over table from the deviation; 0 where the table is unknown.

    Around an object its soft shadow and, on varnish, its mirror image darken the table: what is darker than the table
    may be either, and its colours decide.
    """
    grey = look.residual.mean(-1)
    colour = ((look.residual - grey[..., None]) / look.error) ** 2
    noise = look.error.mean(-1)
    deviation = 0.5 * (colour.sum(-1) + (grey / noise) ** 2)
    odds = np.minimum(deviation, LARGEST) - ANYTHING
    return np.where(look.known, np.where(grey < -SHADED * noise, np.minimum(odds, 0.0), odds), 0.0)


def _links(log: Float[np.ndarray, "height width 3"], look: GroundLook):
    """Return costs of cuts between neighbours in a row and in a column: cheap across edges that the table has not."""
    out = []
    for axis in (1, 0):
        plain, other = np.diff(log, axis=axis), np.diff(look.residual, axis=axis)
        known = np.minimum(*(np.take(look.known, np.arange(*ends), axis=axis) for ends in _pairs(log.shape[axis])))
        step = (np.where(known[..., None], other, plain) ** 2).sum(-1)
        out.append(LINK * np.exp(-step / (2 * step.mean())))
    return out


def _pairs(count: int) -> tuple[tuple[int, int], tuple[int, int]]:
    return (0, count - 1), (1, count)


def _colour_odds(log: np.ndarray, thing: np.ndarray, rest: np.ndarray) -> Float[np.ndarray, "height width"]:
    """Return log odds of object over the rest by colour: of smoothed histograms of brightness and two differences."""
    axes = np.stack([log.mean(-1), log[..., 0] - log[..., 2], log[..., 1] - 0.5 * (log[..., 0] + log[..., 2])], -1)
    low, high = np.quantile(axes, 0.005, axis=(0, 1)), np.quantile(axes, 0.995, axis=(0, 1))
    index = np.clip((axes - low) / np.maximum(high - low, 1e-3) * COLOURS, 0, COLOURS - 1).astype(int)
    counts = []
    for chosen in (thing, rest):
        cells = np.zeros((COLOURS,) * 3, np.float32)
        np.add.at(cells, tuple(index[chosen].T), 1.0)
        cells = _blurred(cells)
        counts.append(cells / max(cells.sum(), 1e-6) + 0.3 / COLOURS**3)
    odds = np.log(counts[0] / counts[1])
    return np.clip(odds[tuple(np.moveaxis(index, -1, 0))], -ANYTHING, ANYTHING)


def _blurred(cells: Float[np.ndarray, "a b c"]) -> Float[np.ndarray, "a b c"]:
    for axis in range(3):
        pad = np.take(cells, [0, *range(cells.shape[axis]), cells.shape[axis] - 1], axis=axis)
        n = cells.shape[axis]
        before, here, after = (np.take(pad, np.arange(k, k + n), axis=axis) for k in range(3))
        cells = 0.25 * before + 0.5 * here + 0.25 * after
    return cells


def _together(odds: np.ndarray, colours: np.ndarray, look: GroundLook) -> np.ndarray:
    return np.where(look.known, odds + COLOUR_SHARE * colours, colours)


def _cut(odds: np.ndarray, links: list[np.ndarray], region: np.ndarray, favour: float) -> Bool[np.ndarray, "h w"]:
    """Return the cheapest cut; outside the region there is no object."""
    gain = np.where(region, odds + favour * (region & (np.abs(odds) < 20)), -20.0).astype(float)
    zero = np.zeros_like(gain)
    return cheapest_region(np.maximum(-gain, zero), np.maximum(gain, zero), *(one.astype(float) for one in links))


def _largest(mask: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    parts = np.empty(mask.shape, np.int32)
    label(mask, output=parts)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    return np.asarray(binary_fill_holes(parts == int(sizes.argmax()))) if sizes.any() else np.zeros_like(mask)
