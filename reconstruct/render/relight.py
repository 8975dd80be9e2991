"""Pictures of a solved scene under lights it was never photographed with, shadows and highlights included.

relight: one light without extent. relight_soft: a round lamp of some size. environment: light from all around. The last
two take many shadow rays per pixel; their `_steps` do the same in small parts, for a page that stays responsive.
"""

import math
from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor
from torch.nn.functional import normalize

from calibration.light import Light, irradiance
from reconstruct.appearance.brdf import reflectance, specular
from reconstruct.render.environment import patches, sky_lights, sky_size
from reconstruct.render.g_buffer import Glow, RenderView
from reconstruct.render.receivers import Receivers, across, between, disc, lattice
from reconstruct.sdf.shadow_rays import shadow_starts

RAYS_PER_STEP = 2**18  # of a surrounding: a tenth of a second
PIXELS_AT_ONCE = 2**17  # 27 numbers each: 14 MB
WIDEST_LAMP = 0.95  # sine of half the angle that a lamp fills: nearer, the point would be inside it
GLOW_SAMPLES = 4  # shadow rays per patch of a lamp: a pixel receives the light of some dozens of patches


def relight(
    view: RenderView,
    light: Light,
    beam: tuple[float, ...] = (),
    ambient: Float[np.ndarray, "3"] | None = None,
) -> Float[Tensor, "height width 3"]:
    """Linear picture of the scene under one light, with hard shadows; 0 where nothing is seen.

    (albedo + specular) * irradiance * shadow + albedo * ambient [ShadowNeuS eq:render_rgb], and where the view has
    light between surfaces, albedo * what object and ground send here of that lamp, once (reconstruct.render.radiosity).

    Args:
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
    """Linear picture under a ball of even radiance in the light's place, which sends as much where nothing hides it.

    E = integral over the directions w to the lamp of L V(w) max(n . w, 0) dw, by `samples` directions spread evenly
    over the disc that the ball fills, as seen from each point, weighted by 1 / (w . a) for a the way to its centre:
    unbiased, and for radius 0 exactly `relight`. The spread is turned by an angle of its own at each point, so that
    few samples look like grain and not like steps; it belongs to the place, so pictures are reproducible.

    Args:
        radius: of the ball, world length; half its angle in radians for a directional light (the sun: 0.0047).
        samples: shadow rays per pixel.
        beam, ambient: as for `relight`.
    """
    return last(relight_steps(view, light, radius, samples, beam, ambient))


def relight_steps(
    view: RenderView,
    light: Light,
    radius: float,
    samples: int,
    beam: tuple[float, ...] = (),
    ambient: Float[np.ndarray, "3"] | None = None,
) -> Iterator[Float[Tensor, "height width 3"] | None]:
    """relight_soft in parts: None after each sample, the picture at the end."""
    lit = torch.isfinite(view.maps.depth)
    everywhere = _pixels(view, lit)
    arriving = _unhidden(everywhere, light, beam)
    partly = ~_surely_seen(view, lit, everywhere, light, radius)
    diffuse = _lamp_glow(view, light, radius, samples, beam)
    diffuse[~partly] += _facing(everywhere, light)[~partly, None] * arriving[~partly]
    there = _picture(lit, partly)
    arriving, direct_sum, mirrored = arriving[partly], torch.zeros(int(partly.sum()), 3), torch.zeros_like(arriving)
    for towards, weight, seen in _lamp_rays(_pixels(view, there), light, radius, samples):
        direct = (weight * seen / samples)[:, None] * arriving
        direct_sum += direct
        if view.gloss is not None:
            mirrored[partly] += _glossy(view, there, towards, direct)
        yield None
    diffuse[partly] += direct_sum
    radiance = view.albedo[lit] * diffuse + mirrored
    if ambient is not None:
        radiance += view.albedo[lit] * torch.as_tensor(ambient, dtype=torch.float32)
    yield _picture(lit, radiance)


def lit_share(view: RenderView, light: Light, radius: float = 0.0, samples: int = 1) -> Float[Tensor, "height width"]:
    """How much of a light each pixel's surface sees: 1 lit, 0 in shadow, turned away, or nothing there."""
    there = torch.isfinite(view.maps.depth)
    share = sum(seen / samples for _, _, seen in _lamp_rays(_pixels(view, there), light, radius, samples))
    assert isinstance(share, Tensor)
    return _picture(there, share)


