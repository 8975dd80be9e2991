"""Colour photos of an object of which no ground is known: what takes the place of the ground test."""

import cv2
import numpy as np
import torch
from jaxtyping import Float
from skimage.filters import threshold_otsu
from torch import Tensor

from reconstruct.labels.ground_test import GroundTest
from reconstruct.labels.photometric_stereo import DEFAULT_NOISE
from reconstruct.scene import Scene

LIT_QUANTILE = 0.8  # over photos: what a pixel shows when it is lit
DARKEST = 1e-4  # linear: below, 8-bit photos hold only noise
IN_THE_DARK = 0.06  # of the object's brightness: a background this dark is none that light falls on
FEWEST = 0.02  # of the picture: a smaller bright part is a highlight or a lamp
SPECK = 0.05  # of the largest bright part: smaller ones are noise
HOLE = 0.002  # of the object: larger ones show the background


def no_ground(scene: Scene) -> GroundTest:
    """A ground test that finds no ground: the object is scene.mask, or what is bright before a dark background, or all
    of the picture. Nothing is known of light that comes from below."""
    assert scene.rgb is not None
    shape = scene.rgb.shape[:3]
    mask = scene.mask if scene.mask is not None else bright_object(scene.rgb)
    nothing = torch.zeros(shape)
    return GroundTest(
        mask=mask,
        mask_confidence=torch.ones(shape[1:]),
        visibility=nothing,
        confidence=nothing,
        albedo=torch.zeros(*shape[1:], 3),
        gain=torch.ones(shape),
        noise=DEFAULT_NOISE,
    )


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
