"""Visibility, intersection and boundary blend of shadow rays, differentiable by torch on any device.

    grid = SdfGrid(values.requires_grad_(), origin, spacing)                # world frame
    renderer = ShadowRenderer(pixel_angle=scene.pixel_angle, sharpness=20 / spacing)
    seen = renderer(grid, eye, directions, ground_t, lights)                # one light per ray
    loss = shadow_loss(seen.visibility[seen.is_seen], label[seen.is_seen]).mean()
    loss.backward()                                                         # values.grad, lights.grad

For given points, use `transmittance(grid, points, lights, sharpness)`. For colour, pass `seen.points`, `seen.normals`
and `seen.visibility` to `reconstruct.torch_sdf.equations.shade`.

These are in the world frame. The solver on a GPU (reconstruct/torch_sdf/dense.py) uses DifferentiableSdf and LightRays,
which are in the grid frame. Tensors of one call share a device and a floating type, float32 or float64.
"""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn.functional import logsigmoid

from reconstruct.scene import lights_in_frame
from reconstruct.sdf.blocks import overlapping, pack
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.kernels import FAR
from reconstruct.sdf.rays import first_surfaces
from reconstruct.torch_sdf.equations import area_ratio, blend, moved_intersection
from reconstruct.torch_sdf.rays import BATCHES, Extrema, extrema, towards
from reconstruct.torch_sdf.volume import Volume, central_differences

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
        sizes: Float[Tensor, " n"] | None,
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
        """Return the gradients to values, evidence, points and sizes."""
        (points,), volume, (slope,) = ctx.saved_tensors, ctx.volume, upstream
        of_values, of_evidence, of_points, of_sizes = ctx.needs_input_grad[:4]
        amount = slope.to(ctx.like.dtype)
        if ctx.quantum:
            amount = amount.clamp(-LARGEST, LARGEST)
        index, shares = volume.shares(points, amount, ctx.quantum)
        nodes = volume.summed(index, shares, ctx.like) if of_values else None
        sizes = volume.summed(index, shares.abs(), ctx.like) if of_evidence else None
        pull = volume.gradient(points) * slope[:, None] if of_points else None
        return nodes, sizes, pull, slope.abs() if of_sizes else None, None, None


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

    def sample(self, points: Float[Tensor, "n 3"], sizes: Float[Tensor, " n"] | None = None) -> Float[Tensor, " n"]:
        """Return the trilinear SDF at points, differentiable with respect to values and points.

        Args:
            sizes: its gradient receives the absolute value of each sample's gradient.
        """
        return Sample.apply(self.values, self.evidence, points, sizes, self.volume, self.quantum)

    def gradient(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Return central differences over one voxel, differentiable with respect to values; not normalised."""
        return central_differences(self.sample, points)


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
    light_sizes: Float[Tensor, " n"] | None = None  # receives the sum of |gradients| that move the light

    def sample(self, ray: Int[Tensor, " m"], t: Float[Tensor, " m"]) -> Float[Tensor, " m"]:
        """Return the SDF (voxels) at parameter t of some rays; a point of a ray moves with the ray's ends."""
        origins, lights, length = self.origins[ray], self.lights[ray], self.length[ray]
        is_point = length < FAR
        share = torch.where(is_point, t / length, t)  # of the light's motion that the point shares
        unit = torch.nn.functional.normalize(lights[:, :3], dim=-1)
        step = torch.where(is_point[:, None], lights[:, :3] - origins, unit)
        sizes = None if self.light_sizes is None else share * self.light_sizes[ray]
        return self.sdf.sample(origins + share[:, None] * step, sizes)

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
    light_sizes: Float[Tensor, " n"] | None = None,
) -> LightRays:
    """March rays from their origins to homogeneous lights, grid frame.

    Args:
        sharpness: NeuS s per voxel.
        jitter: see rays.extrema.
        far: length (voxels) at which each ray ends; by default at its light.
        light_sizes: see LightRays.
    """
    with torch.no_grad():
        directions, length = towards(origins, lights)
        found = extrema(sdf.volume, origins, directions, length if far is None else far, sharpness, jitter)
    return LightRays(sdf, origins, lights, length, found, light_sizes)


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


@dataclass(frozen=True)
class Intersections:
    """Intersections of camera rays with the surface. Points of rows without a hit or without an edge are arbitrary."""

    is_hit: Bool[Tensor, " n"]
    points: Float[Tensor, "n 3"]  # differentiable in the grid's values
    normals: Float[Tensor, "n 3"]  # gradient of the SDF there, constant, not normalised
    is_edge: Bool[Tensor, " n"]  # a silhouette covers a part of the pixel before the hit
    edge_points: Float[Tensor, "n 3"]  # constant
    edge_ratio: Float[Tensor, " n"]  # share of the pixel that it covers, differentiable; 0 without an edge


