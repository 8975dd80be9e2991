"""Intersect camera rays with a field: uniform steps, bisection, and silhouettes within a pixel of a ray."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reconstruct.shadowneus.field import SdfField
from reconstruct.torch_sdf.equations import opacity_from_sdf

TOLERANCE = 5e-5  # of the bisection, unit frame (as in the authors' code)
POINTS_AT_ONCE = 2**17  # of a field without gradients: 130 MB per layer of 256


@dataclass(frozen=True)
class CameraRays:
    """Camera rays in the unit frame."""

    eye: Float[Tensor, "3"]
    directions: Float[Tensor, "rays 3"]  # unit
    ground_t: Float[Tensor, " rays"]  # length to the known ground; inf where a ray does not meet it
    pixel_angle: float  # rad

    def at(self, t: Float[Tensor, " rays"]) -> Float[Tensor, "rays 3"]:
        """Return the points at lengths t along the rays."""
        return self.eye + t[:, None] * self.directions


@dataclass(frozen=True)
class Hits:
    """Intersections of camera rays, without gradients."""

    t: Float[Tensor, " rays"]  # length to the surface behind any silhouette, else the ground; inf where neither
    is_field: Bool[Tensor, " rays"]  # the surface is the field's, not the ground behind it
    edge_t: Float[Tensor, " rays"]  # length to a silhouette within half a pixel of the ray; inf where there is none


def values(field: SdfField, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """Return the SDF at points of any batch shape, without gradients."""
    with torch.no_grad():
        parts = [field.sdf(part) for part in points.reshape(-1, 3).split(POINTS_AT_ONCE)]
    return torch.cat(parts).reshape(points.shape[:-1])


def sphere_span(
    origins: Float[Tensor, "rays 3"], directions: Float[Tensor, "rays 3"], radius: float
) -> tuple[Float[Tensor, " rays"], Float[Tensor, " rays"]]:
    """Return the lengths at which rays enter and leave a sphere about the origin; on a miss both are the closest point.

    Args:
        directions: unit.
    """
    closest = -(origins * directions).sum(-1)
    square = radius**2 - (origins * origins).sum(-1) + closest**2
    half = square.clamp(min=0).sqrt()
    return closest - half, closest + half


def find_hits(field: SdfField, rays: CameraRays, bound: float, steps: int, with_edges: bool) -> Hits:
    """March camera rays through the bounding sphere.

    The first zero is bracketed by uniform steps and bisected. A minimum m of the SDF along the ray with |m| below half
    the pixel's width there is a silhouette inside the pixel (see equations.area_ratio); the hit is then the next
    surface behind it. This replaces the paper's walk along the surface, which finds the same points.

    Args:
        bound: radius of the bounding sphere, unit frame.
        steps: uniform samples per ray.
        with_edges: also find silhouettes.
    """
    near, far = sphere_span(rays.eye.expand_as(rays.directions), rays.directions, bound)
    near = near.clamp(min=0)
    t = near[:, None] + (far - near).clamp(min=0)[:, None] * torch.linspace(0, 1, steps, device=near.device)
    sdf = values(field, rays.eye + t[..., None] * rays.directions[:, None])
    edge = torch.full_like(near, torch.inf)
    behind = torch.zeros_like(near, dtype=torch.long)
    if with_edges:
        edge, behind = _first_edge(field, rays, t, sdf)
    interval = torch.arange(steps - 1, device=near.device)
    enters = (sdf[:, :-1] > 0) & (sdf[:, 1:] <= 0) & (interval >= behind[:, None])
    found, first = enters.any(1), enters.float().argmax(1)
    hit = rays.ground_t.clone()
    chosen = found.nonzero()[:, 0]
    low = t[chosen, first[chosen]]
    high = t[chosen, first[chosen] + 1]
    hit[chosen] = _bisect(field, rays, chosen, low, high)
    return Hits(hit, found, edge)


def _first_edge(field: SdfField, rays: CameraRays, t: Tensor, sdf: Tensor) -> tuple[Tensor, Tensor]:
    """Return the length to the first silhouette (inf: none), and the step at which the search behind it begins."""
    before, here, after = sdf[:, :-2], sdf[:, 1:-1], sdf[:, 2:]
    half_width = 0.5 * rays.pixel_angle * t[:, 1:-1]
    sag = (before - 2 * here + after).clamp(min=1e-12)
    lowest = here - (before - after) ** 2 / (8 * sag)  # of the parabola through three samples
    passes = (here <= before) & (here < after) & (lowest < half_width)
    place = passes.float().argmax(1, keepdim=True)
    offset = (0.5 * (before - after) / sag).clamp(-1, 1).gather(1, place)[:, 0]
    step = t[:, 1] - t[:, 0]
    at = t[:, 1:-1].gather(1, place)[:, 0] + offset * step
    exact = values(field, rays.at(at))
    is_edge = passes.any(1) & (exact.abs() < 0.5 * rays.pixel_angle * at)
    return torch.where(is_edge, at, torch.inf), torch.where(is_edge, place[:, 0] + 1, 0)


def _bisect(field: SdfField, rays: CameraRays, chosen: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Find the zeros between low (outside) and high (inside), to TOLERANCE."""
    width = float((high - low).max()) if len(low) else 0.0
    while width > TOLERANCE:
        middle = 0.5 * (low + high)
        outside = values(field, rays.eye + middle[:, None] * rays.directions[chosen]) > 0
        low, high = torch.where(outside, middle, low), torch.where(outside, high, middle)
        width /= 2
    return 0.5 * (low + high)


def expected_depth(
    field: SdfField, rays: CameraRays, bound: float, steps: int, sharpness: Float[Tensor, ""]
) -> Float[Tensor, " rays"]:
    """Return the expected length of camera rays by NeuS-like opacity; the remaining weight ends on the ground.

    This is the alternative that the paper tried first and advises against [ShadowNeuS, supplement, "Discussion on
    surface locating method"]. It is differentiable through every sample.

    Args:
        bound: radius of the bounding sphere, unit frame.
        steps: samples per ray.
        sharpness: NeuS s, 1 / length of the unit frame.
    """
    near, far = sphere_span(rays.eye.expand_as(rays.directions), rays.directions, bound)
    near = near.clamp(min=0)
    last = torch.maximum(torch.minimum(far, rays.ground_t), near)
    t = near[:, None] + (last - near)[:, None] * torch.linspace(0, 1, steps, device=near.device)
    points = rays.eye + t[..., None] * rays.directions[:, None]
    opacity = opacity_from_sdf(field.sdf(points.reshape(-1, 3)).reshape(t.shape), sharpness)
    left = (1 - opacity).cumprod(1)
    weight = opacity * torch.cat([torch.ones_like(left[:, :1]), left[:, :-1]], 1)
    end = torch.where(rays.ground_t.isfinite(), rays.ground_t, last)
    return (weight * 0.5 * (t[:, 1:] + t[:, :-1])).sum(1) + left[:, -1] * end
