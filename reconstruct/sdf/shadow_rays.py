"""Visibility of lights from points of a solved scene whose object casts shadows."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.rays import visibility

LIFT_VOXELS = 1.0  # shadow rays start this far above the object: its own roughness casts no shadow
SHARPNESS_PER_VOXEL = 8.0  # NeuS s of a shadow's edge: 10 % to 90 % within half a voxel
RAYS_PER_BATCH = 2**20  # about 80 MB of rays at a time


def shadow_starts(
    grid: SdfGrid, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], is_object: Bool[Tensor, " n"]
) -> Float[Tensor, "n 3"]:
    """Return the starts of shadow rays, world: slightly above the object, and on the ground itself, which is exact.

    Args:
        points: world.
        normals: unit, world.
    """
    return points + (LIFT_VOXELS * grid.spacing * is_object)[:, None] * normals


def unshadowed(
    grid: SdfGrid, starts: Float[Tensor, "n 3"], lights: Float[Tensor, "lights 4"]
) -> Float[Tensor, "lights n"]:
    """Return the share of each homogeneous world light that reaches each point, in [0, 1]; rays run in batches."""
    out = torch.empty(len(lights), len(starts))
    together = max(1, RAYS_PER_BATCH // max(1, len(starts)))
    for first in range(0, len(lights), together):
        some = lights[first : first + together]
        for block in range(0, len(starts), RAYS_PER_BATCH):
            part = starts[block : block + RAYS_PER_BATCH]
            rays = part.repeat(len(some), 1), some.repeat_interleave(len(part), 0)
            seen = visibility(grid, *rays, SHARPNESS_PER_VOXEL / grid.spacing)
            out[first : first + together, block : block + RAYS_PER_BATCH] = seen.reshape(len(some), len(part))
    return out
