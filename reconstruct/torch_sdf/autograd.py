"""Visibility, intersection and boundary blend of shadow rays, differentiable by torch on any device.

    grid = SdfGrid(values.requires_grad_(), origin, spacing)                # world frame
    renderer = ShadowRenderer(pixel_angle=scene.pixel_angle, sharpness=20 / spacing)
    seen = renderer(grid, eye, directions, ground_t, lights)                # one light per ray
    loss = shadow_loss(seen.visibility[seen.is_seen], label[seen.is_seen]).mean()
    loss.backward()                                                         # values.grad, lights.grad

or, from points of one's own, `transmittance(grid, points, lights, sharpness)`. For colour, give `seen.points`,
`seen.normals` and `seen.visibility` to `reconstruct.torch_sdf.equations.shade`.

These are in the world frame. The solver on a card (reconstruct/solve/torch_operators.py) uses the parts below them, in
the grid frame: DifferentiableSdf and LightRays. Tensors of one call share a device and a floating type, float32 or
float64.
"""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn.functional import logsigmoid

from reconstruct.scene import lights_in_frame
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.kernels import FAR
from reconstruct.torch_sdf.equations import area_ratio, blend, moved_intersection
from reconstruct.torch_sdf.rays import BATCHES, Extrema, extrema, first_surface, towards
from reconstruct.torch_sdf.volume import Volume, central_differences

LARGEST = 2.0**16  # of one amount that is rounded to a quantum: 2^9 of them on a node still sum exactly in float64


