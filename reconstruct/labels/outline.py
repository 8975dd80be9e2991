"""Clean object regions from likely object pixels, means over windows, and the outline as a surface's shadows show it.

An outline that was found in shadow pictures is an estimate: a level top beside lit ground looks as that ground does. So
near the outline a pixel is as sure as its own labels make it, and the shadows that the object throws decide the rest:
with each better surface, every pixel is tried as ground and as the object that the surface shows there.
"""

import warnings
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt
from skimage.filters import threshold_otsu
from skimage.segmentation import random_walker
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, normalize

from calibration.ground.min_cut import cheapest_region
from calibration.ground.shadow_reach import shadow_reach
from reconstruct.scene import Scene, ground_points
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.rays import first_hits, visibility

SMALLEST_PART = 0.02  # of the largest region: smaller ones are stains, highlights or noise
SMALLEST_OBJECT = 0.001  # of the picture: nor is less the object where something so much larger is cut by the frame
UNSURE_REACH = 0.1  # of the picture: how far from a region unsure pixels may belong to it
EDGE_WEIGHT, WALK_TOLERANCE = 130.0, 1e-3  # of the random walk: exp(-130 * squared log contrast / its variance)
LARGEST_FILLED_HOLE = 0.01  # of the object: larger holes that pass as ground are openings, e.g. under a handle
UNSURE = 0.02  # of the picture's longer side: so far from an outline that shadows showed, a pixel may be either
SHARPNESS = 8.0  # NeuS s per voxel of the surface that pixels are tried on
SURELY = 0.1  # of the photos, and more than FEW: so many contradictions decide against a kind of pixel
FEW = 2
SOFT = 2.0  # NeuS s per voxel of the surface whose outline is tried: it may be off by half a voxel
BESIDE = ((0, 0), (0, 1), (1, 0), (0, -1), (-1, 0))  # px: whose shadows a pixel near an outline may show, too
FLIPPED = 0.02  # least share of the labels that may be wrong
SURE = 50.0  # log of the odds
FITS = 0.05  # of the labels, or one: what contradicts more is neither the object nor the ground
LEAVES = 0.29  # confidence below reconstruct.labels.supervision.SURE_ENOUGH: matter goes by shadow rays alone
LINK = 0.5  # log of the odds: what a pixel's side of an outline costs
MATCHES = 2  # shadows that fall on a pixel as they would on ground
LIT_QUANTILE = 0.8  # over photos: the value of a pixel when it is lit
DARKEST = 1e-4  # linear: below, 8-bit photos hold only noise
IN_THE_DARK = 0.06  # of the object's brightness: no light falls on a background this dark
FEWEST = 0.02  # of the picture: a smaller bright part is a highlight or a lamp
SPECK = 0.05  # of the largest bright part: smaller ones are noise
HOLE = 0.002  # of the object: larger ones show the background
REACH_STEP = 4  # px: each such pixel tells whether a shadow may reach the pixels around it


@dataclass(frozen=True)
class Outline:
    """What each pixel shows."""

    mask: Float[Tensor, "height width"]  # object coverage
    confidence: Float[Tensor, "height width"]  # 0: either


def unsure_outline(mask: Float[Tensor, "height width"]) -> Outline:
    """Return an outline that shadows showed, with nothing known beside it."""
    inside = (mask > 0.5).numpy()
    return Outline(torch.from_numpy(inside).float(), torch.from_numpy(~_near_edge(inside)).float())


