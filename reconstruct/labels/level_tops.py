"""Level tops of the object: parts that shade like the ground but stand above it, or differ from it in colour.

Light reflected by vertical faces onto the ground beside them also looks like height, but it fades with distance, while
a top ends in a step. Each part is therefore judged as a whole, by its height in sigmas and the step at its outline.

Height from fall-off. The top of a box faces up like the ground, and a near light's irradiance differs there by a few
per cent: too little for one sample of unknown albedo, enough for all lit photos of a few pixels together. With
r_k = log(I_k / (albedo E_k)) and s_k = d log E_k / dh along the pixel's ray, lit samples obey r_k = a + h s_k.
Directional lights have s_k = 0: they give no information about heights.
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import interpolate

from reconstruct.labels.outline import local_mean, reaches_border
from reconstruct.scene import Scene, grey_irradiance, ground_points

LIT_BAND = 0.12  # a sample this close to what the height fitted so far predicts, as a logarithm, is lit
FALL_OFF_ROUNDS = 3  # of the fit: the first loses the lit samples that a great height moves out of the band
SLOPE_STEP = 8  # px: s_k changes slowly over the picture
LIFT = 0.005  # of the camera's height: the step of the finite difference
FLATTEST = 1e-3  # s_k, root mean square over the lit photos: smaller ones do not determine a height
FEWEST_LIT = 5.0  # lit samples of a pixel: two unknowns, and residuals to estimate sigma
WINDOW = 1 / 256  # of the picture's longer side: radius of the pixels that are fitted together
AROUND = 0.25  # of the found object's box: how far beyond it its other parts are looked for
ROUNDS = 3  # of that, while parts go on beyond
LEVELS = (0.0045, 0.0067, 0.01, 0.015, 0.0225, 0.034, 0.05, 0.075)  # of the camera's height: a top's outline, maybe
OUTLINE = 3  # px beyond the blur of the window, where the two sides of an outline are compared
LARGE_STEP, SOME_STEP = 0.5, 0.3  # of a part's height, at its outline
SURE_SIGMAS, DOUBTFUL_SIGMAS = 4.0, 3.0  # bounced light was seen to reach 2.7
LOW, LOW_SIGMAS = 0.01, 8.0  # below that contour, where gloss on wood was seen to reach 6.6 with a step
HALF = 0.5  # of its height: where the outline of a blurred step is
FEWEST_PIXELS = 0.005  # of the object, in a part that is judged
FREE_OUTLINE = 0.1  # of a part's outline on ground: with less no step can be seen
HUE_BAND, ALBEDO_BAND = 0.12, 0.4  # relative to the ground's: bounced light changes its colour less
STRANGE_SIGMAS = 4.0  # of the ground's own spread, by the median absolute deviation
COLOUR_STEP = 3  # the ground's colour is estimated from every third pixel
TOUCHING = 0.2  # of a strange part's outline on the object: else it is a stain
ENCLOSED = 0.5  # of it, where heights are unknown: else it is a sheet or a mat that the object stands on


@dataclass(frozen=True)
class Heights:
    """Height above the ground along each pixel's ray, as a share of the camera's; sigma is inf where it is unknown."""

    height: Float[Tensor, "height width"]
    sigma: Float[Tensor, "height width"]


def heights_from_fall_off(
    relative: Float[Tensor, "photos height width"],
    seen: Bool[Tensor, "photos height width"],
    slope: Float[Tensor, "photos height width"],
    pooled: Bool[Tensor, "height width"],
    radius: int,
) -> Heights:
    """Fit r_k = a + h s_k to the lit samples by least squares, with a per pixel and h per window.

    Sigma comes from the residuals of the fit, so that it includes light errors, noise and bounced light.

    Args:
        slope: s_k, see slopes.
        pooled: pixels whose samples are also used for their neighbours.
        radius: of the window, px.
    """
    logs = relative.clamp(min=1e-6).log()
    offset, height, window = torch.zeros(pooled.shape), torch.zeros(pooled.shape), 2 * radius + 1
    allowed = seen & pooled
    r = s = logs
    count = power = offset
    for _ in range(FALL_OFF_ROUNDS):
        lit = (allowed & ((logs - offset - height * slope).abs() < LIT_BAND)).float()
        count = lit.sum(0)
        share = lit / count.clamp(min=1)
        mean_log, mean_slope = (share * logs).sum(0), (share * slope).sum(0)
        r = local_mean(lit * (logs - mean_log), window)
        s = local_mean(lit * (slope - mean_slope), window)
        power = (s * s).sum(0).clamp(min=1e-20)
        height = (r * s).sum(0) / power
        offset = mean_log - height * mean_slope
    total, pixels = local_mean(torch.stack([count, (count > 0).float()]), window)
    photos = total / pixels.clamp(min=1e-6)
    left = ((r - height * s) ** 2).sum(0) / (photos - 2).clamp(min=1)
    known = (photos >= FEWEST_LIT) & (power > (FLATTEST * pixels) ** 2 * photos)
    return Heights(height, torch.where(known, (left / power).sqrt(), torch.inf))


def slopes(scene: Scene, box: tuple[slice, slice]) -> Float[Tensor, "photos height width"]:
    """Return d log E_k / dh along each pixel's ray at the ground, h in camera heights; 0 if it meets no ground.

    Args:
        box: rows and columns of the pixels.
    """
    points, rays = ground_points(scene)[box], scene.directions[box]
    size = points.shape[:2]
    rows, columns = (torch.linspace(0, n - 1, n // SLOPE_STEP + 2).round().long() for n in size)
    points, rays = (x[rows][:, columns].reshape(-1, 3) for x in (points, rays))
    lift = LIFT * (scene.eye[2] - scene.ground_height)

    def seen(at: Tensor) -> Tensor:
        towards, strength = grey_irradiance(scene, at)
        return strength * towards[..., 2] + scene.ambient.mean()

    slope = (seen(points + lift * rays / rays[:, 2:]) / seen(points)).log() / LIFT
    slope = torch.nan_to_num(slope, 0.0, 0.0, 0.0).reshape(len(slope), 1, len(rows), len(columns))
    return interpolate(slope, size, mode="bilinear", align_corners=True)[:, 0]


@dataclass(frozen=True)
class LevelTops:
    """Pixels outside the found object that shade like ground."""

    sure: Bool[Tensor, "height width"]  # object
    doubtful: Bool[Tensor, "height width"]  # object or ground


@dataclass(frozen=True)
class _Surroundings:
    """The object's box with a margin, as arrays."""

    height: Float[np.ndarray, "h w"]  # above the ground at the border of the box, of the camera's height
    sigma: Float[np.ndarray, "h w"]
    region: Bool[np.ndarray, "h w"]  # found object
    radius: int  # of the window of the heights, px

    @cached_property
    def open(self) -> Bool[np.ndarray, "h w"]:
        """Return the free pixels connected to the border of the box, i.e. not enclosed by the found object."""
        _, labels = cv2.connectedComponents((~self.region).astype(np.uint8), connectivity=4)
        border = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
        return self.free & np.isin(labels, border[border > 0])

    @property
    def free(self) -> Bool[np.ndarray, "h w"]:
        """Return the pixels of known height outside the found object."""
        return ~self.region & np.isfinite(self.sigma)


