"""One iteration of the training: draw rays, intersect them with the field, shade them, and compare with the photos.

Differentiable rendering of the trained field: surface points, visibility of the lights, and colours.

Losses of the training: photos, unit gradient, free space around the object, and the ground on its plane.

Lengths are those of the unit frame.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from reconstruct.scene import irradiance
from reconstruct.shadowneus.camera_rays import (
    CameraRays,
    Hits,
    ShadowRays,
    expected_depth,
    find_hits,
    light_left,
    light_left_telescoped,
    place_samples,
    sphere_span,
)
from reconstruct.shadowneus.config import TrainConfig
from reconstruct.shadowneus.field import SdfField, specular
from reconstruct.shadowneus.model import Model
from reconstruct.shadowneus.train_pixels import Batch, TrainPixels, draw
from reconstruct.torch_sdf import equations as render

SMOOTH = 0.1  # below this an error counts by its square (as in the authors' code; the text states L1)
SHELL = (0.99, 1.03)  # of the bounding sphere's radius: a shell that must be empty
REACH = 1.2  # of the bounding sphere's radius: the ground is held to its plane up to here
LAYER = 0.05  # of the bounding sphere's radius: thickness of a ground that marching cannot miss
JITTER = 1e-4  # of the copies of surface points that the eikonal loss is taken at (the authors' code), unit frame


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


def smooth_l1(error: Float[Tensor, "*batch"], weights: Float[Tensor, "*batch"]) -> Float[Tensor, ""]:
    """Return the weighted mean of the smooth L1 norm [ShadowNeuS eq:loss_shadow, eq:loss_rgb]; 0 without weights."""
    each = F.smooth_l1_loss(error, torch.zeros_like(error), beta=SMOOTH, reduction="none")
    return (each * weights).sum() / weights.sum().clamp(min=1e-5)


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
        of_pixels = smooth_l1(error, share[..., None].expand_as(error))
        terms["colour"] = weights.colour * (3 * of_pixels)  # summed over channels [ShadowNeuS eq:loss_rgb]
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
    slope = torch.linalg.vector_norm(field.gradient(points.detach()), dim=-1)
    return terms | {"eikonal": weights.eikonal * ((slope - 1) ** 2).mean()}


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
