"""Visibility along shadow rays, differentiable by torch on any device.

    grid = SdfGrid(values.requires_grad_(), origin, spacing)                # world frame
    seen = transmittance(grid, points, lights, sharpness=20 / spacing)      # one light per point
    shadow_loss(seen, label).mean().backward()                              # values.grad, points.grad, lights.grad

See examples/own_shadow_loss.py. `transmittance` is in the world frame; the solver on a GPU (DenseRays) uses
DifferentiableSdf and LightRays, in the grid frame. Tensors of one call share a device and a floating type, float32 or
float64.
"""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import logsigmoid

from reconstruct.scene import lights_in_frame
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.kernels import FAR
from reconstruct.torch_sdf.march import Volume
from reconstruct.torch_sdf.rays import BATCHES, Extrema, extrema, towards

LARGEST = 2.0**16  # bound of one amount that is rounded to a quantum: 2^9 of them on a node sum exactly in float64


class Sample(torch.autograd.Function):
    """Sample an SDF trilinearly; the backward pass sums the samples' gradients and their absolute values at the nodes.

    Use DifferentiableSdf.sample.
    """

    @staticmethod
    def forward(
        ctx: Any,
        values: Float[Tensor, "*nodes"],
        evidence: Float[Tensor, "*nodes"] | None,
        points: Float[Tensor, "n 3"],
        volume: Volume,
        quantum: float,
    ) -> Float[Tensor, " n"]:
        """Return the SDF at points, voxels."""
        ctx.save_for_backward(points)
        ctx.volume, ctx.quantum, ctx.like = volume, quantum, values.detach()
        return volume.sample(points)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Float[Tensor, " n"]) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return the gradients to values, evidence and points."""
        (points,), volume, (slope,) = ctx.saved_tensors, ctx.volume, upstream
        of_values, of_evidence, of_points = ctx.needs_input_grad[:3]
        amount = slope.to(ctx.like.dtype)
        if ctx.quantum:
            amount = amount.clamp(-LARGEST, LARGEST)
        index, shares = volume.shares(points, amount, ctx.quantum)
        nodes = volume.summed(index, shares, ctx.like) if of_values else None
        sizes = volume.summed(index, shares.abs(), ctx.like) if of_evidence else None
        pull = volume.gradient(points) * slope[:, None] if of_points else None
        return nodes, sizes, pull, None, None


@dataclass(frozen=True)
class DifferentiableSdf:
    """An SDF whose samples are differentiable with respect to its node values. Grid frame, voxels."""

    volume: Volume  # the values that are sampled
    values: Float[Tensor, "*nodes"]  # receives the gradient of all samples, spread over their nodes
    evidence: Float[Tensor, "*nodes"] | None = None  # receives the sum of these gradients' absolute values
    quantum: float = 0.0  # gradients are multiples of it: with float64 values their sum is exact in any order

    @classmethod
    def of(cls, values: Float[Tensor, "nx ny nz"]) -> "DifferentiableSdf":
        """Make one of node values (voxels) that may require a gradient."""
        return cls(Volume.of(values.detach()), values)

    def sample(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """Return the trilinear SDF at points, differentiable with respect to values and points."""
        return Sample.apply(self.values, self.evidence, points, self.volume, self.quantum)


@dataclass(frozen=True)
class LightRays:
    """The extrema of rays marched towards lights, differentiable with respect to both ends of a ray. Grid frame.

    T = prod_k Phi(s m_k) / Phi(s M_k) over the minima m of the SDF along the ray and the maximum M before each
    [ShadowNeuS eq:shadow_ray_render, telescoped]. By the envelope theorem only their values need a gradient; their
    positions along the ray are constants.
    """

    sdf: DifferentiableSdf
    origins: Float[Tensor, "n 3"]
    lights: Float[Tensor, "n 4"]  # homogeneous
    length: Float[Tensor, " n"]  # to the light, MISSED if it is a direction
    found: Extrema

    def sample(self, ray: Int[Tensor, " m"], t: Float[Tensor, " m"]) -> Float[Tensor, " m"]:
        """Return the SDF (voxels) at parameter t of some rays; a point of a ray moves with the ray's ends."""
        origins, lights, length = self.origins[ray], self.lights[ray], self.length[ray]
        is_point = length < FAR
        share = torch.where(is_point, t / length, t)  # of the light's motion that the point shares
        unit = torch.nn.functional.normalize(lights[:, :3], dim=-1)
        step = torch.where(is_point[:, None], lights[:, :3] - origins, unit)
        return self.sdf.sample(origins + share[:, None] * step)

    def log_transmittance(
        self, sharpness: Float[Tensor, ""] | float, from_surface: bool = False
    ) -> Float[Tensor, " n"]:
        """Return log T.

        Args:
            sharpness: NeuS s per voxel.
            from_surface: treat the SDF at a ray's start as a constant, as it is on a surface.
        """
        found = self.found
        used = torch.cat([found.is_used(), found.is_used()], 1)
        t, f = torch.cat([found.low_t, found.high_t], 1), torch.cat([found.low_f, found.high_f], 1)
        free = used & (t > 0) if from_surface else used
        ray, place = free.nonzero().unbind(1)
        f = f.index_put((ray, place), self.sample(ray, t[ray, place]))
        low, high = f.chunk(2, dim=1)
        lost = logsigmoid(sharpness * low) - logsigmoid(sharpness * high)
        return torch.where(found.is_used(), lost, 0.0).sum(1)


def march(
    sdf: DifferentiableSdf,
    origins: Float[Tensor, "n 3"],
    lights: Float[Tensor, "n 4"],
    sharpness: float,
    jitter: Float[Tensor, " n"] | float = 1.0,
    far: Float[Tensor, " n"] | None = None,
) -> LightRays:
    """March rays from their origins to homogeneous lights, grid frame.

    Args:
        sharpness: NeuS s per voxel.
        jitter: see rays.extrema.
        far: length (voxels) at which each ray ends; by default at its light.
    """
    with torch.no_grad():
        directions, length = towards(origins, lights)
        found = extrema(sdf.volume, origins, directions, length if far is None else far, sharpness, jitter)
    return LightRays(sdf, origins, lights, length, found)


def transmittance(
    grid: SdfGrid, points: Float[Tensor, "n 3"], lights: Float[Tensor, "n 4"], sharpness: Float[Tensor, ""] | float
) -> Float[Tensor, " n"]:
    """Return the transmittance from each point to its light, in [0, 1], with gradients to all four arguments.

    This is [ShadowNeuS eq:shadow_ray_render], telescoped, see LightRays. Rays run in batches; at most MAX_MINIMA minima
    per ray are kept.

    Args:
        points: the starts of shadow rays, world.
        lights: one per point, homogeneous, world: w = 1 a position, w = 0 a direction towards the light.
        sharpness: NeuS s, 1 / world length.
    """
    sdf, origin = DifferentiableSdf.of(grid.values / grid.spacing), grid.origin.to(points)
    starts, ends = (points - origin) / grid.spacing, lights_in_frame(lights, origin, grid.spacing)
    s = torch.as_tensor(sharpness).to(points) * grid.spacing
    batches = zip(starts.split(BATCHES.rays), ends.split(BATCHES.rays), strict=True)
    return torch.cat([march(sdf, *batch, float(s.detach())).log_transmittance(s) for batch in batches]).exp()