def find_level_tops(
    scene: Scene,
    relative: Float[Tensor, "photos height width"],
    seen: Bool[Tensor, "photos height width"],
    albedo: Float[Tensor, "height width 3"],
    region: Bool[Tensor, "height width"],
) -> LevelTops:
    """Find parts of the object beside the region already found; none without such a region or on uneven ground.

    Directional lights give no heights: a part of another colour is then doubtful if object pixels enclose it.

    Args:
        relative: brightness over that of lit ground with the pixel's own albedo.
        seen: samples well above the noise.
        albedo: of each pixel if it is ground, 0 where unknown.
        region: pixels found to be object.
    """
    sure, doubtful = torch.zeros_like(region), torch.zeros_like(region)
    if scene.ground_depth is not None or not region.any():
        return LevelTops(sure, doubtful)
    radius = max(1, round(WINDOW * max(region.shape)))
    unlike = _unlike_ground(albedo.numpy(), region.numpy())
    for _ in range(ROUNDS):
        box = _box_around(region | sure | doubtful, radius)
        found = heights_from_fall_off(relative[:, *box], seen[:, *box], slopes(scene, box), ~region[box], radius)
        around = _above_ground(found, region[box], radius)
        raised, maybe = _raised(around)
        strange, strange_maybe = _strange(around, unlike[box])
        sure[box] = torch.from_numpy(raised | strange)
        doubtful[box] = torch.from_numpy((maybe | strange_maybe) & ~raised & ~strange)
        if not reaches_border((sure | doubtful)[box]):
            break
    return LevelTops(sure, doubtful)


def _above_ground(found: Heights, region: Bool[Tensor, "h w"], radius: int) -> _Surroundings:
    """Return heights relative to the box's border, because the lights' gains were fitted to level tops as well."""
    border = torch.ones_like(region)
    border[OUTLINE:-OUTLINE, OUTLINE:-OUTLINE] = False
    known = found.height[border & found.sigma.isfinite()]
    base = float(known.median()) if len(known) else 0.0
    return _Surroundings((found.height - base).numpy(), found.sigma.numpy(), region.numpy(), radius)


