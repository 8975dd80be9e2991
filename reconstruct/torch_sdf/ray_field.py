"""What the solver asks of a surface: its SDF at points, and how much light passes along rays, differentiable by torch.

Two implementations: compiled kernels on the CPU, and plain torch on any device.
"""

from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from reconstruct.sdf.blocks import Blocks
from reconstruct.sdf.level_set import LevelSet
from reconstruct.torch_sdf.compiled import CompiledRays
from reconstruct.torch_sdf.dense import DenseRays


@runtime_checkable
class RayField(Protocol):
    """The surface of a level set as it is now, grid frame, voxels. A backward pass adds to the level set's sums."""

    real: torch.dtype  # of all tensors
    blocks: Blocks  # the SDF on the host

    def gradient(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Return central differences over one voxel, constants."""
        ...

    def sample(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """Return the SDF at constant points, differentiable with respect to the nodes."""
        ...

    def march(
        self,
        origins: Float[Tensor, "n 3"],
        lights: Float[Tensor, "n 5"],
        sharpness: float,
        jitter: Float[Tensor, " n"],
        far: Float[Tensor, " n"] | None = None,
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """Return log T of each ray, and the least SDF of those without an extremum, where T = 1 to rounding; else 0.

        Both are differentiable with respect to the nodes, the origins and the lights.

        Args:
            lights: homogeneous, and a fifth number, whose gradient gets the size of the gradient that moves the light.
            sharpness: NeuS s per voxel.
            jitter: share of the first step that is taken.
            far: length at which each ray ends; by default at its light.
        """
        ...


def ray_field(surface: LevelSet) -> RayField:
    """Return a level set's rays: by compiled kernels, or on its torch device."""
    return CompiledRays(surface) if surface.device is None else DenseRays(surface)
