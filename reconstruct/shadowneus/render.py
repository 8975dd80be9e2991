"""Differentiable rendering of the trained field: surface points, visibility of the lights, and colours. Unit frame."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from reconstruct.scene import irradiance
from reconstruct.shadowneus.camera_rays import (
    CameraRays,
    Hits,
    ShadowRays,
    expected_depth,
    light_left,
    light_left_telescoped,
    place_samples,
    sphere_span,
)
from reconstruct.shadowneus.config import TrainConfig
from reconstruct.shadowneus.mlp_field import specular
from reconstruct.shadowneus.model import Model
from reconstruct.shadowneus.train_pixels import TrainPixels
from reconstruct.torch_sdf import equations as render


@dataclass(frozen=True)
class Surfaces:
    """Differentiable start points of shadow rays: one per pixel, then the near surface points of boundary pixels."""

    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]  # unit
    directions: Float[Tensor, "n 3"]  # of the camera's rays
    pixels: Int[Tensor, " seen"]  # of the batch that see object or ground
    edges: Int[Tensor, " edges"]  # those of them that are boundary pixels
    ratio: Float[Tensor, " edges"]  # share of a boundary pixel that shows the near surface


def surfaces(model: Model, rays: CameraRays, hits: Hits, config: TrainConfig) -> Surfaces:
    """Return differentiable surface points and normals [ShadowNeuS eq:diff_intersect, eq:edge_vis]."""
    field = model.field
    pixels = hits.t.isfinite().nonzero()[:, 0]
    directions, is_field = rays.directions[pixels], hits.is_field[pixels]
    if config.use_expected_depth:
        points = rays.at(expected_depth(field, rays, config.bound, config.camera_steps, model.sharpness()))[pixels]
    else:
        points = rays.at(hits.t)[pixels]
        moved = render.moved_intersection(points, directions, field.sdf(points), field.gradient(points).detach())
        points = torch.where(is_field[:, None], moved, points)
    edges = hits.edge_t[pixels].isfinite().nonzero()[:, 0]
    t = hits.edge_t[pixels[edges]]
    silhouette = rays.eye + t[:, None] * directions[edges]
    minimum = field.sdf(silhouette)
    near = silhouette - minimum[:, None] * F.normalize(field.gradient(silhouette).detach(), dim=-1)
    points = torch.cat([points, near])
    if not config.use_moved_intersection:
        points = points.detach()
    normals = F.normalize(field.gradient(points), dim=-1)
    on_plane = F.pad(~is_field, (0, len(edges)))  # set on the known ground, which has a known normal
    up = torch.tensor([0.0, 0.0, 1.0], device=points.device)
    normals = torch.where(on_plane[:, None], up, normals)
    ratio = render.area_ratio(minimum, rays.pixel_angle * t)
    return Surfaces(points, normals, torch.cat([directions, directions[edges]]), pixels, edges, ratio)


@dataclass(frozen=True)
class LitSurfaces:
    """Surfaces under the lights of a batch."""

    towards: Float[Tensor, "lights n 3"]  # unit
    strength: Float[Tensor, "lights n 3"]  # irradiance on a surface that faces the light and sees it
    visibility: Float[Tensor, "lights n"]
    darkest: Float[Tensor, "m 3"]  # where each shadow ray lies deepest, or passes closest; constants


def shadow_rays(
    model: Model,
    view: TrainPixels,
    seen: Surfaces,
    photos: Int[Tensor, " lights"],
    config: TrainConfig,
    anneal: float,
    generator: torch.Generator,
) -> LitSurfaces:
    """Compute the visibility of the drawn photos' lights at every surface point.

    Args:
        photos: indices of the drawn photos.
        anneal: see shadow_rays.light_left.
    """
    towards, strength = (x[photos] for x in irradiance(view.scene, seen.points))
    lights = view.scene.lights[photos]
    distance = torch.linalg.vector_norm(lights[:, None, :3] - seen.points.detach(), dim=-1)
    lengths = torch.where(lights[:, 3:] > 0, distance, torch.inf)
    shape = towards.shape
    starts, normals = seen.points.expand(shape).reshape(-1, 3), seen.normals.detach().expand(shape).reshape(-1, 3)
    enter, leave = sphere_span(starts.detach(), towards.detach().reshape(-1, 3), config.bound)
    meets = (leave > enter.clamp(min=0)).nonzero()[:, 0]  # the others do not cross the field
    rays = ShadowRays(starts[meets], towards.reshape(-1, 3)[meets], normals[meets], lengths.reshape(-1)[meets])
    t, sdf = place_samples(model.field, rays, config.bound, config.samples, generator)
    if config.use_telescoped:
        left = light_left_telescoped(model.field, rays, t, sdf, model.sharpness())
    else:
        left = light_left(model.field, rays, t, model.sharpness(), anneal)
    visibility = torch.ones(len(starts), device=starts.device).index_put((meets,), left)
    darkest = rays.at(t.gather(1, sdf.argmin(1, keepdim=True)))[:, 0].detach()
    return LitSurfaces(towards, strength, visibility.reshape(shape[:2]), darkest)


def colours(model: Model, seen: Surfaces, lit: LitSurfaces, ambient: Float[Tensor, "3"]) -> Float[Tensor, "lights n 3"]:
    """Return linear radiance to the camera: (rho_d + rho_s) C_in (l . n) + ambient rho_d [ShadowNeuS eq:render_rgb].

    Args:
        ambient: irradiance of all other light, by channel.
    """
    shape = lit.towards.shape

    def spread(x: Tensor) -> Tensor:
        return x.expand(shape[0], *x.shape).flatten(0, 1)

    albedo, coefficients = model.materials(seen.points, seen.normals, model.field.features(seen.points))
    normals, towards = spread(seen.normals), lit.towards.reshape(-1, 3)
    gloss = specular(spread(coefficients), normals, towards, spread(seen.directions))
    reflected = render.shade(
        spread(albedo) + gloss, normals, towards, lit.strength.reshape(-1, 3), lit.visibility.reshape(-1)
    )
    return (reflected + spread(albedo) * ambient).reshape(shape)


def blended(values: Float[Tensor, "lights n *channels"], seen: Surfaces) -> Float[Tensor, "lights seen *channels"]:
    """Convert values at surface points to pixel values; boundary pixels are blended [ShadowNeuS eq:edge_vis]."""
    main, near = values[:, : len(seen.pixels)], values[:, len(seen.pixels) :]
    ratio = seen.ratio[(...,) + (None,) * (values.ndim - 2)].expand_as(near).reshape(-1)
    mixed = render.blend(near.reshape(-1), main[:, seen.edges].reshape(-1), ratio).reshape(near.shape)
    return main.index_copy(1, seen.edges, mixed)