def outline_of(scene: Scene, surface: SdfGrid, trust: Float[Tensor, "photos height width"]) -> Outline:
    """Return the outline of a surface, decided where the shadow pictures contradict or confirm it.

    A pixel is surely object if its labels contradict the shadows that would fall on ground there, and not those on the
    surface; surely ground if shadows fall on it as on ground. Other pixels near the outline are what their labels make
    likelier, see _odds_of_object, with an outline as short as these allow, and as sure as that; pixels whose labels
    contradict the surface stay undecided.

    Args:
        scene: shadow pictures on a known ground.
        surface: world frame.
        trust: of each label; those with 0 are not asked.
    """
    assert scene.shadow is not None
    shape, rays = scene.directions.shape[:2], scene.directions.reshape(-1, 3)
    ground = ground_points(scene).reshape(-1, 3)
    to_ground = torch.nan_to_num((ground - scene.eye).norm(dim=-1), nan=torch.inf)
    first = first_hits(surface, scene.eye, rays, to_ground)
    hit = first.on_object
    points = scene.eye + first.distance[hit, None] * rays[hit]
    asked = ((scene.shadow < 0.5).numpy(), (trust > 0).numpy())
    dark = asked[0]
    on_object, _ = _contradictions(scene, surface, points, hit.numpy(), asked)
    wanted = hit.numpy() | (dark.any(0).ravel() & np.isfinite(to_ground.numpy()))
    wanted &= np.isfinite(to_ground.numpy())
    on_ground, matches = _contradictions(scene, surface, ground[torch.from_numpy(wanted)], wanted, asked)
    many, seen = max(FEW, SURELY * len(dark)), hit.reshape(shape).numpy()
    is_object = (on_ground > many) & (~seen | (on_object < on_ground))
    is_ground = (matches >= MATCHES) & (on_ground < FEW) & (~seen | (on_object > on_ground))
    near = _near_edge(seen)
    rest = ~near & (seen | wanted.reshape(shape))
    wrong = float(np.where(seen, on_object, on_ground)[rest].sum() / max(1, (asked[1] & rest).sum()))
    tried = near & np.isfinite(to_ground.numpy()).reshape(shape)
    odds = _odds_of_object(scene, surface, first.distance, (seen, tried), asked, max(FLIPPED, wrong))
    odds = np.where(is_object, SURE, np.where(is_ground, -SURE, odds))
    links = (np.full(one.shape, LINK) for one in (odds[:, 1:], odds[1:]))
    mask = np.where(odds == 0, seen, cheapest_region(odds, *links))
    unsure = near | (seen & (on_object > many))
    partly = np.where(tried, np.tanh(np.abs(odds) / 2), 0) * np.where(seen & ~mask, LEAVES, 1)
    confidence = np.where(is_object | is_ground | ~unsure, 1, partly)
    return Outline(torch.from_numpy(mask).float(), torch.from_numpy(confidence).float())


def _odds_of_object(
    scene: Scene,
    surface: SdfGrid,
    distance: Float[Tensor, " pixels"],
    where: tuple[Bool[np.ndarray, "height width"], Bool[np.ndarray, "height width"]],
    asked: tuple[Bool[np.ndarray, "photos height width"], Bool[np.ndarray, "photos height width"]],
    flipped: float,
) -> Float[np.ndarray, "height width"]:
    """Return log p(labels | object) - log p(labels | ground) near an outline, 0 where neither fits; +-SURE elsewhere.

    log p(labels | X) = max over BESIDE of sum_k log p(label_k | X), with p of a lit label the transmittance from X to
    light k. X is the ground, or the point as far away as the surface at the nearest pixel that sees it. The largest
    counts, as shadows of either may be off by a pixel. A surface that is far off explains few labels either way.

    Args:
        distance: along each pixel's ray to the surface or the ground, world length.
        where: pixels that see the surface, and pixels that are tried.
        asked: per photo and pixel, if the label is dark, and if it is trusted.
        flipped: share of the labels that may be wrong.
    """
    seen, tried = where
    known = np.where(seen, SURE, -SURE)
    if not tried.any():
        return known
    ground = ground_points(scene).reshape(-1, 3)
    around = dilated(torch.from_numpy(tried), 3).numpy() & ground.isfinite().all(-1).numpy().reshape(seen.shape)
    place = torch.from_numpy(np.flatnonzero(around))
    nearest = np.asarray(distance_transform_edt(~seen, return_distances=False, return_indices=True))
    away = torch.from_numpy(distance.numpy().reshape(seen.shape)[tuple(nearest)][around])
    points = scene.eye + away[:, None] * scene.directions.reshape(-1, 3)[place]
    points = points + surface.spacing * normalize(surface.gradient(points), dim=-1)
    rows, columns = np.nonzero(tried)
    beside = [((rows - down) % len(seen), (columns - right) % seen.shape[1]) for down, right in BESIDE]
    odds = np.zeros((2, len(BESIDE), len(rows)))
    for light, dark, trusted in zip(scene.lights, *asked, strict=True):
        for at, sums in zip((points, ground[place].contiguous()), odds, strict=True):
            lit = np.full(seen.shape, 0.5)
            lit[around] = _transmittance(surface, light, at, SOFT).clip(flipped, 1 - flipped)
            for shown, own in zip(beside, sums, strict=True):
                own += trusted[tried] * np.log(np.where(dark[tried], 1 - lit[shown], lit[shown]))
    on_object, on_ground = odds.max(1)
    fits = np.maximum(on_object, on_ground) > max(1.0, FITS * len(scene.lights)) * np.log(flipped)
    known[tried] = np.where(fits, on_object - on_ground, 0)
    return known