def first_intersections(
    grid: SdfGrid,
    origins: Float[Tensor, "n 3"],
    directions: Float[Tensor, "n 3"],
    far: Float[Tensor, " n"],
    pixel_angle: float,
) -> Intersections:
    """Return the first surface that camera rays meet, differentiable [ShadowNeuS eq:diff_intersect, eq:edge_vis].

    A point moves along its ray as the SDF there changes; the area ratio of a boundary pixel changes with the SDF at its
    silhouette. Rays are constants. World frame; the rays are marched on the CPU.

    Args:
        directions: unit.
        far: length at which each ray ends; inf if it does not end.
        pixel_angle: that a pixel subtends, radians.
    """
    field = DifferentiableSdf.of(grid.values / grid.spacing)
    starts, end = (origins - grid.origin.to(origins)) / grid.spacing, (far / grid.spacing).clamp(max=10 * FAR)
    rays = (x.detach().double().cpu().numpy() for x in (starts, directions, end))
    blocks = overlapping(pack(field.volume.phi.float().cpu().numpy()))
    hit, part_t, _ = (torch.from_numpy(x).to(far) for x in first_surfaces(blocks, *rays, pixel_angle))
    is_hit, is_edge = hit < FAR, part_t > 0

    at_hit = starts + torch.where(is_hit, hit, 0.0)[:, None] * directions
    at_edge = starts + torch.where(is_edge, part_t, 0.0)[:, None] * directions
    normals = field.volume.gradient(at_hit)
    moved = moved_intersection(at_hit, directions, field.sample(at_hit), normals)
    footprint = torch.where(is_edge, pixel_angle * part_t, 1.0)
    ratio = torch.where(is_edge, area_ratio(field.sample(at_edge), footprint), 0.0)

    def in_world(p: Tensor) -> Tensor:
        return p * grid.spacing + grid.origin.to(p)

    return Intersections(is_hit, in_world(moved), normals, is_edge, in_world(at_edge), ratio)


@dataclass(frozen=True)
class ShadowRendering:
    """Results of each pixel's shadow rays. World frame."""

    visibility: Float[Tensor, " n"]  # of its light, in [0, 1]; 1 where the pixel shows nothing
    is_seen: Bool[Tensor, " n"]  # the pixel shows object or ground
    is_hit: Bool[Tensor, " n"]  # its centre shows the object
    points: Float[Tensor, "n 3"]  # of the object or the ground, differentiable
    normals: Float[Tensor, "n 3"]  # of the object, not normalised; (0, 0, 1) on the ground


class ShadowRenderer(nn.Module):
    """Visibility of one light per pixel: intersection, shadow ray, and the blend of two depths at boundary pixels.

    C = w T_near + (1 - w) T_far [ShadowNeuS eq:edge_vis] with eq:diff_intersect for the start of each ray.
    """

    def __init__(self, pixel_angle: float, sharpness: float, use_boundary: bool = True):
        """Make a renderer.

        Args:
            pixel_angle: that a pixel subtends, radians.
            sharpness: the initial NeuS s, 1 / world length; a trained parameter, as in the paper.
            use_boundary: blend two depths at boundary pixels.
        """
        super().__init__()
        self.pixel_angle = pixel_angle
        self.log_sharpness = nn.Parameter(torch.tensor(float(sharpness)).log())
        self.use_boundary = use_boundary

    def forward(
        self,
        grid: SdfGrid,
        eye: Float[Tensor, "3"],
        directions: Float[Tensor, "n 3"],
        ground_t: Float[Tensor, " n"],
        lights: Float[Tensor, "n 4"],
    ) -> ShadowRendering:
        """Return the surface point of each pixel and the visibility of its light from there. World frame.

        Args:
            eye: world.
            directions: unit, world.
            ground_t: distance to the ground, world length; inf where a ray does not meet it.
            lights: one per pixel, homogeneous, world.
        """
        found = first_intersections(grid, eye.expand_as(directions), directions, ground_t, self.pixel_angle)
        on_ground = eye + torch.where(ground_t.isfinite(), ground_t, 0.0)[:, None] * directions
        points = torch.where(found.is_hit[:, None], found.points, on_ground)
        up = torch.tensor([0.0, 0.0, 1.0]).to(points)
        normals = torch.where(found.is_hit[:, None], found.normals, up)
        is_seen = found.is_hit | ground_t.isfinite()

        sharpness = self.log_sharpness.exp().to(points)
        visibility = torch.ones_like(ground_t)
        shown = is_seen.nonzero()[:, 0]
        visibility = visibility.index_put((shown,), transmittance(grid, points[shown], lights[shown], sharpness))
        if self.use_boundary:
            edge = (is_seen & found.is_edge).nonzero()[:, 0]
            near = transmittance(grid, found.edge_points[edge], lights[edge], sharpness)
            mixed = blend(near, visibility[edge], found.edge_ratio[edge])
            visibility = visibility.index_put((edge,), mixed)
        return ShadowRendering(visibility, is_seen, found.is_hit, points, normals)
