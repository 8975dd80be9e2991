"""Clean object regions from likely object pixels, and means over windows of pictures."""

import warnings

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from skimage.segmentation import random_walker
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d

SMALLEST_PART = 0.02  # of the largest region: smaller ones are stains, highlights or noise
SMALLEST_OBJECT = 0.001  # of the picture: nor is less the object where something so much larger is cut by the frame
UNSURE_REACH = 0.1  # of the picture: how far from a region unsure pixels may belong to it
EDGE_WEIGHT, WALK_TOLERANCE = 130.0, 1e-3  # of the random walk: exp(-130 * squared log contrast / its variance)
LARGEST_FILLED_HOLE = 0.01  # of the object: larger holes that pass as ground are openings, e.g. under a handle


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


def local_mean(images: Float[Tensor, "n height width"], window: int) -> Float[Tensor, "n height width"]:
    """Return the mean over a window of odd size around each pixel, zeros beyond the border; one axis at a time."""
    rows = avg_pool2d(images, (window, 1), 1, (window // 2, 0))
    return avg_pool2d(rows, (1, window), 1, (0, window // 2))


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
    inner = max_pool2d((~region).float()[None], 3, 1, 1)[0] == 0
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
