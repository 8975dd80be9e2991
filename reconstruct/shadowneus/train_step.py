"""One iteration of the training: draw rays, intersect them with the field, shade them, and compare with the photos.

Losses of the training: photos, unit gradient, free space around the object, and the ground on its plane.

Lengths are those of the unit frame.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from reconstruct.shadowneus.camera_rays import CameraRays, Hits, find_hits
from reconstruct.shadowneus.config import TrainConfig
from reconstruct.shadowneus.field import SdfField
from reconstruct.shadowneus.model import Model
from reconstruct.shadowneus.render import LitSurfaces, Surfaces, blended, colours, shadow_rays, surfaces
from reconstruct.shadowneus.train_pixels import Batch, TrainPixels, draw

SMOOTH = 0.1  # below this an error counts by its square (as in the authors' code; the text states L1)
SHELL = (0.99, 1.03)  # of the bounding sphere's radius: a shell that must be empty
REACH = 1.2  # of the bounding sphere's radius: the ground is held to its plane up to here
LAYER = 0.05  # of the bounding sphere's radius: thickness of a ground that marching cannot miss
JITTER = 1e-4  # of the copies of surface points that the eikonal loss is taken at (the authors' code), unit frame


def smooth_l1(error: Float[Tensor, "*batch"], weights: Float[Tensor, "*batch"]) -> Float[Tensor, ""]:
    """Return the weighted mean of the smooth L1 norm [ShadowNeuS eq:loss_shadow, eq:loss_rgb]; 0 without weights."""
    each = F.smooth_l1_loss(error, torch.zeros_like(error), beta=SMOOTH, reduction="none")
    return (each * weights).sum() / weights.sum().clamp(min=1e-5)


def colour_loss(error: Float[Tensor, "photos pixels 3"], weights: Float[Tensor, "photos pixels"]) -> Float[Tensor, ""]:
    """Return the smooth L1 norm, summed over channels, averaged over pixels and lights [ShadowNeuS eq:loss_rgb]."""
    return 3 * smooth_l1(error, weights[..., None].expand_as(error))


def eikonal_loss(field: SdfField, points: Float[Tensor, "n 3"]) -> Float[Tensor, ""]:
    """Return the mean of (|grad f| - 1)^2 at points [ShadowNeuS, "Training"]."""
    return ((torch.linalg.vector_norm(field.gradient(points.detach()), dim=-1) - 1) ** 2).mean()


def _zero_where(field: SdfField, points: Float[Tensor, "n 3"], wrong_sign: float) -> tuple[Tensor, Tensor]:
    """Return a loss that brings the SDF to zero where it has the wrong sign, and those points."""
    sdf = field.sdf(points)
    wrong = sdf * wrong_sign > 0
    return smooth_l1(sdf, wrong.float()), points[wrong]


def bound_loss(
    field: SdfField, count: int, bound: float, ground: float, generator: torch.Generator, device: torch.device
) -> tuple[Float[Tensor, ""], Float[Tensor, "wrong 3"]]:
    """Return a loss that penalises surface near the bounding sphere above the ground, and the points inside it.

    Args:
        count: points to draw.
        bound: radius of the bounding sphere.
        ground: z of the ground.
    """
    towards = F.normalize(2 * torch.rand(count, 3, generator=generator) - 1, dim=-1)
    radius = SHELL[0] + (SHELL[1] - SHELL[0]) * torch.rand(count, 1, generator=generator)
    points = (bound * radius * towards).to(device)
    return _zero_where(field, points[points[:, 2] >= ground], -1.0)


def contain_loss(
    field: SdfField,
    rays: CameraRays,
    hits: Hits,
    is_object: Bool[Tensor, " rays"],
    bound: float,
    generator: torch.Generator,
) -> tuple[Float[Tensor, ""], Float[Tensor, "wrong 3"]]:
    """Return a loss that enforces the known ground, and the points where it is taken.

    The SDF must be 0 where pixels beside the object see the ground, positive in front of it and negative just below.

    Args:
        is_object: the pixel may show the object.
        bound: radius of the bounding sphere.
    """
    device = rays.eye.device
    draw = torch.rand(2, len(hits.t), 1, generator=generator).to(device)
    t = torch.where(rays.ground_t.isfinite(), rays.ground_t, 0.0)
    ground = rays.at(t)
    near = rays.ground_t.isfinite() & (torch.linalg.vector_norm(ground, dim=-1) < REACH * bound)
    layer = LAYER * bound
    bare = near & ~is_object
    on_ground = ground[bare]
    loss = smooth_l1(field.sdf(on_ground), torch.ones(len(on_ground), device=device))
    before = bare & hits.is_field & (hits.t < t)
    low, high = torch.minimum(t - layer, hits.t)[before], torch.minimum(t, hits.t + layer)[before]
    between = rays.eye + (low[:, None] + draw[0, before] * (high - low)[:, None]) * rays.directions[before]
    floating, inside = _zero_where(field, between, -1.0)
    down = torch.tensor([0.0, 0.0, layer], device=device)
    hollow, air = _zero_where(field, ground[near] - down * (1 - draw[1, near]), 1.0)
    return loss + floating + hollow, torch.cat([on_ground, inside, air])


def pixel_weights(view: TrainPixels, batch: Batch, seen: Surfaces, config: TrainConfig, iteration: int) -> Tensor:
    """Return the weight of each photo at each seen pixel, (lights, seen)."""
    is_object = batch.is_object[seen.pixels]
    early = config.weights.early_foreground if iteration < config.foreground_anneal else 1.0
    foreground = 0.0 if config.supervised == "background" else early
    background = 0.0 if config.supervised == "foreground" else 1.0
    usable = view.usable[batch.photos][:, batch.pixels[seen.pixels]]
    return usable * torch.where(is_object, foreground, background)


def losses(
    model: Model, view: TrainPixels, config: TrainConfig, iteration: int, generator: torch.Generator
) -> dict[str, Float[Tensor, ""]]:
    """Return every weighted term of one iteration's loss, by name."""
    field, weights = model.field, config.weights
    batch = draw(view, config.pixels, config.lights, generator)
    with_edges = config.use_boundary and not config.use_expected_depth
    hits = find_hits(field, batch.rays, config.bound, config.camera_steps, with_edges)
    seen = surfaces(model, batch.rays, hits, config)
    anneal = min(1.0, iteration / config.cosine_anneal)
    lit = shadow_rays(model, view, seen, batch.photos, config, anneal, generator)
    share = pixel_weights(view, batch, seen, config, iteration)
    pixels = batch.pixels[seen.pixels]
    terms = {}
    if view.colour is not None:
        error = blended(colours(model, seen, lit, view.scene.ambient), seen) - view.colour[batch.photos][:, pixels]
        terms["colour"] = weights.colour * colour_loss(error, share)
    if view.shadow is not None:
        error = blended(lit.visibility, seen) - view.shadow[batch.photos][:, pixels]
        terms["shadow"] = weights.visibility * smooth_l1(error, share)
    ground, device = view.scene.ground_height, batch.rays.eye.device
    count = config.pixels * config.lights
    bound, outside = bound_loss(field, count, config.bound, ground, generator, device)
    contain, about = contain_loss(field, batch.rays, hits, batch.is_object, config.bound, generator)
    held = weights.contain if view.scene.ground_known else 0.0  # an assumed plane is no evidence
    terms |= {"bound": weights.bound * bound, "contain": held * contain}
    points = _eikonal_points(seen, lit, config, generator)
    points = torch.cat([points, outside.detach(), about.detach()])
    return terms | {"eikonal": weights.eikonal * eikonal_loss(field, points)}


def _eikonal_points(
    seen: Surfaces, lit: LitSurfaces, config: TrainConfig, generator: torch.Generator
) -> Float[Tensor, "n 3"]:
    """Return points in the bounding cube, on the surface (one per shadow ray), and where shadow rays are darkest."""
    device = seen.points.device
    anywhere = config.bound * (2 * torch.rand(config.pixels, 3, generator=generator) - 1).to(device)
    surface = seen.points.detach().repeat(config.lights, 1)
    shift = JITTER * (2 * torch.rand(surface.shape, generator=generator) - 1).to(device)
    points = torch.cat([anywhere, surface + shift, lit.darkest])
    return points[torch.linalg.vector_norm(points, dim=-1) < REACH * config.bound]
