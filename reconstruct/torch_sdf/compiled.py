"""Rays through a level set by compiled kernels, as operators of torch's autograd, on the CPU. Grid frame, voxels.

Forward marches or samples, backward spreads over the nodes: straight into the sums of the level set, a part for each
core, so that nothing of the grid's size is made. Positions along rays are constants, see reconstruct/sdf/kernels.py.
"""

from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from reconstruct.sdf import kernels
from reconstruct.sdf.blocks import overlapping
from reconstruct.sdf.level_set import BAND, LevelSet
from reconstruct.sdf.rays import PerThread, run


class _Found(NamedTuple):
    """What a march found on each ray: the kernels' argument `found`."""

    minima: Int[np.ndarray, " n"]  # how many
    log_t: Float[np.ndarray, " n"]
    best: Float[np.ndarray, "n 2"]  # parameter and value of the least SDF
    lows: Float[np.ndarray, "n k 2"]  # the same of the minima
    highs: Float[np.ndarray, "n k 2"]  # and of the maximum before each


class CompiledRays:
    """RayField of a level set on the CPU, as the surface is now."""

    real = torch.float64

    def __init__(self, surface: LevelSet):
        self.blocks = overlapping(surface.field)
        shape = (*surface.field.pool.shape, 2)
        self.sums = PerThread(part.numpy().reshape(shape) for part in surface.gathered)
        self._surface = torch.zeros((), requires_grad=True)  # what all results depend on; its own gradient is none

    def gradient(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """See RayField."""
        out = torch.empty(len(points), 3)
        run(kernels.gradients, len(points), self.blocks, points.numpy(), 0.5, out.numpy())
        return out.to(self.real)

    def sample(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """See RayField."""
        return _Sample.apply(self._surface, points, self)

    def march(
        self,
        origins: Float[Tensor, "n 3"],
        lights: Float[Tensor, "n 5"],
        sharpness: float,
        jitter: Float[Tensor, " n"],
        far: Float[Tensor, " n"] | None = None,
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """See RayField."""
        far = torch.full_like(jitter, kernels.NEVER) if far is None else far
        return _March.apply(self._surface, origins, lights, far, jitter, sharpness, self)


class _Sample(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, surface: Tensor, points: Float[Tensor, "n 3"], field: CompiledRays) -> Float[Tensor, " n"]:
        ctx.field, ctx.points = field, points
        out = torch.empty(len(points), dtype=field.real)
        run(kernels.samples, len(points), field.blocks, points.numpy(), out.numpy())
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Float[Tensor, " n"]) -> tuple[None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        amounts, field = upstream[0].contiguous().numpy(), ctx.field
        run(kernels.scatter, len(amounts), field.blocks, field.sums, BAND, ctx.points.numpy(), amounts)
        return None, None, None


class _March(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        surface: Tensor,
        origins: Float[Tensor, "n 3"],
        lights: Float[Tensor, "n 5"],
        far: Float[Tensor, " n"],
        jitter: Float[Tensor, " n"],
        sharpness: float,
        field: CompiledRays,
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        n, k = len(origins), kernels.MAX_MINIMA
        starts, ends = (x.contiguous().numpy() for x in (origins, lights))
        rays, extrema = np.empty((n, 4)), (np.empty((n, k, 2)) for _ in range(2))
        found = _Found(np.empty(n, np.int64), np.empty(n), np.empty((n, 2)), *extrema)
        run(kernels.march, n, field.blocks, starts, ends, far.numpy(), sharpness, jitter.numpy(), rays, found)
        is_clear = (found.minima == 0) & (found.best[:, 0] > 0) & (found.best[:, 1] < BAND)
        ctx.kept = field, sharpness, is_clear, (starts, rays, found)
        return torch.from_numpy(found.log_t), torch.from_numpy(np.where(is_clear, found.best[:, 1], 0.0))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Float[Tensor, " n"]) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        field, sharpness, is_clear, marched = ctx.kept
        of_log, of_least = (x.contiguous().numpy() for x in upstream)
        n = len(of_log)
        back, light = np.empty((n, 3)), np.empty((n, 5))
        slopes = (of_log, np.where(is_clear, of_least, 0.0))
        run(kernels.scatter_march, n, field.blocks, field.sums, BAND, sharpness, *slopes, *marched, back, light)
        return None, torch.from_numpy(back), torch.from_numpy(light), None, None, None, None
