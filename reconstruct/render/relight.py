"""Relighting: pictures of a solved scene under new lights, with shadows and highlights.

relight: one light without extent. relight_soft: a spherical lamp. environment: an environment map.

Predicted photos of a calibrated scene, for comparison with the real photos.
"""

import math
from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor
from torch.nn.functional import normalize

from calibration.calibration import Calibration
from calibration.light import Light, irradiance
from reconstruct.appearance.brdf import reflectance, specular
from reconstruct.render.environment import patches, sky_lights, sky_size
from reconstruct.render.g_buffer import Interreflection, RenderView
from reconstruct.render.receivers import Receivers, across, disc
from reconstruct.sdf.rays import shadow_starts

RAYS_PER_STEP = 2**18  # of an environment map: a tenth of a second
PIXELS_AT_ONCE = 2**17  # 27 numbers each: 14 MB
WIDEST_LAMP = 0.95  # largest sine of a lamp's angular radius: nearer, the point would be inside the lamp
GLOW_SAMPLES = 4  # shadow rays per patch and lamp; few suffice, as a pixel receives light from dozens of patches


def relight(
    view: RenderView,
    light: Light,
    beam: tuple[float, ...] = (),
    ambient: Float[np.ndarray, "3"] | None = None,
) -> Float[Tensor, "height width 3"]:
    """Render the scene, linear, under one light with hard shadows; 0 where nothing is seen.

    (albedo + specular) * irradiance * shadow + albedo * ambient [ShadowNeuS eq:render_rgb]. If the view has
    interreflection, albedo * the irradiance of one bounce is added (reconstruct.render.radiosity).

    Args:
        light: world frame.
        beam: beam profile of `calibration.light.beam_gain`.
        ambient: radiance of a surface with albedo 1 in the dark photo.
    """
    return relight_soft(view, light, 0.0, 1, beam, ambient)


def relight_soft(
    view: RenderView,
    light: Light,
    radius: float,
    samples: int,
    beam: tuple[float, ...] = (),
    ambient: Float[np.ndarray, "3"] | None = None,
) -> Float[Tensor, "height width 3"]:
    """Render the scene, linear, under a ball of uniform radiance at the light's place, with the light's power.

    E = integral over the directions w to the lamp of L V(w) max(n . w, 0) dw. It is estimated from `samples` directions
    spread evenly over the ball's disc as seen from each point, weighted by 1 / (w . a), with a the direction to the
    ball's centre. The estimate is unbiased, and for radius 0 equal to `relight`. Each point turns the samples by its
    own angle, so that few samples give grain, not steps; the angle depends on position, so pictures are reproducible.

    Args:
        light: the ball's centre and power, world frame.
        radius: of the ball, world length; for a directional light its angular radius, rad (the sun: 0.0047).
        samples: shadow rays per pixel.
        beam, ambient: as for `relight`.
    """
    lit = torch.isfinite(view.maps.depth)
    everywhere = _pixels(view, lit)
    arriving = _unhidden(everywhere, light, beam)
    partly = ~_surely_seen(view, lit, everywhere, light, radius)
    diffuse = _lamp_interreflection(view, light, radius, samples, beam)
    diffuse[~partly] += _facing(everywhere, light)[~partly, None] * arriving[~partly]
    there = _picture(lit, partly)
    arriving, direct_sum, mirrored = arriving[partly], torch.zeros(int(partly.sum()), 3), torch.zeros_like(arriving)
    for towards, weight, seen in _lamp_rays(_pixels(view, there), light, radius, samples):
        direct = (weight * seen / samples)[:, None] * arriving
        direct_sum += direct
        if view.gloss is not None:
            mirrored[partly] += _glossy(view, there, towards, direct)
    diffuse[partly] += direct_sum
    radiance = view.albedo[lit] * diffuse + mirrored
    if ambient is not None:
        radiance += view.albedo[lit] * torch.as_tensor(ambient, dtype=torch.float32)
    return _picture(lit, radiance)


def lit_share(view: RenderView, light: Light, radius: float = 0.0, samples: int = 1) -> Float[Tensor, "height width"]:
    """Return the visibility of a light at each pixel: 1 lit; 0 in shadow, facing away, or without a surface."""
    there = torch.isfinite(view.maps.depth)
    share = sum(seen / samples for _, _, seen in _lamp_rays(_pixels(view, there), light, radius, samples))
    assert isinstance(share, Tensor)
    return _picture(there, share)


def _picture(where: Bool[Tensor, "height width"], values: Shaped[Tensor, " n *channels"]) -> Tensor:
    """Return a picture with the values at the pixels set in `where`, 0 elsewhere."""
    out = torch.zeros(*where.shape, *values.shape[1:], dtype=values.dtype)
    out[where] = values
    return out