def _box_around(region: Bool[Tensor, "height width"], radius: int) -> tuple[slice, slice]:
    places = torch.nonzero(region)
    low, high = places.min(0).values, places.max(0).values + 1
    pad = int(AROUND * float((high - low).max())) + 4 * (radius + OUTLINE)
    low, high = (low - pad).clamp(min=0), torch.minimum(high + pad, torch.tensor(region.shape))
    return slice(int(low[0]), int(high[0])), slice(int(low[1]), int(high[1]))


def _raised(around: _Surroundings) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Find sure and doubtful parts among the regions that each height contour encloses."""
    sure, doubtful = np.zeros_like(around.region), np.zeros_like(around.region)
    for level in LEVELS:
        for part in _pieces(around.free & (around.height > level), around):
            typical = float(np.median(around.height[part]))
            sigmas = typical / float(np.median(around.sigma[part]))
            step = _step(part, around)
            ends = HALF if step is None else step / typical  # enclosed by object pixels: only its sigmas decide
            part &= around.height > HALF * typical
            if sigmas > (SURE_SIGMAS if level >= LOW else LOW_SIGMAS) and ends >= LARGE_STEP:
                sure |= part
            elif level >= LOW and sigmas > DOUBTFUL_SIGMAS and ends > SOME_STEP:
                doubtful |= part
    return sure, doubtful


def _unlike_ground(
    albedo: Float[np.ndarray, "height width 3"], region: Bool[np.ndarray, "height width"]
) -> Bool[np.ndarray, "height width"]:
    """Find pixels whose hue or brightness is far from the ground's; most pixels outside the region are ground."""
    known = ~region & (albedo.sum(-1) > 0)
    grey = albedo.mean(-1, keepdims=True)
    unlike = np.zeros_like(known)
    picked = np.zeros_like(known)
    picked[::COLOUR_STEP, ::COLOUR_STEP] = known[::COLOUR_STEP, ::COLOUR_STEP]
    if not picked.any():
        return unlike
    for values, band in ((albedo / np.maximum(grey, 1e-9), HUE_BAND), (grey, ALBEDO_BAND)):
        usual = np.median(values[picked], axis=0)
        spread = 1.48 * np.median(np.abs(values[picked] - usual), axis=0)
        unlike |= (np.abs(values - usual) > np.maximum(band * usual, STRANGE_SIGMAS * spread)).any(-1)
    return unlike & known


def _strange(
    around: _Surroundings, unlike: Bool[np.ndarray, "h w"]
) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Find parts beside the object that differ in colour from the ground.

    They are sure with a step in height, doubtful if they may be high. The outline comes from the colour and not from
    the height, so the step alone decides, whatever bounced light adds.
    """
    sure, doubtful = np.zeros_like(around.region), np.zeros_like(around.region)
    for part in _pieces(unlike & ~around.region, around):
        ring = _grown(part, 2) & ~part
        touching = (ring & around.region).sum() / ring.sum()
        known = part & around.free
        if not known.any():
            doubtful |= part & (touching > ENCLOSED)
        elif touching > TOUCHING:
            typical, sigma = float(np.median(around.height[known])), float(np.median(around.sigma[known]))
            step = _step(part, around)
            if typical > LOW and step is not None and step > LARGE_STEP * typical:
                sure |= part
            elif typical + DOUBTFUL_SIGMAS * sigma > LOW:  # else it lies on the ground: a sheet or a mat
                doubtful |= part
    return sure, doubtful


def _pieces(image: Bool[np.ndarray, "h w"], around: _Surroundings) -> list[Bool[np.ndarray, "h w"]]:
    """Return the connected parts that are large enough to be judged."""
    opened = cv2.morphologyEx(image.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(opened, connectivity=4)
    fewest = max(FEWEST_PIXELS * around.region.sum(), (2 * around.radius + 1) ** 2)
    return [labels == i for i in range(1, count) if stats[i, cv2.CC_STAT_AREA] >= fewest]


def _step(part: Bool[np.ndarray, "h w"], around: _Surroundings) -> float | None:
    """Return the drop in height across a part's outline, where ground lies beyond; None if too little ground is seen.

    Pixels that the object encloses do not count as ground: they may be another part of the same top.
    """
    blur = 2 * around.radius
    ring = _grown(part, blur + OUTLINE) & ~_grown(part, blur)
    outside = ring & around.open
    inside = part & around.free & _grown(outside, 2 * blur + OUTLINE)
    if outside.sum() < FREE_OUTLINE * ring.sum() or not inside.any():
        return None
    return float(np.median(around.height[inside]) - np.median(around.height[outside]))


def _grown(image: Bool[np.ndarray, "h w"], by: int) -> Bool[np.ndarray, "h w"]:
    return cv2.dilate(image.astype(np.uint8), np.ones((2 * by + 1,) * 2, np.uint8)) > 0
