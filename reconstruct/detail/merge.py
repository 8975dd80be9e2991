"""Merge normals from shading with those of a solved surface: coarse shape from the surface, fine relief from shading.

Errors of lights and interreflection bend photometric normals smoothly over wide areas; a grid loses relief as small
as its cells. So the rotation from the smoothed photometric normals to the equally smoothed surface normals is applied
to the photometric normals [Nehab et al. 2005, Efficiently combining positions and normals, section 3]. A large
disagreement is attributed to the surface, and the rotation is limited.
"""

import math

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from reconstruct.detail.surface import SeenSurface

SMOOTH_VOXELS = 3.0  # sigma: a grid's normals are right from a few cells on
DOUBT_ANGLE = math.radians(20)  # disagreement of which half is attributed to the surface
SAMPLES_PER_SIGMA = 4.0  # of a picture that is reduced before it is smoothed
DUST = 1e-3  # trust of pixels without any, so that their smoothed normal is defined


def merged(
    seen: SeenSurface, photometric: Float[Tensor, "n 3"], trust: Float[Tensor, " n"], spacing: float
) -> Float[Tensor, "n 3"]:
    """Return merged unit normals, world; those of the surface where the photometric ones have no trust.

    Args:
        trust: in [0, 1].
        spacing: of the surface's grid, world length.
    """
    sigma = SMOOTH_VOXELS * spacing / seen.footprint
    weight = trust + DUST
    coarse, wanted = (smoothed(seen, normals * weight[:, None], sigma) for normals in (photometric, seen.normals))
    out = torch.empty_like(photometric)
    for part in torch.arange(len(out)).split(2**18):
        axis = torch.linalg.cross(coarse[part], wanted[part])
        sine = torch.linalg.vector_norm(axis, dim=-1, keepdim=True)
        angle = torch.atan2(sine, (coarse[part] * wanted[part]).sum(-1, keepdim=True))
        turned = rotated(photometric[part], axis / sine.clamp(min=1e-9), angle / (1 + (angle / DOUBT_ANGLE) ** 2))
        out[part] = normalize(torch.lerp(seen.normals[part], turned, trust[part, None]), dim=-1)
    return out


def rotated(
    vectors: Float[Tensor, "n 3"], axis: Float[Tensor, "n 3"], angle: Float[Tensor, "n 1"]
) -> Float[Tensor, "n 3"]:
    """Rotate vectors about unit axes by angles (rad), with Rodrigues' formula."""
    along = (axis * vectors).sum(-1, keepdim=True) * axis
    return along + (vectors - along) * angle.cos() + torch.linalg.cross(axis, vectors) * angle.sin()


def smoothed(seen: SeenSurface, vectors: Float[Tensor, "n 3"], sigma: float) -> Float[Tensor, "n 3"]:
    """Smooth vectors over pixels with a Gaussian, and normalise them.

    Args:
        sigma: px; for a large one, a reduced picture is smoothed.
    """
    out = torch.empty_like(vectors)
    shrink = max(1, int(sigma / SAMPLES_PER_SIGMA))
    size = (-(-seen.window.width // shrink), -(-seen.window.height // shrink))
    full = (seen.window.width, seen.window.height)
    for axis in range(3):
        picture = seen.picture(np.asarray(vectors[:, axis]))
        if shrink > 1:
            picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        picture = cv2.GaussianBlur(picture, (0, 0), sigma / shrink)
        if shrink > 1:
            picture = cv2.resize(picture, full, interpolation=cv2.INTER_LINEAR)
        out[:, axis] = torch.from_numpy(picture.reshape(-1)[seen.index])
    return normalize(out, dim=-1)