def last(steps: Iterator[Tensor | None]) -> Tensor:
    """The picture that a `_steps` function ends with."""
    *_, picture = steps
    assert picture is not None
    return picture


def _picture(where: Bool[Tensor, "height width"], values: Shaped[Tensor, " n *channels"]) -> Tensor:
    """Values of the pixels that are set as a picture, 0 elsewhere."""
    out = torch.zeros(*where.shape, *values.shape[1:], dtype=values.dtype)
    out[where] = values
    return out


def _pixels(view: RenderView, there: Bool[Tensor, "height width"]) -> Receivers:
    points, normals = view.maps.points[there], view.maps.normals[there]
    return Receivers(view.grid, points, normals, shadow_starts(view.grid, points, normals, view.maps.mask[there]))


def _patches(view: RenderView, glow: Glow) -> Receivers:
    return Receivers(view.grid, glow.patches.points, glow.patches.normals, glow.patches.starts)


def _surely_seen(
    view: RenderView, lit: Bool[Tensor, "height width"], at: Receivers, light: Light, radius: float
) -> Bool[Tensor, " n"]:
    """Matt pixels that face all of a lamp and see all of it: max(n . w, 0) / (w . a) is n . a there, on average."""
    towards, distance, sine = _cone(at, light, radius)
    sure = at.sees_all(towards, distance, sine)
    return sure if view.gloss is None else sure & ~(view.gloss.weights[lit] > 0).any(-1)


