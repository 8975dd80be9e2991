"""Intersect camera rays with a field: uniform steps, bisection, and silhouettes within a pixel of a ray.

Shadow rays through a field: sample placement and transmitted light (visibility).
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from reconstruct.shadowneus.config import ShadowSamples
from reconstruct.shadowneus.field import SdfField
from reconstruct.torch_sdf.equations import opacity_from_sdf, transmittance, transmittance_from_extrema

TOLERANCE = 5e-5  # of the bisection, unit frame (as in the authors' code)
POINTS_AT_ONCE = 2**17  # of a field without gradients: 130 MB per layer of 256
BEFORE_START = -0.05  # start of the samples (as in the authors' code; the text states 0), unit frame
NEAR_START = 0.01  # from here on samples are uniform (the authors' code)
SHORTEST = 0.5  # of the uniform part (the authors' code): no volume rendering in tiny ranges
IMPORTANCE_SHARPNESS = 64.0  # of the first round of importance sampling [NeuS]
LEAST_WEIGHT = 1e-5  # of an interval in importance sampling, so that every interval can be drawn
LEAST_LEFT = 1e-7  # of the light behind an interval, so that the gradient of the others stays finite
RUNS = 4  # falling runs of a ray that are kept in the closed form, the deepest ones


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
    low = t[chosen, first[chosen]]  # outside
    high = t[chosen, first[chosen] + 1]  # inside
    width = float((high - low).max()) if len(low) else 0.0
    while width > TOLERANCE:
        middle = 0.5 * (low + high)
        outside = values(field, rays.eye + middle[:, None] * rays.directions[chosen]) > 0
        low, high = torch.where(outside, middle, low), torch.where(outside, high, middle)
        width /= 2
    hit[chosen] = 0.5 * (low + high)
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


@dataclass(frozen=True)
class ShadowRays:
    """Rays towards lights, unit frame; `starts` and `towards` may carry gradients."""

    starts: Float[Tensor, "rays 3"]
    towards: Float[Tensor, "rays 3"]  # unit
    normals: Float[Tensor, "rays 3"]  # of the surface they start on
    lengths: Float[Tensor, " rays"]  # to the light; inf for a direction

    def at(self, t: Float[Tensor, "rays samples"]) -> Float[Tensor, "rays samples 3"]:
        """Return the points at lengths t along the rays."""
        return self.starts[:, None] + t[..., None] * self.towards[:, None]


@torch.no_grad()
def place_samples(
    field: SdfField, rays: ShadowRays, bound: float, counts: ShadowSamples, generator: torch.Generator
) -> tuple[Float[Tensor, "rays samples"], Float[Tensor, "rays samples"]]:
    """Return increasing lengths along shadow rays, and the SDF there; both are constants.

    Some samples are near the start, some uniform up to the end of the bounding sphere, some where light is absorbed.

    Args:
        bound: radius of the bounding sphere, unit frame.
    """
    enter, leave = sphere_span(rays.starts, rays.towards, bound)
    first = enter.clamp(min=NEAR_START)
    last = torch.maximum(torch.minimum(leave, rays.lengths), first + SHORTEST)
    near = _near_start(field, rays, counts.near, generator)
    t = torch.cat([near, _stratified(first, last, counts.uniform, generator)], 1)
    sdf = values(field, rays.at(t))
    for number in range(counts.rounds):
        new = _where_light_ends(t, sdf, counts.importance // counts.rounds, IMPORTANCE_SHARPNESS * 2**number)
        t, order = torch.cat([t, new], 1).sort(1)
        sdf = torch.cat([sdf, values(field, rays.at(new))], 1).gather(1, order)
    return t, sdf


def light_left(
    field: SdfField, rays: ShadowRays, t: Float[Tensor, "rays samples"], sharpness: Float[Tensor, ""], anneal: float
) -> Float[Tensor, " rays"]:
    """Return the visibility of the lights, in [0, 1] [ShadowNeuS eq:shadow_ray_render, eq:neus_alpha], from samples.

    Args:
        sharpness: NeuS s, 1 / length of the unit frame.
        anneal: weight of NeuS's true cosine, 0 to 1. Below 1, opacity also rises where a ray runs along or away from
            the surface, so that every sample has a gradient at first [NeuS's cos_anneal_ratio].
    """
    sdf = field.sdf(rays.at(t).reshape(-1, 3)).reshape(t.shape)
    if anneal >= 1:
        return transmittance(sdf, sharpness)
    step = t[:, 1:] - t[:, :-1]
    slope = (sdf[:, 1:] - sdf[:, :-1]) / step.clamp(min=1e-6)
    falling = (1 - anneal) * F.relu(0.5 - 0.5 * slope) + anneal * F.relu(-slope)
    middle, half = 0.5 * (sdf[:, 1:] + sdf[:, :-1]), 0.5 * falling * step
    edges = torch.stack([middle + half, middle - half], -1).reshape(-1, 2)
    opacity = opacity_from_sdf(edges, sharpness).reshape(step.shape)
    return (1 - opacity).clamp(min=LEAST_LEFT).log().sum(1).exp()


def light_left_telescoped(
    field: SdfField,
    rays: ShadowRays,
    t: Float[Tensor, "rays samples"],
    sdf: Float[Tensor, "rays samples"],
    sharpness: Float[Tensor, ""],
) -> Float[Tensor, " rays"]:
    """Return the visibility of `light_left` in closed form, differentiated only at the ends of decreasing runs.

    Args:
        sdf: at t, a constant.
        sharpness: NeuS s, 1 / length of the unit frame.
    """
    low, high = _runs(sdf)
    ends = field.sdf(rays.at(t.gather(1, torch.cat([low, high], 1))).reshape(-1, 3)).reshape(len(t), -1)
    return transmittance_from_extrema(ends[:, : low.shape[1]], ends[:, low.shape[1] :], sharpness)


def _runs(sdf: Float[Tensor, "rays samples"]) -> tuple[Tensor, Tensor]:
    """Return samples at the ends and starts of the RUNS deepest decreasing runs; missing runs repeat one sample."""
    count = sdf.shape[1]
    falls = sdf[:, 1:] < sdf[:, :-1]
    no = torch.zeros_like(falls[:, :1])
    starts = torch.cat([falls, no], 1) & ~torch.cat([no, falls], 1)
    ends = torch.cat([no, falls], 1) & ~torch.cat([falls, no], 1)
    depth, low = torch.where(ends, sdf, torch.inf).topk(min(RUNS, count), 1, largest=False)
    place = torch.arange(count, device=sdf.device)
    before = starts[:, None] & (place <= low[..., None])
    high = torch.where(before, place, -1).amax(-1)
    return low, torch.where(depth.isfinite(), high, low)


def _near_start(
    field: SdfField, rays: ShadowRays, count: int, generator: torch.Generator
) -> Float[Tensor, "rays count"]:
    """Draw samples around the start, only where the SDF is monotonic (the authors' backward sampling).

    A ray that leaves the surface must not hit the far side of a thin sheet just behind its start, so the range before
    the last reversal is excluded.
    """
    n = len(rays.starts)
    begin = torch.full((n,), BEFORE_START, device=rays.starts.device)
    end = torch.full_like(begin, NEAR_START)
    t = _stratified(begin, end, count, generator)
    leaves = torch.where((rays.normals * rays.towards).sum(-1, keepdim=True) < 0, -1.0, 1.0)
    sdf = leaves * values(field, rays.at(t))
    reverses = sdf[:, 1:] < sdf[:, :-1]
    last = torch.where(reverses, torch.arange(1, count, device=t.device), 0).amax(1, keepdim=True)
    return _stratified(t.gather(1, last)[:, 0], end, count, generator)


def _stratified(begin: Tensor, end: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Draw one random place in each of `count` equal parts."""
    share = (torch.arange(count) + torch.rand(len(begin), count, generator=generator)) / count
    return begin[:, None] + (end - begin)[:, None] * share.to(begin.device)


def _where_light_ends(t: Tensor, sdf: Tensor, count: int, sharpness: float) -> Tensor:
    """Draw samples in proportion to the light absorbed per interval at a fixed sharpness [NeuS's up-sampling]."""
    step = (t[:, 1:] - t[:, :-1]).clamp(min=1e-6)
    slope = (sdf[:, 1:] - sdf[:, :-1]) / step
    slope = torch.minimum(slope, F.pad(slope, (1, 0))[:, :-1]).clamp(max=0)
    middle, half = 0.5 * (sdf[:, 1:] + sdf[:, :-1]), 0.5 * slope * step
    opacity = opacity_from_sdf(torch.stack([middle - half, middle + half], -1).reshape(-1, 2), sharpness)
    opacity = opacity.reshape(step.shape)
    left = F.pad((1 - opacity).cumprod(1), (1, 0), value=1.0)[:, :-1]
    share = opacity * left + LEAST_WEIGHT
    edges = F.pad((share / share.sum(1, keepdim=True)).cumsum(1), (1, 0))
    wanted = ((torch.arange(count, device=t.device) + 0.5) / count).expand(len(t), count).contiguous()
    upper = torch.searchsorted(edges.contiguous(), wanted, right=True).clamp(1, t.shape[1] - 1)
    low, high = edges.gather(1, upper - 1), edges.gather(1, upper)
    part = (wanted - low) / (high - low).clamp(min=1e-5)
    return t.gather(1, upper - 1) + part.clamp(0, 1) * step.gather(1, upper - 1)
