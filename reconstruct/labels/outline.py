"""Clean object regions from likely object pixels, and means over windows of pictures."""

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

SMALLEST_PART = 0.02  # of the largest region: smaller ones are stains, highlights or noise
SMALLEST_OBJECT = 0.001  # of the picture: nor is less the object where something so much larger is cut by the frame
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