def _cone(
    at: Receivers, light: Light, radius: float
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 1"], Float[Tensor, "n 1"]]:
    """Unit directions to a lamp's middle, how far that is, and the sine of half the angle that the lamp fills."""
    xyzw = torch.from_numpy(light.homogeneous()).float()
    offset = xyzw[:3] - xyzw[3] * at.points
    distance = offset.norm(dim=-1, keepdim=True)
    if light.position is None:
        return offset / distance, torch.full_like(distance, torch.inf), torch.full_like(distance, math.sin(radius))
    return offset / distance, distance, (radius / distance).clamp(max=WIDEST_LAMP)


def _facing(at: Receivers, light: Light) -> Float[Tensor, " n"]:
    """max(n . a, 0) for a the way to a lamp's middle."""
    return (at.normals * _cone(at, light, 0.0)[0]).sum(-1).clamp(min=0)


def _unhidden(at: Receivers, light: Light, beam: tuple[float, ...]) -> Float[Tensor, "n 3"]:
    """Irradiance of a lamp where nothing hides it, on surfaces that face it."""
    return torch.from_numpy(irradiance(at.points.double().numpy(), None, light, beam)).float()


def _lamp_glow(
    view: RenderView, light: Light, radius: float, samples: int, beam: tuple[float, ...]
) -> Float[Tensor, "n 3"]:
    """Irradiance of the pixels by what surfaces send each other under a lamp; 0 where they do not."""
    if view.glow is None:
        return torch.zeros(int(torch.isfinite(view.maps.depth).sum()), 3)
    at = _patches(view, view.glow)
    few = min(samples, GLOW_SAMPLES)
    rays = _lamp_rays(at, light, radius, few)
    share = torch.stack([weight * seen / few for _, weight, seen in rays]).sum(0)
    return view.glow.at_pixels(share[:, None] * _unhidden(at, light, beam))


def _lamp_rays(
    at: Receivers, light: Light, radius: float, samples: int
) -> Iterator[tuple[Float[Tensor, "n 3"], Float[Tensor, " n"], Float[Tensor, " n"]]]:
    """For each sample of a lamp: unit directions to it, max(n . w, 0) / (w . a), and how much of it is seen."""
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
    """The specular part of the pixels that are set, for the light that arrives at them; 0 on matt scenes."""
    out = torch.zeros_like(direct)
    if view.gloss is None:
        return out
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
    """Linear picture under a surrounding: sum of (albedo + specular) / pi * radiance * cosine * shadow * solid angle.

    The ground hides everything below its horizon; where the view has light between surfaces, ground and object send
    each other what they reflect of the surrounding, once. Highlights sharper than a
    patch of the map are widened to it, and what they reflect of an even surrounding is kept exact. Memory is that of a
    few copies of the picture, whatever the map's size.

    Args:
        radiance: equirectangular, row 0 around +z, column j at azimuth 2 pi (j + 0.5) / columns from +x towards +y.
        rows: of elevation to which a finer map is averaged, even; the cost is rows^2 shadow rays per pixel.
        turn: of the map about the vertical, rad, from +x towards +y.
    """
    return last(environment_steps(view, radiance, rows, turn))


def environment_steps(
    view: RenderView, radiance: Float[Tensor, "rows columns 3"], rows: int = 16, turn: float = 0.0, every: int = 1
) -> Iterator[Float[Tensor, "height width 3"] | None]:
    """environment in parts: None after each few directions, the picture at the end.

    Args:
        every: for a quick look: so many columns and rows of the ground's pixels are one computed pixel apart, and light
            is interpolated between those; the object's are all computed.
    """
    directions, amount = sky_lights(radiance, rows, turn)
    patch = math.pi / sky_size(radiance, rows)[0]
    lit = torch.isfinite(view.maps.depth)
    ground = lit & ~view.maps.mask
    there = lit & (view.maps.mask | lattice(ground, every))
    arrived = torch.zeros(int(there.sum()), 3)
    mirrored = torch.zeros_like(arrived)
    sent_on = torch.zeros(int(lit.sum()), 3)
    if view.glow is not None:
        on_patches = torch.zeros_like(view.glow.patches.points)
        for _, power, share in _sky_rays(_patches(view, view.glow), directions, amount):
            on_patches += share.T @ power
            yield None
        sent_on = view.glow.at_pixels(on_patches)
    for some, power, share in _sky_rays(_pixels(view, there), directions, amount):
        arrived += share.T @ power
        for direction, one, part in zip(some, power, share, strict=True) if view.gloss is not None else ():
            mirrored += _glossy(view, there, direction.expand_as(arrived), part[:, None] * one, patch)
        yield None
    arrived, mirrored = (between(_picture(there, x), there, ground, every)[lit] for x in (arrived, mirrored))
    radiance_seen = view.albedo[lit] * (arrived + sent_on)
    if view.gloss is not None:
        radiance_seen += mirrored * _evenness(view, lit, sky_size(radiance, rows))
    yield _picture(lit, radiance_seen)


def _sky_rays(
    at: Receivers, directions: Float[Tensor, "lights 3"], amount: Float[Tensor, "lights 3"]
) -> Iterator[tuple[Float[Tensor, "some 3"], Float[Tensor, "some 3"], Float[Tensor, "some n"]]]:
    """Some directions of a surrounding at a time, what comes from there, and max(n . w, 0) times the share seen."""
    together = max(1, RAYS_PER_STEP // max(1, len(at.starts)))
    for some, power in zip(directions.split(together), amount.split(together), strict=True):
        yield some, power, at.from_afar(some)


def _evenness(view: RenderView, lit: Bool[Tensor, "height width"], size: tuple[int, int]) -> Float[Tensor, "n 3"]:
    """What the lobes reflect of an even surrounding, over what the sum over its patches makes of it."""
    out = torch.ones(int(lit.sum()), 3)
    if view.gloss is None:
        return out
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
