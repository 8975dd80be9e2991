"""Coverage of outline pixels by the object (alpha matting): unmix each pixel into object and adjacent ground.

A pixel of the outline shows I_k = a O_k + (1 - a) G_k in every photo k and channel, with the same coverage a. O_k and
G_k come from clear pixels nearby. Two effects bias a plain least-squares fit. First, an object turns away at its
outline, so that its value there differs from that further inside; O_k is therefore extrapolated outwards. Second, at
the edge of a shadow, G_k or O_k beside the pixel differs from that in the pixel; the fit is therefore robust. It
tolerates samples darker than expected more than brighter ones, because shadows are common.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt
from torch import Tensor

REACH = 3.2  # px: clear object and ground are looked for this near
NEARER = 2.0  # px, sigma: nearer ones count more
CLEARANCE = 1.0  # px from the outline on either side: nearer pixels may be mixed
ON_OUTLINE = 0.5  # square root of px: where O is extrapolated to, the middle of the outer pixel's covered half
STEADY = 0.03  # px, ridge of the slope: none is read where all clear pixels are equally deep
MODEL_FLOOR, MODEL_SHARE = 3e-3, 0.02  # linear, and of the value: one sigma of the mixture model's error
DARKER, BRIGHTER = 4.0, 9.0  # squared sigmas at which a sample's cost is half way to its limit
COVERAGES = 11  # tried between 0 and 1: the robust cost has several minima
ROUNDS = 4  # of reweighting from the best of them
PASSES = 2  # the second with clear pixels about the outline that the first found
PIXELS_AT_ONCE, USUAL_PHOTOS = 1000, 40  # of the outline: 20 MB per array; of more photos, fewer pixels
DUST = 1e-12


@dataclass(frozen=True)
class _Around:
    """The window about each outline pixel."""

    row: Int[Tensor, "n window"]
    column: Int[Tensor, "n window"]
    on_object: Float[Tensor, "n window"]  # weight of clear object pixels
    on_ground: Float[Tensor, "n window"]
    depth: Float[Tensor, "n window"]  # square root of px inside the outline


def coverage_at_edges(
    photos: Float[Tensor, "photos height width channels"], region: Bool[Tensor, "height width"]
) -> Float[Tensor, "height width"]:
    """Return coverage in [0, 1]: 1 in the region, 0 outside, and fitted to the photos along its outline.

    Args:
        photos: linear colour, or brightness alone.
    """
    mask = region.float()
    for _ in range(PASSES):
        mask = _unmixed(photos, mask > 0.5)
    return mask


def _unmixed(photos: Tensor, region: Bool[Tensor, "height width"]) -> Float[Tensor, "height width"]:
    mask = region.float()
    if not region.any() or region.all():
        return mask
    inside = torch.from_numpy(distance_transform_edt(region.numpy())).float() - 0.5
    outside = torch.from_numpy(distance_transform_edt(~region.numpy())).float() - 0.5
    edge = torch.nonzero(((inside > 0) & (inside <= CLEARANCE)) | ((outside > 0) & (outside <= CLEARANCE)))
    for part in edge.split(max(1, PIXELS_AT_ONCE * USUAL_PHOTOS // max(USUAL_PHOTOS, len(photos)))):
        around = _around(part, inside, outside)
        known = (around.on_object.sum(1) > 0) & (around.on_ground.sum(1) > 0)
        row, column = part.unbind(1)
        found = _coverage(_looked_up(photos, around.row, around.column), _looked_up(photos, row, column), around)
        mask[row, column] = torch.where(known, found, mask[row, column])
    return mask


def _around(pixels: Int[Tensor, "n 2"], inside: Tensor, outside: Tensor) -> _Around:
    """Return the windows of the outline pixels; inside, outside: distance to the outline, px, positive on that side."""
    side = torch.arange(-int(REACH), int(REACH) + 1)
    down, right = (x.reshape(-1) for x in torch.meshgrid(side, side, indexing="ij"))
    square = down**2 + right**2
    near = square <= REACH**2
    weight = torch.exp(-square[near] / (2 * NEARER**2))
    row, column = pixels[:, :1] + down[near], pixels[:, 1:] + right[near]
    height, width = inside.shape
    weight = weight * ((row >= 0) & (row < height) & (column >= 0) & (column < width))
    row, column = row.clamp(0, height - 1), column.clamp(0, width - 1)
    depth = inside[row, column]
    return _Around(
        row,
        column,
        weight * (depth > CLEARANCE),
        weight * (outside[row, column] > CLEARANCE),
        depth.clamp(min=0).sqrt(),
    )


def _looked_up(
    photos: Float[Tensor, "photos height width channels"], row: Int[Tensor, "*places"], column: Int[Tensor, "*places"]
) -> Float[Tensor, " samples *places"]:
    """Return every channel of every photo at these pixels."""
    return photos[:, row, column].movedim(-1, 1).flatten(0, 1).contiguous()


def _coverage(
    seen: Float[Tensor, "samples n window"], value: Float[Tensor, "samples n"], around: _Around
) -> Float[Tensor, " n"]:
    """Find the a that minimises sum_k r_k^2 / (1 + r_k^2 / limit), r_k the residual of the mixture in sigmas."""
    inner, inner_square = _on_outline(seen, around)
    ground = _weighted_mean(seen, around.on_ground)
    ground_square = _weighted_mean((seen - ground[..., None]) ** 2, around.on_ground)
    own = MODEL_FLOOR**2 + (MODEL_SHARE * value) ** 2
    contrast = inner - ground

    def judged(share: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        variance = own + share**2 * inner_square + (1 - share) ** 2 * ground_square
        error = value - ground - share * contrast
        return variance, error**2 / variance, torch.where(error < 0, DARKER, BRIGHTER)

    tried = torch.linspace(0, 1, COVERAGES)
    costs = []
    for share in tried:
        _, squares, limit = judged(share)
        costs.append((squares / (1 + squares / limit)).sum(0))
    best = tried[torch.stack(costs).argmin(0)]
    for _ in range(ROUNDS):
        variance, squares, limit = judged(best)
        weight = 1 / ((1 + squares / limit) ** 2 * variance)
        power = (weight * contrast**2).sum(0)
        best = ((weight * (value - ground) * contrast).sum(0) / power.clamp(min=DUST)).clamp(0, 1)
    return best


def _on_outline(seen: Float[Tensor, "samples n window"], around: _Around) -> tuple[Tensor, Tensor]:
    """Extrapolate O to the outline, with its variance, by a line through clear object pixels over sqrt(depth).

    The normal of a round surface turns with the square root of the distance to its outline: sin = sqrt(2 d / radius).
    """
    mean, depth = _weighted_mean(seen, around.on_object), _weighted_mean(around.depth, around.on_object)
    away = around.depth - depth[:, None]
    spread = _weighted_mean(away**2, around.on_object)
    slope = _weighted_mean((seen - mean[..., None]) * away, around.on_object) / (spread + STEADY)
    there = (mean + slope * (ON_OUTLINE - depth)).clamp(min=0)
    left = _weighted_mean((seen - mean[..., None] - slope[..., None] * away) ** 2, around.on_object)
    return there, left + (0.5 * (there - mean)) ** 2


def _weighted_mean(values: Tensor, weight: Tensor) -> Tensor:
    return (values * weight).sum(-1) / weight.sum(-1).clamp(min=DUST)