def _pixels(view: RenderView, there: Bool[Tensor, "height width"]) -> Receivers:
    points, normals = view.maps.points[there], view.maps.normals[there]
    return Receivers(view.grid, points, normals, shadow_starts(view.grid, points, normals, view.maps.mask[there]))


def _patches(view: RenderView, interreflection: Interreflection) -> Receivers:
    return Receivers(
        view.grid, interreflection.patches.points, interreflection.patches.normals, interreflection.patches.starts
    )


def _surely_seen(
    view: RenderView, lit: Bool[Tensor, "height width"], at: Receivers, light: Light, radius: float
) -> Bool[Tensor, " n"]:
    """Find matt pixels that surely see a whole lamp; there max(n . w, 0) / (w . a) is n . a on average."""
    towards, distance, sine = _cone(at, light, radius)
    sure = at.sees_whole_lamp(towards, distance, sine)
    return sure if view.gloss is None else sure & ~(view.gloss.weights[lit] > 0).any(-1)


def _cone(
    at: Receivers, light: Light, radius: float
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 1"], Float[Tensor, "n 1"]]:
    """Return unit directions and distances to a lamp's centre, and the sine of its angular radius."""
    xyzw = torch.from_numpy(light.homogeneous()).float()
    offset = xyzw[:3] - xyzw[3] * at.points
    distance = offset.norm(dim=-1, keepdim=True)
    if light.position is None:
        return offset / distance, torch.full_like(distance, torch.inf), torch.full_like(distance, math.sin(radius))
    return offset / distance, distance, (radius / distance).clamp(max=WIDEST_LAMP)


def _facing(at: Receivers, light: Light) -> Float[Tensor, " n"]:
    """Return max(n . a, 0), with a the unit direction to a lamp's centre."""
    return (at.normals * _cone(at, light, 0.0)[0]).sum(-1).clamp(min=0)


def _unhidden(at: Receivers, light: Light, beam: tuple[float, ...]) -> Float[Tensor, "n 3"]:
    """Return the unoccluded irradiance of a lamp on surfaces that face it."""
    return torch.from_numpy(irradiance(at.points.double().numpy(), None, light, beam)).float()


def _lamp_interreflection(
    view: RenderView, light: Light, radius: float, samples: int, beam: tuple[float, ...]
) -> Float[Tensor, "n 3"]:
    """Return the irradiance of the pixels by interreflection under a lamp; 0 if the view has none."""
    if view.interreflection is None:
        return torch.zeros(int(torch.isfinite(view.maps.depth).sum()), 3)
    at = _patches(view, view.interreflection)
    few = min(samples, GLOW_SAMPLES)
    rays = _lamp_rays(at, light, radius, few)
    share = torch.stack([weight * seen / few for _, weight, seen in rays]).sum(0)
    return view.interreflection.at_pixels(share[:, None] * _unhidden(at, light, beam))


def _lamp_rays(
    at: Receivers, light: Light, radius: float, samples: int
) -> Iterator[tuple[Float[Tensor, "n 3"], Float[Tensor, " n"], Float[Tensor, " n"]]]:
    """Yield for each sample of a lamp: unit directions w, max(n . w, 0) / (w . a), and visibility."""
    points, normals = at.points, at.normals
    axis, distance, sine = _cone(at, light, radius)
    sides = across(axis, points / at.grid.spacing) if radius > 0 else None
    for x, y in disc(samples):
        towards, along = axis, torch.ones(len(points))
        if sides is not None:
            along = (1 - (sine * math.hypot(x, y)) ** 2).sqrt().expand(len(points), 1)
            towards = along * axis + sine * (x * sides[0] + y * sides[1])
            along = along[:, 0]
        cosine = (normals * towards).sum(-1)
        is_near = light.position is not None
        place = points + distance * towards if is_near else towards
        target = torch.cat([place, torch.full_like(distance, is_near)], 1)
        yield towards, cosine.clamp(min=0) / along, at.seen(target, cosine > 0)


def _glossy(
    view: RenderView,
    lit: Bool[Tensor, "height width"],
    towards: Float[Tensor, "n 3"],
    direct: Float[Tensor, "n 3"],
    blur: float = 0.0,
) -> Float[Tensor, "n 3"]:
    """Return the specular radiance of the pixels set in `lit`, for the irradiance `direct`."""
    assert view.gloss is not None
    out = torch.zeros_like(direct)
    shiny = torch.nonzero((view.gloss.weights[lit] > 0).any(-1) & (direct > 0).any(-1))[:, 0]
    points, normals, weights = view.maps.points[lit], view.maps.normals[lit], view.gloss.weights[lit]
    for some in shiny.split(PIXELS_AT_ONCE):
        coefficients = torch.einsum("nm,mlc->nlc", weights[some], view.gloss.lobes)
        eye = normalize(view.eye - points[some], dim=-1)
        out[some] = specular(coefficients, normals[some], towards[some], eye, blur) * direct[some]
    return out


def environment(
    view: RenderView, radiance: Float[Tensor, "rows columns 3"], rows: int = 16, turn: float = 0.0
) -> Float[Tensor, "height width 3"]:
    """Render the scene, linear, under an environment map.

    Sum of (albedo + specular) / pi * radiance * cosine * shadow * solid angle. The ground hides everything below its
    horizon. If the view has interreflection, one bounce is added. Highlights sharper than a patch of the map are
    widened to it, and their reflection of a uniform map stays exact. Memory: a few copies of the picture, for any map.

    Args:
        radiance: equirectangular, row 0 around +z, column j at azimuth 2 pi (j + 0.5) / columns from +x towards +y.
        rows: elevation bands that a finer map is averaged to, even; the cost is rows^2 shadow rays per pixel.
        turn: rotation of the map about the vertical, rad, from +x towards +y.
    """
    directions, amount = sky_lights(radiance, rows, turn)
    patch = math.pi / sky_size(radiance, rows)[0]
    lit = torch.isfinite(view.maps.depth)
    arrived = torch.zeros(int(lit.sum()), 3)
    mirrored, sent_on = torch.zeros_like(arrived), torch.zeros_like(arrived)
    if view.interreflection is not None:
        on_patches = torch.zeros_like(view.interreflection.patches.points)
        for _, power, share in _sky_rays(_patches(view, view.interreflection), directions, amount):
            on_patches += share.T @ power
        sent_on = view.interreflection.at_pixels(on_patches)
    for some, power, share in _sky_rays(_pixels(view, lit), directions, amount):
        arrived += share.T @ power
        for direction, one, part in zip(some, power, share, strict=True) if view.gloss is not None else ():
            mirrored += _glossy(view, lit, direction.expand_as(arrived), part[:, None] * one, patch)
    radiance_seen = view.albedo[lit] * (arrived + sent_on)
    if view.gloss is not None:
        radiance_seen += mirrored * _evenness(view, lit, sky_size(radiance, rows))
    return _picture(lit, radiance_seen)


def _sky_rays(
    at: Receivers, directions: Float[Tensor, "lights 3"], amount: Float[Tensor, "lights 3"]
) -> Iterator[tuple[Float[Tensor, "some 3"], Float[Tensor, "some 3"], Float[Tensor, "some n"]]]:
    """Yield a few map directions at a time, their powers, and max(n . w, 0) * visibility at each point."""
    together = max(1, RAYS_PER_STEP // max(1, len(at.starts)))
    for some, power in zip(directions.split(together), amount.split(together), strict=True):
        yield some, power, at.from_afar(some)


def _evenness(view: RenderView, lit: Bool[Tensor, "height width"], size: tuple[int, int]) -> Float[Tensor, "n 3"]:
    """Return the exact lobe reflectance of a uniform map over its sum over patches, a correction factor."""
    assert view.gloss is not None
    out = torch.ones(int(lit.sum()), 3)
    normals, weights = view.maps.normals[lit], view.gloss.weights[lit]
    summed = torch.zeros_like(out)
    directions, solid_angle = patches(size)
    for direction, angle in zip(directions.flatten(0, 1), solid_angle.repeat_interleave(size[1]), strict=True):
        direct = ((normals @ direction).clamp(min=0) * angle / math.pi)[:, None].expand_as(normals)
        summed += _glossy(view, lit, direction.expand_as(normals), direct, math.pi / size[0])
    cosine = (normals * normalize(view.eye - view.maps.points[lit], dim=-1)).sum(-1)
    for some in torch.nonzero((summed > 0).all(-1))[:, 0].split(PIXELS_AT_ONCE):
        coefficients = torch.einsum("nm,mlc->nlc", weights[some], view.gloss.lobes)
        out[some] = reflectance(coefficients, cosine[some]) / summed[some]
    return out


def photographed(view: RenderView, calibration: Calibration, photo: str) -> Float[Tensor, "height width 3"]:
    """Render the scene, linear, under all lights of one photo and the ambient light."""
    first, *others = _lights_of(calibration, photo)
    picture = relight(view, first, calibration.beam, calibration.ambient)
    for light in others:  # without ambient light, which counts once
        picture = picture + relight(view, light, calibration.beam)
    return picture


def shadow_picture(view: RenderView, calibration: Calibration, photo: str) -> Float[Tensor, "height width 3"]:
    """Return 1 at the view's pixels where light of one photo arrives, 0 where none does."""
    share = torch.stack([lit_share(view, light) for light in _lights_of(calibration, photo)]).amax(0)
    return share[..., None].expand(*share.shape, 3)


def _lights_of(calibration: Calibration, photo: str) -> list[Light]:
    return [light for light in calibration.lights if light.photo == photo]
