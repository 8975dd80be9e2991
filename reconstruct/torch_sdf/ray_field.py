"""What the solver asks of a surface: its SDF at points, and how much light passes along rays, differentiable by torch.

Two implementations, in the grid frame, voxels. CompiledRays: kernels on the CPU as operators of torch's autograd.
Forward marches or samples, backward spreads over the nodes, straight into the sums of the level set, a part for each
core, so that nothing of the grid's size is made. Positions along rays are constants, see reconstruct/sdf/kernels.py.
DenseRays: the same by plain torch, on any device. Its gradients are multiples of QUANTUM and summed in float64. This
is exact, so that neither the order of a device's additions nor the number of rays at once changes a bit of the result.
"""

from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from reconstruct.sdf import kernels
from reconstruct.sdf.blocks import SIDE, Blocks, overlapping
from reconstruct.sdf.level_set import BAND, LevelSet
from reconstruct.sdf.rays import PerThread, run
from reconstruct.torch_sdf.autograd import DifferentiableSdf, march
from reconstruct.torch_sdf.march import Volume

QUANTUM = 2.0**-28  # of the gradients: 4e-9, far below the smallest one that counts (1e-6)


class DenseRays:
    """RayField of a level set on a torch device, as the surface is now; all nodes of its box are in memory."""

    def __init__(self, surface: LevelSet, real: torch.dtype | None = None):
        """Spread the stored blocks over the box.

        Args:
            real: type of positions along rays; by default float64 on the CPU and float32 elsewhere.
        """
        values, device, field = surface.values, surface.values.device, surface.field
        self.blocks = overlapping(field)
        self.real = real or (torch.float64 if device.type == "cpu" else torch.float32)
        layout = torch.from_numpy(field.layout).to(device)
        beyond = values.new_tensor([field.far, -field.far])
        index = torch.where(layout < 0, len(values) // SIDE**3 + (layout & 1), layout).long()
        blocks = torch.cat([values.view(-1, SIDE**3), beyond[:, None].expand(2, SIDE**3)])
        places = torch.arange(len(values), device=device).view(-1, SIDE**3)
        none = torch.full((2, SIDE**3), len(values), device=device)
        whole, stored = (_in_box(x[index], field.nodes) for x in (blocks, torch.cat([places, none])))
        # Leaves of autograd, both 0: a change of phi, and what receives the absolute values of its gradients. Theirs
        # are the sums of the surface.
        leaves = [torch.zeros(len(values), dtype=torch.float64, device=device) for _ in range(2)]
        for leaf, sums in zip(leaves, surface.gathered[0].unbind(1), strict=True):
            leaf.requires_grad_().grad = sums
        volume = Volume.of(whole.to(self.real), stored.reshape(-1))
        self.sdf = DifferentiableSdf(volume, leaves[0], leaves[1], QUANTUM)

    def gradient(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """See RayField."""
        return self.sdf.volume.gradient(points)

    def sample(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """See RayField."""
        return self.sdf.sample(points)

    def march(
        self,
        origins: Float[Tensor, "n 3"],
        lights: Float[Tensor, "n 4"],
        sharpness: float,
        jitter: Float[Tensor, " n"],
        far: Float[Tensor, " n"] | None = None,
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """See RayField."""
        rays = march(self.sdf, origins, lights, sharpness, jitter, far)
        found = rays.found
        clear = ((found.count == 0) & (found.best_t > 0) & (found.best_f < BAND)).nonzero()[:, 0]
        least = torch.zeros_like(found.best_f).index_put((clear,), rays.sample(clear, found.best_t[clear]))
        return rays.log_transmittance(sharpness, from_surface=True), least


def _in_box(blocks: Tensor, nodes: tuple[int, int, int]) -> Tensor:
    """Return the values of blocks at the nodes of their box, (bx, by, bz, SIDE^3) to (nx, ny, nz)."""
    bx, by, bz, _ = blocks.shape
    whole = blocks.view(bx, by, bz, SIDE, SIDE, SIDE).permute(0, 3, 1, 4, 2, 5)
    return whole.reshape(bx * SIDE, by * SIDE, bz * SIDE)[tuple(slice(n) for n in nodes)].contiguous()


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
        lights: Float[Tensor, "n 4"],
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
        lights: Float[Tensor, "n 4"],
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
        back = np.empty((n, 3))
        slopes = (of_log, np.where(is_clear, of_least, 0.0))
        run(kernels.scatter_march, n, field.blocks, field.sums, BAND, sharpness, *slopes, *marched, back)
        return None, torch.from_numpy(back), None, None, None, None, None


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
        lights: Float[Tensor, "n 4"],
        sharpness: float,
        jitter: Float[Tensor, " n"],
        far: Float[Tensor, " n"] | None = None,
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """Return log T of each ray, and the least SDF of those without an extremum, where T = 1 to rounding; else 0.

        Both are differentiable with respect to the nodes and the origins.

        Args:
            lights: homogeneous.
            sharpness: NeuS s per voxel.
            jitter: share of the first step that is taken.
            far: length at which each ray ends; by default at its light.
        """
        ...


def ray_field(surface: LevelSet) -> RayField:
    """Return a level set's rays: by compiled kernels, or on its torch device."""
    return CompiledRays(surface) if surface.device is None else DenseRays(surface)