def _contradictions(
    scene: Scene,
    surface: SdfGrid,
    points: Float[Tensor, "n 3"],
    where: Bool[np.ndarray, " pixels"],
    asked: tuple[Bool[np.ndarray, "photos height width"], Bool[np.ndarray, "photos height width"]],
) -> tuple[Float[np.ndarray, "height width"], Float[np.ndarray, "height width"]]:
    """Count the photos that contradict the shadows on each pixel's point, not only by a shadow's edge, and that match.

    Args:
        points: world, of the pixels in `where`.
        asked: per photo and pixel, if the label is dark, and if it is trusted.
    """
    inside = where.reshape(asked[0].shape[1:])
    wrong, matches = np.zeros(inside.shape), np.zeros(inside.shape)
    for light, seen, trusted in zip(scene.lights, *asked, strict=True):
        cast = _shadow(surface, light, points, where, seen)
        wrong += _contradicts(seen, cast) & trusted & inside
        matches += seen & cast & trusted & inside
    return wrong, matches


def wrong_labels(
    scene: Scene, surface: SdfGrid, points: Float[Tensor, "height width 3"]
) -> Bool[np.ndarray, "photos height width"]:
    """Return which labels of given shadow pictures a surface contradicts, not only by a pixel beside a shadow's edge.

    Args:
        surface: world frame.
        points: world, that each pixel sees; nan if nowhere.
    """
    assert scene.shadow is not None
    flat = points.reshape(-1, 3)
    where = flat.isfinite().all(-1)
    places, asked, wrong = flat[where].contiguous(), where.numpy(), []
    for light, picture in zip(scene.lights, scene.shadow, strict=True):
        seen = (picture < 0.5).numpy()
        wrong.append(_contradicts(seen, _shadow(surface, light, places, asked, seen)))
    return np.stack(wrong)


def _shadow(
    surface: SdfGrid,
    light: Float[Tensor, "4"],
    points: Float[Tensor, "n 3"],
    where: Bool[np.ndarray, " pixels"],
    seen: Bool[np.ndarray, "height width"],
) -> Bool[np.ndarray, "height width"]:
    """Return the shadow that a surface casts on the points of the pixels in `where`; as seen on the others."""
    shadow = seen.copy().ravel()
    shadow[where] = _transmittance(surface, light, points, SHARPNESS) < 0.5
    return shadow.reshape(seen.shape)


def _transmittance(
    surface: SdfGrid, light: Float[Tensor, "4"], points: Float[Tensor, "n 3"], per_voxel: float
) -> Float[np.ndarray, " n"]:
    """Return the transmittance from points, world, to one light. `per_voxel`: NeuS s."""
    return visibility(surface, points, light.expand(len(points), 4).contiguous(), per_voxel / surface.spacing).numpy()


def _contradicts(
    seen: Bool[np.ndarray, "height width"], cast: Bool[np.ndarray, "height width"]
) -> Bool[np.ndarray, "height width"]:
    """Return the pixels about which all of a shadow differs from what is seen."""
    window, image = np.ones((3, 3), np.uint8), cast.astype(np.uint8)
    return (seen & (cv2.dilate(image, window) == 0)) | (~seen & (cv2.erode(image, window) > 0))


