"""One iteration of the training: draw rays, intersect them with the field, shade them, and compare with the photos."""

import torch
from jaxtyping import Float
from torch import Tensor

from reconstruct.shadowneus.camera_rays import find_hits
from reconstruct.shadowneus.config import TrainConfig
from reconstruct.shadowneus.losses import REACH, bound_loss, colour_loss, contain_loss, eikonal_loss, smooth_l1
from reconstruct.shadowneus.model import Model
from reconstruct.shadowneus.render import LitSurfaces, Surfaces, blended, colours, shadow_rays, surfaces
from reconstruct.shadowneus.train_pixels import Batch, TrainPixels, draw

JITTER = 1e-4  # of the copies of surface points that the eikonal loss is taken at (the authors' code), unit frame


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
