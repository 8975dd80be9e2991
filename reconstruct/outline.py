"""From pixels that are probably object to its outline: clean regions, and how much of each edge pixel they cover."""

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d

SMALLEST_PART = 0.02  # of the largest region: smaller ones are stains, highlights or noise
LARGEST_FILLED_HOLE = 0.01  # of the object: larger holes that pass as ground are openings, e.g. under a handle
EDGE_WINDOW = 7  # px: object and ground beside an edge pixel are looked for in such a window
EDGE_CLEARANCE = 2  # px from the edge: where pixels are surely all object or all ground


def object_region(
    likely: Bool[Tensor, "height width"], known: Bool[Tensor, "height width"]
) -> Bool[Tensor, "height width"]:
    """The object's pixels: regions of likely pixels without specks, small holes and what touches the border.

    Args:
        likely: pixels that do not behave as ground.
        known: False where nothing can be said; such pixels join the object only inside it.
    """
    smooth = _majority(likely)
    labels, sizes, touches = _regions(smooth)
    inner = sizes * ~touches
    wanted = inner if inner.max(initial=0) > 0 else sizes  # an object cut by the frame, if there is nothing else
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


def coverage_at_edges(
    photos: Float[Tensor, "photos height width"], region: Bool[Tensor, "height width"]
) -> Float[Tensor, "height width"]:
    """Coverage in [0, 1]: edge pixels are unmixed over all photos into the object and the ground beside them.

    a minimises sum_k (I_k - a O_k - (1 - a) G_k)^2, O and G the means over clear object and ground pixels nearby.
    """
    mask = region.float()
    if not region.any():
        return mask
    box = _bounding_box(region, EDGE_WINDOW)
    part, inside = photos[:, *box], mask[box]
    reach = 2 * EDGE_CLEARANCE - 1
    grown = max_pool2d(inside[None], reach, 1, EDGE_CLEARANCE - 1)[0]
    core = 1 - max_pool2d(1 - inside[None], reach, 1, EDGE_CLEARANCE - 1)[0]
    object_mean, has_object = _mean_around(part, core)
    ground_mean, has_ground = _mean_around(part, 1 - grown)
    contrast = object_mean - ground_mean
    power = (contrast**2).sum(0)
    share = ((part - ground_mean) * contrast).sum(0) / power.clamp(min=1e-12)
    is_edge = (grown > core) & has_object & has_ground & (power > 0)
    mask = mask.clone()
    mask[box] = torch.where(is_edge, share.clamp(0, 1), inside)
    return mask


def local_mean(images: Float[Tensor, "n height width"], window: int) -> Float[Tensor, "n height width"]:
    """Mean over a window of odd size around each pixel, zeros beyond the border; one axis at a time."""
    rows = avg_pool2d(images, (window, 1), 1, (window // 2, 0))
    return avg_pool2d(rows, (1, window), 1, (0, window // 2))


def coarse_mean(images: Float[Tensor, "n height width"], window: int) -> Float[Tensor, "n height width"]:
    """About local_mean, on a grid four times coarser: for many images whose mean changes slowly."""
    size = images.shape[1:]
    small = avg_pool2d(images, 4, 4, 0, ceil_mode=True, count_include_pad=False)
    small = local_mean(small, 2 * (window // 8) + 1)
    return interpolate(small[None], size, mode="bilinear", align_corners=False)[0]


def _majority(likely: Bool[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
    return avg_pool2d(likely.float()[None], 3, 1, 1, count_include_pad=False)[0] > 0.5


def _regions(image: Bool[Tensor, "height width"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Connected regions: label of each pixel (0 = none), size of each label, and whether it touches the border."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(image.numpy().astype(np.uint8), connectivity=4)
    sizes = stats[:, cv2.CC_STAT_AREA].astype(float)
    sizes[0] = 0
    touches = np.zeros(count, bool)
    touches[np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))] = True
    return labels, sizes, touches


def _bounding_box(region: Bool[Tensor, "height width"], margin: int) -> tuple[slice, slice]:
    rows, columns = torch.where(region.any(1))[0], torch.where(region.any(0))[0]
    return (
        slice(max(0, int(rows[0]) - margin), int(rows[-1]) + margin + 1),
        slice(max(0, int(columns[0]) - margin), int(columns[-1]) + margin + 1),
    )


def _mean_around(photos: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Mean over the pixels of weight 1 in a window, and whether there were any."""
    pad = EDGE_WINDOW // 2
    total = avg_pool2d(weight[None], EDGE_WINDOW, 1, pad)[0]
    return avg_pool2d(photos * weight, EDGE_WINDOW, 1, pad) / total.clamp(min=1e-6), total > 0