def _near_edge(inside: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """Return the pixels within UNSURE of an outline."""
    reach = max(1, round(UNSURE * max(inside.shape)))
    window = np.ones((2 * reach + 1,) * 2, np.uint8)
    image = inside.astype(np.uint8)
    return cv2.dilate(image, window) > cv2.erode(image, window)


def object_region(
    likely: Bool[Tensor, "height width"], known: Bool[Tensor, "height width"]
) -> Bool[Tensor, "height width"]:
    """Return the object's pixels: regions of likely pixels, without specks, small holes and parts at the border.

    Args:
        likely: pixels that do not behave as ground.
        known: False for pixels that were not classified; they join the object only inside it.
    """
    smooth = _majority(likely)
    labels, sizes, touches = _regions(smooth)
    inner = sizes * ~touches
    least = min(SMALLEST_PART * sizes.max(initial=0), SMALLEST_OBJECT * likely.numel())
    wanted = inner if inner.max(initial=0) > least else sizes  # an object cut by the frame, if there is nothing else
    if wanted.max(initial=0) == 0:
        return torch.zeros_like(likely)
    kept = wanted >= max(SMALLEST_PART * wanted.max(), 4)
    region = kept[labels] & (labels > 0)
    holes, hole_sizes, hole_touches = _regions(torch.from_numpy(~region))
    doubtful = np.bincount(holes.ravel(), weights=(~known).numpy().ravel(), minlength=len(hole_sizes))
    small = hole_sizes <= LARGEST_FILLED_HOLE * region.sum()
    fill = ~hole_touches & (small | (doubtful > 0.5 * hole_sizes))
    fill[0] = False
    return torch.from_numpy(region | fill[holes])


def reaches_border(region: Bool[Tensor, "height width"]) -> bool:
    """Return whether a region reaches the picture's border."""
    return bool(region[0].any() or region[-1].any() or region[:, 0].any() or region[:, -1].any())


def may_hold_shadow(scene: Scene, region: Bool[Tensor, "height width"]) -> Bool[Tensor, "photos height width"]:
    """Return the ground on which the object's shadow may fall in each photo: what is dark elsewhere is not its shadow.

    Dark there are ground behind the flashlight, what lies beyond the table's edge, and shadows of other things. All of
    the picture is returned where the region is empty, or reaches its border: the rest of the object throws shadows too.

    Args:
        region: the object's pixels.
    """
    inside = region.numpy()
    points = ground_points(scene).double().numpy()
    outline = points[inside]
    outline = outline[np.isfinite(outline[:, 0])]
    if not len(outline) or reaches_border(region):
        return torch.ones(len(scene.lights), *region.shape, dtype=torch.bool)
    eye, lights = scene.eye.double().numpy(), scene.lights.double().numpy()
    reached = shadow_reach(eye, outline, lights, points[::REACH_STEP, ::REACH_STEP]).astype(np.uint8)
    size, around = inside.shape[::-1], np.ones((3, 3), np.uint8)  # and the pixels between those that were asked
    whole = [cv2.resize(cv2.dilate(one, around), size, interpolation=cv2.INTER_NEAREST) for one in reached]
    return torch.from_numpy(np.stack(whole) > 0)


def local_mean(images: Float[Tensor, "n height width"], window: int) -> Float[Tensor, "n height width"]:
    """Return the mean over a window of odd size around each pixel, zeros beyond the border; running sums in float64."""
    out = torch.empty(images.shape)
    for one, mean in zip(images.contiguous().numpy(), out.numpy(), strict=True):
        mean[...] = cv2.boxFilter(one, -1, (window, window), borderType=cv2.BORDER_CONSTANT)
    return out


def largest_near(image: Float[Tensor, "height width"], window: int) -> Float[Tensor, "height width"]:
    """Return the largest value within a window of odd size around each pixel; pixels beyond the border do not count."""
    return torch.from_numpy(cv2.dilate(image.contiguous().numpy(), np.ones((window, window), np.uint8)))


def dilated(image: Bool[Tensor, "height width"], window: int) -> Bool[Tensor, "height width"]:
    """Return the pixels with a true one within a window of odd size around them."""
    found = cv2.dilate(image.contiguous().numpy().astype(np.uint8), np.ones((window, window), np.uint8))
    return torch.from_numpy(found > 0)


def coarse_mean(images: Float[Tensor, "n height width"], window: int) -> Float[Tensor, "n height width"]:
    """Approximate local_mean on a grid four times coarser, for many images whose mean changes slowly."""
    size = images.shape[1:]
    small = avg_pool2d(images, 4, 4, 0, ceil_mode=True, count_include_pad=False)
    small = local_mean(small, 2 * (window // 8) + 1)
    return interpolate(small[None], size, mode="bilinear", align_corners=False)[0]


def _majority(likely: Bool[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
    return avg_pool2d(likely.float()[None], 3, 1, 1, count_include_pad=False)[0] > 0.5


def _regions(image: Bool[Tensor, "height width"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find connected regions: label of each pixel (0 = none), size of each label, and whether it touches the border."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(image.numpy().astype(np.uint8), connectivity=4)
    sizes = stats[:, cv2.CC_STAT_AREA].astype(float)
    sizes[0] = 0
    touches = np.zeros(count, bool)
    touches[np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))] = True
    return labels, sizes, touches


def share_of_region(
    photos: Float[Tensor, "photos height width"],
    region: Bool[Tensor, "height width"],
    unsure: Bool[Tensor, "height width"],
) -> Float[Tensor, "height width"]:
    """Return the probability that an unsure pixel belongs to a region; nan for all others, and far from the region.

    A pixel belongs to what its neighbours belong to unless an edge lies between them in some photo: the probability
    that a random walk from it meets the region before the sure pixels outside [Grady, PAMI 2006].

    Args:
        photos: linear, > 0.
        unsure: outside the region.
    """
    share = torch.full(region.shape, torch.nan)
    rows, columns = (torch.nonzero(region.any(axis)).flatten() for axis in (1, 0))
    if not unsure.any() or not len(rows):
        return share
    reach = round(UNSURE_REACH * max(region.shape))
    part = tuple(slice(max(0, int(at[0]) - reach), int(at[-1]) + reach + 1) for at in (rows, columns))
    inner = ~dilated(~region, 3)
    seeds = torch.where(inner, 1, torch.where(unsure | region, 0, 2))[part].numpy()
    if len(np.unique(seeds)) < 3:
        return share
    logs = photos[:, part[0], part[1]].log().movedim(0, -1).numpy()
    with warnings.catch_warnings():  # of probabilities that leave [0, 1] by the tolerance
        warnings.simplefilter("ignore")
        walk = random_walker(logs, seeds, EDGE_WEIGHT, "cg_j", WALK_TOLERANCE, channel_axis=-1, return_full_prob=True)
    assert walk is not None
    found = torch.from_numpy(walk[0]).float().clamp(0, 1)
    share[part] = torch.where(unsure[part], found, share[part])
    return share


def bright_object(rgb: Float[Tensor, "photos height width 3"]) -> Float[Tensor, "height width"]:
    """Coverage of an object that is lit before a dark background; 1 everywhere where there is no such background.

    The threshold is Otsu's (1979) on the logarithm of what a pixel shows when it is lit; small holes are dark paint.
    """
    lit = torch.quantile(rgb.mean(-1).flatten(1), LIT_QUANTILE, dim=0).reshape(rgb.shape[1:3]).numpy()
    level = np.log(np.maximum(cv2.medianBlur(lit.astype(np.float32), 3), DARKEST))
    if np.ptp(level) == 0:
        return torch.ones(rgb.shape[1:3])
    split = threshold_otsu(level)
    dark, light = (float(np.median(level[side])) for side in (level <= split, level > split))
    bright = level > (dark + light) / 2  # in the middle of the gap, not at its beginning
    if np.exp(dark - light) > IN_THE_DARK or bright.mean() < FEWEST:
        return torch.ones(rgb.shape[1:3])
    numbers = cv2.connectedComponents(bright.astype(np.uint8), connectivity=4)[1]
    sizes = np.bincount(numbers.ravel())
    sizes[0] = 0
    kept = np.isin(numbers, np.flatnonzero(sizes >= SPECK * sizes.max()))
    holes = cv2.connectedComponents((~kept).astype(np.uint8), connectivity=4)[1]
    small = np.flatnonzero(np.bincount(holes.ravel()) < HOLE * kept.sum())
    return torch.from_numpy((kept | np.isin(holes, small)).astype(np.float32))