class Sample(torch.autograd.Function):
    """Trilinear samples of an SDF; backwards, sums of their gradients at the nodes, and of the gradients' sizes.

    Use DifferentiableSdf.sample.
    """

    @staticmethod
    def forward(
        ctx: Any,
        values: Float[Tensor, "nx ny nz"],
        evidence: Float[Tensor, "nx ny nz"] | None,
        points: Float[Tensor, "n 3"],
        sizes: Float[Tensor, " n"] | None,
        volume: Volume,
        quantum: float,
    ) -> Float[Tensor, " n"]:
        """The SDF at points, voxels."""
        ctx.save_for_backward(points)
        ctx.volume, ctx.quantum, ctx.real = volume, quantum, values.dtype
        return volume.sample(points)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Float[Tensor, " n"]) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Gradients to values, evidence, points and sizes."""
        (points,), volume, (slope,) = ctx.saved_tensors, ctx.volume, upstream
        of_values, of_evidence, of_points, of_sizes = ctx.needs_input_grad[:4]
        amount = slope.to(ctx.real)
        if ctx.quantum:
            amount = amount.clamp(-LARGEST, LARGEST)
        nodes = volume.spread(points, amount, ctx.quantum) if of_values else None
        sizes = volume.spread(points, amount.abs(), ctx.quantum) if of_evidence else None
        pull = volume.gradient(points) * slope[:, None] if of_points else None
        return nodes, sizes, pull, slope.abs() if of_sizes else None, None, None


@dataclass(frozen=True)
class DifferentiableSdf:
    """An SDF whose samples torch can differentiate by its node values. Grid frame, voxels."""

    volume: Volume  # what is sampled
    values: Float[Tensor, "nx ny nz"]  # gets the gradient of all samples, spread over their nodes
    evidence: Float[Tensor, "nx ny nz"] | None = None  # gets the sum of these gradients' sizes
    quantum: float = 0.0  # gradients are multiples of it: with float64 values their sum is exact in any order

    @classmethod
    def of(cls, values: Float[Tensor, "nx ny nz"]) -> "DifferentiableSdf":
        """Of values that may require a gradient."""
        return cls(Volume.of(values.detach()), values)

    def sample(self, points: Float[Tensor, "n 3"], sizes: Float[Tensor, " n"] | None = None) -> Float[Tensor, " n"]:
        """Trilinear SDF, differentiable by values and points; `sizes` gets the size of each sample's gradient."""
        return Sample.apply(self.values, self.evidence, points, sizes, self.volume, self.quantum)

    def gradient(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Central differences over one voxel, differentiable by values; not normalised."""
        return central_differences(self.sample, points)


@dataclass(frozen=True)
class LightRays:
    """Rays marched towards lights, grid frame: their extrema, differentiable with respect to both ends.

    T = prod_k Phi(s m_k) / Phi(s M_k) over the minima m of the SDF along the ray and the maximum M before each
    [ShadowNeuS eq:shadow_ray_render, telescoped]. By the envelope theorem only their values need a gradient, not their
    places along the ray: those are constants.
    """

    sdf: DifferentiableSdf
    origins: Float[Tensor, "n 3"]
    lights: Float[Tensor, "n 4"]  # homogeneous
    length: Float[Tensor, " n"]  # to the light, MISSED if it is a direction
    found: Extrema
    light_sizes: Float[Tensor, " n"] | None = None  # gets the sum of sizes of the gradients that move the light

    def sample(self, ray: Int[Tensor, " m"], t: Float[Tensor, " m"]) -> Float[Tensor, " m"]:
        """SDF at parameter t of some rays; a point of a ray moves with the ray's ends."""
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
        """log T.

        Args:
            sharpness: NeuS s per voxel; from_surface: where rays fall from their very start, the SDF there is a
                constant, as it is on a surface.
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
    """March rays to homogeneous lights, grid frame.

    Args:
        sharpness: per voxel; jitter: see rays.extrema; far: where rays end before their light.
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

    Rays run in batches; at most six extrema per ray are kept for the gradient.

    Args:
        points: where shadow rays start, world.
        lights: one per point, homogeneous, world: w = 1 a place, w = 0 a direction towards the light.
        sharpness: NeuS s, 1 / world length.
    """
    sdf, origin = DifferentiableSdf.of(grid.values / grid.spacing), grid.origin.to(points)
    starts, ends = (points - origin) / grid.spacing, lights_in_frame(lights, origin, grid.spacing)
    s = torch.as_tensor(sharpness).to(points) * grid.spacing
    batches = zip(starts.split(BATCHES.rays), ends.split(BATCHES.rays), strict=True)
    return torch.cat([march(sdf, *batch, float(s.detach())).log_transmittance(s) for batch in batches]).exp()


@dataclass(frozen=True)
class Intersections:
    """Where camera rays meet the surface. Rows without a hit, or without an edge, hold a point of no meaning."""

    is_hit: Bool[Tensor, " n"]
    points: Float[Tensor, "n 3"]  # differentiable in the grid's values
    normals: Float[Tensor, "n 3"]  # gradient of the SDF there, constant, not normalised
    is_edge: Bool[Tensor, " n"]  # a silhouette covers a part of the pixel before the hit
    edge_points: Float[Tensor, "n 3"]  # constant
    edge_ratio: Float[Tensor, " n"]  # share of the pixel that it covers, differentiable; 0 without an edge


class FirstIntersection(nn.Module):
    """First surface of camera rays: differentiable points and area ratios [ShadowNeuS eq:diff_intersect, eq:edge_vis].

    The point moves along its ray as the SDF there changes; the ratio of a boundary pixel changes with the SDF at its
    silhouette. Rays are constants.
    """

    def __init__(self, pixel_angle: float):
        """For pixels that subtend so many radians."""
        super().__init__()
        self.pixel_angle = pixel_angle

    def forward(
        self, grid: SdfGrid, origins: Float[Tensor, "n 3"], directions: Float[Tensor, "n 3"], far: Float[Tensor, " n"]
    ) -> Intersections:
        """Return the intersections of rays with the surface, world frame.

        Args:
            directions: unit length; far: where the ray ends, world length; inf: nowhere.
        """
        field = DifferentiableSdf.of(grid.values / grid.spacing)
        starts, end = (origins - grid.origin.to(origins)) / grid.spacing, (far / grid.spacing).clamp(max=10 * FAR)
        batches = zip(*(x.split(BATCHES.rays) for x in (starts, directions, end)), strict=True)
        found = [first_surface(field.volume, *batch, self.pixel_angle) for batch in batches]
        hit, part_t, _ = (torch.cat(parts) for parts in zip(*found, strict=True))
        is_hit, is_edge = hit < FAR, part_t > 0

        at_hit = starts + torch.where(is_hit, hit, 0.0)[:, None] * directions
        at_edge = starts + torch.where(is_edge, part_t, 0.0)[:, None] * directions
        normals = field.volume.gradient(at_hit)
        moved = moved_intersection(at_hit, directions, field.sample(at_hit), normals)
        footprint = torch.where(is_edge, self.pixel_angle * part_t, 1.0)
        ratio = torch.where(is_edge, area_ratio(field.sample(at_edge), footprint), 0.0)

        def in_world(p: Tensor) -> Tensor:
            return p * grid.spacing + grid.origin.to(p)

        return Intersections(is_hit, in_world(moved), normals, is_edge, in_world(at_edge), ratio)


@dataclass(frozen=True)
class ShadowRendering:
    """Results of the shadow rays of each pixel."""

    visibility: Float[Tensor, " n"]  # of its light; 1 where the pixel shows nothing
    is_seen: Bool[Tensor, " n"]  # whether the pixel shows object or ground
    is_hit: Bool[Tensor, " n"]  # whether its centre shows the object
    points: Float[Tensor, "n 3"]  # of the object or the ground, differentiable
    normals: Float[Tensor, "n 3"]  # of the object, not normalised; (0, 0, 1) on the ground


class ShadowRenderer(nn.Module):
    """Visibility of one light per pixel: intersection, shadow ray, and the blend of two depths at boundary pixels.

    C = w T_near + (1 - w) T_far [ShadowNeuS eq:edge_vis] with eq:diff_intersect for the start of each ray.
    """

    def __init__(self, pixel_angle: float, sharpness: float, use_boundary: bool = True):
        """A renderer for pixels of so many radians.

        Args:
            sharpness: the initial NeuS s, 1 / world length; a parameter, as in the paper.
        """
        super().__init__()
        self.intersect = FirstIntersection(pixel_angle)
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
            directions: unit length; ground_t: distance to the ground, inf where a ray never meets it.
            lights: one per pixel, homogeneous.
        """
        found = self.intersect(grid, eye.expand_as(directions), directions, ground_t)
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
