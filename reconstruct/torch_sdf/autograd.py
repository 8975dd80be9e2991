"""Shadow rays to build on: visibility, intersection and boundary blend, differentiable by torch on any device.

    grid = SdfGrid(values.requires_grad_(), origin, spacing)                # world frame
    renderer = ShadowRenderer(pixel_angle=scene.pixel_angle, sharpness=20 / spacing)
    seen = renderer(grid, eye, directions, ground_t, lights)                # one light per ray
    loss = shadow_loss(seen.visibility[seen.is_seen], label[seen.is_seen]).mean()
    loss.backward()                                                         # values.grad, lights.grad

or, from points of one's own, `transmittance(grid, points, lights, sharpness)`. For colour, give `seen.points`,
`seen.normals` and `seen.visibility` to `reconstruct.torch_sdf.equations.shade`.

Everything here is in the world frame; tensors of one call share a device and a floating type, float32 or float64.
"""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.kernels import FAR
from reconstruct.torch_sdf.equations import area_ratio, blend, moved_intersection
from reconstruct.torch_sdf.rays import BATCHES, Extrema, extrema, first_surface, towards
from reconstruct.torch_sdf.volume import Volume, sum_at_nodes


class Visibility(torch.autograd.Function):
    """Transmittance from points to lights through an SDF grid [ShadowNeuS eq:shadow_ray_render, telescoped].

    T = prod_k Phi(s m_k) / Phi(s M_k) over the minima m of the SDF along the ray and the maximum M before each. By the
    envelope theorem only their values need a gradient, not their places. Use `transmittance`.
    """

    @staticmethod
    def forward(
        ctx: Any,
        values: Float[Tensor, "nx ny nz"],
        points: Float[Tensor, "n 3"],
        lights: Float[Tensor, "n 4"],
        sharpness: Float[Tensor, ""],
        origin: Float[Tensor, "3"],
        spacing: float,
    ) -> Float[Tensor, " n"]:
        """In [0, 1]. Rays go through in batches; what is kept for the gradient is six extrema per ray."""
        volume = Volume.of(values / spacing)
        starts = (points - origin) / spacing
        is_point = lights[:, 3:] > 0
        ends = torch.where(is_point, (lights[:, :3] - origin) / spacing, lights[:, :3])
        directions, length = towards(starts, torch.cat([ends, lights[:, 3:]], 1))
        per_voxel = float(sharpness) * spacing
        batches = zip(*(x.split(BATCHES.rays) for x in (starts, directions, length)), strict=True)
        found = [extrema(volume, *batch, per_voxel) for batch in batches]
        parts = [torch.cat([getattr(batch, name) for batch in found]) for name in Extrema.__dataclass_fields__]
        seen = Extrema(*parts).log_transmittance.exp()
        ctx.save_for_backward(volume.phi, starts, directions, length, lights, seen, *parts)
        ctx.spacing, ctx.per_voxel = spacing, per_voxel
        return seen

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Float[Tensor, " n"]) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Gradients to the grid's values, the points, the lights (x, y, z) and the sharpness."""
        phi, starts, directions, length, lights, seen, *parts = ctx.saved_tensors
        volume, found, s = Volume.of(phi), Extrema(*parts), ctx.per_voxel
        amount = torch.where(found.is_used(), (upstream[0] * seen)[:, None], 0.0)
        t, f = torch.cat([found.low_t, found.high_t], 1), torch.cat([found.low_f, found.high_f], 1)
        slope = torch.cat([amount, -amount], 1) * torch.sigmoid(-s * f)  # d loss / d (s f)

        ray, place = slope.nonzero().unbind(1)
        part, at = s * slope[ray, place], t[ray, place]
        where = starts[ray] + at[:, None] * directions[ray]
        nodes = torch.zeros_like(phi).view(-1)
        sum_at_nodes(nodes, volume, where, part)
        pull = volume.gradient(where) * part[:, None]
        is_point = (lights[ray, 3] > 0)[:, None]
        share = torch.where(is_point[:, 0], at / length[ray], 0.0)[:, None]
        of_start, of_light = torch.zeros_like(starts), torch.zeros_like(starts)
        of_start.index_add_(0, ray, (1 - share) * pull)
        along = (pull * directions[ray]).sum(-1, keepdim=True) * directions[ray]
        reach = (at / torch.linalg.vector_norm(lights[ray, :3], dim=-1))[:, None]
        of_light.index_add_(0, ray, torch.where(is_point, share * pull, reach * (pull - along)))
        in_world = torch.where(lights[:, 3:] > 0, 1 / ctx.spacing, 1.0)
        of_lights = torch.cat([of_light * in_world, torch.zeros_like(lights[:, 3:])], 1)
        of_sharpness = (slope * f).sum() * ctx.spacing
        return nodes.view_as(phi) / ctx.spacing, of_start / ctx.spacing, of_lights, of_sharpness, None, None


def transmittance(
    grid: SdfGrid, points: Float[Tensor, "n 3"], lights: Float[Tensor, "n 4"], sharpness: Float[Tensor, ""] | float
) -> Float[Tensor, " n"]:
    """Light left from each point to its light, in [0, 1], with gradients to all four arguments.

    Args:
        points: where shadow rays start, world.
        lights: one per point, homogeneous, world: w = 1 a place, w = 0 a direction towards the light.
        sharpness: NeuS s, 1 / world length.
    """
    s = torch.as_tensor(sharpness, dtype=points.dtype, device=points.device)
    return Visibility.apply(grid.values, points, lights, s, grid.origin.to(points), grid.spacing)


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
        """Of each ray.

        Args:
            directions: unit length; far: where the ray ends, world length; inf: nowhere.
        """
        volume = Volume.of(grid.values.detach() / grid.spacing)
        starts, end = (origins - grid.origin.to(origins)) / grid.spacing, (far / grid.spacing).clamp(max=10 * FAR)
        batches = zip(*(x.split(BATCHES.rays) for x in (starts, directions, end)), strict=True)
        found = [first_surface(volume, *batch, self.pixel_angle) for batch in batches]
        hit, part_t, _ = (torch.cat(parts) for parts in zip(*found, strict=True))
        is_hit, is_edge = hit < FAR, part_t > 0

        field = Volume.of(grid.values / grid.spacing)
        at_hit = starts + torch.where(is_hit, hit, 0.0)[:, None] * directions
        at_edge = starts + torch.where(is_edge, part_t, 0.0)[:, None] * directions
        normals = volume.gradient(at_hit)
        moved = moved_intersection(at_hit, directions, field.sample(at_hit), normals)
        footprint = torch.where(is_edge, self.pixel_angle * part_t, 1.0)
        ratio = torch.where(is_edge, area_ratio(field.sample(at_edge), footprint), 0.0)

        def in_world(p: Tensor) -> Tensor:
            return p * grid.spacing + grid.origin.to(p)

        return Intersections(is_hit, in_world(moved), normals, is_edge, in_world(at_edge), ratio)


@dataclass(frozen=True)
class Seen:
    """What shadow rays say about each pixel."""

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
    ) -> Seen:
        """Of each pixel.

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
        return Seen(visibility, is_seen, found.is_hit, points, normals)
