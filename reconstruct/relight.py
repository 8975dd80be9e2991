"""Pictures of a solved scene under lights it was never photographed with, shadows and highlights included.

relight: one light without extent. relight_soft: a round lamp of some size. environment: light from all around. The last
two take many shadow rays per pixel; their `_steps` do the same in small parts, for a page that stays responsive.
"""

import math
from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from calibration.light import Light, irradiance
from reconstruct.edit import Edit, Ground, WholeObject, apply_edits
from reconstruct.march import visibility
from reconstruct.materials import Material, reflectance, specular
from reconstruct.shadows import SHARPNESS_PER_VOXEL, shadow_starts, unshadowed
from reconstruct.sky import patches, sky_lights, sky_size
from reconstruct.view import View

RAYS_PER_STEP = 2**18  # of a surrounding: a tenth of a second
PIXELS_AT_ONCE = 2**17  # 27 numbers each: 14 MB
WIDEST_LAMP = 0.95  # sine of half the angle that a lamp fills: nearer, the point would be inside it
TURN_HASH = (12.9898, 78.233, 37.719)  # of a place, in voxels: neighbours get unrelated fractions


def relight(
    view: View,
    light: Light,
    lobe: tuple[float, ...] = (),
    ambient: Float[np.ndarray, "3"] | None = None,
) -> Float[Tensor, "height width 3"]:
    """Linear picture of the scene under one light, with hard shadows; 0 where nothing is seen.

    (albedo + specular) * irradiance * shadow + albedo * ambient [ShadowNeuS eq:render_rgb].

    Args:
        lobe: beam profile of `calibration.light.lobe_gain`.
        ambient: radiance of a surface with albedo 1 in the dark photo.
    """
    return relight_soft(view, light, 0.0, 1, lobe, ambient)


def relight_soft(
    view: View,
    light: Light,
    radius: float,
    samples: int,
    lobe: tuple[float, ...] = (),
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
        lobe, ambient: as for `relight`.
    """
    return last(relight_steps(view, light, radius, samples, lobe, ambient))


def relight_steps(
    view: View,
    light: Light,
    radius: float,
    samples: int,
    lobe: tuple[float, ...] = (),
    ambient: Float[np.ndarray, "3"] | None = None,
) -> Iterator[Float[Tensor, "height width 3"] | None]:
    """relight_soft in parts: None after each sample, the picture at the end."""
    lit = torch.isfinite(view.maps.depth)
    points = view.maps.points[lit]
    arriving = torch.from_numpy(irradiance(points.double().numpy(), None, light, lobe)).float()
    diffuse, mirrored = torch.zeros_like(points), torch.zeros_like(points)
    for towards, weight, seen in _lamp_rays(view, lit, light, radius, samples):
        direct = (weight * seen / samples)[:, None] * arriving
        diffuse += direct
        mirrored += _glossy(view, lit, towards, direct)
        yield None
    radiance = view.albedo[lit] * diffuse + mirrored
    if ambient is not None:
        radiance += view.albedo[lit] * torch.as_tensor(ambient, dtype=torch.float32)
    yield _picture(lit, radiance)


def lit_share(view: View, light: Light, radius: float = 0.0, samples: int = 1) -> Float[Tensor, "height width"]:
    """How much of a light each pixel's surface sees: 1 lit, 0 in shadow, turned away, or nothing there."""
    there = torch.isfinite(view.maps.depth)
    share = sum(seen / samples for _, _, seen in _lamp_rays(view, there, light, radius, samples))
    assert isinstance(share, Tensor)
    return _picture(there, share)


def last(steps: Iterator[Tensor | None]) -> Tensor:
    """The picture that a `_steps` function ends with."""
    *_, picture = steps
    assert picture is not None
    return picture


def _picture(where: Bool[Tensor, "height width"], values: Float[Tensor, "n *channels"]) -> Tensor:
    """Values of the pixels that are set as a picture, 0 elsewhere."""
    out = torch.zeros(*where.shape, *values.shape[1:])
    out[where] = values
    return out


def _lamp_rays(
    view: View, there: Bool[Tensor, "height width"], light: Light, radius: float, samples: int
) -> Iterator[tuple[Float[Tensor, "n 3"], Float[Tensor, "n"], Float[Tensor, "n"]]]:
    """For each sample of a lamp: unit directions to it, max(n . w, 0) / (w . a), and how much of it is seen."""
    points, normals = view.maps.points[there], view.maps.normals[there]
    starts = shadow_starts(view.grid, points, normals, view.maps.mask[there])
    xyzw = torch.from_numpy(light.homogeneous()).float()
    offset = xyzw[:3] - xyzw[3] * points
    distance = offset.norm(dim=-1, keepdim=True)
    axis = offset / distance
    sine = (radius / distance).clamp(max=WIDEST_LAMP) if light.position is not None else torch.tensor(math.sin(radius))
    across = _across(axis, points / view.grid.spacing) if radius > 0 else None
    for x, y in _disc(samples):
        towards, along = axis, torch.ones(len(points))
        if across is not None:
            along = (1 - (sine * math.hypot(x, y)) ** 2).sqrt().expand(len(points), 1)
            towards = along * axis + sine * (x * across[0] + y * across[1])
            along = along[:, 0]
        cosine = (normals * towards).sum(-1)
        facing, seen = cosine > 0, torch.zeros(len(points))
        target = torch.cat([points + distance * towards if xyzw[3] > 0 else towards, xyzw[3].expand(len(points), 1)], 1)
        sharpness = SHARPNESS_PER_VOXEL / view.grid.spacing
        seen[facing] = visibility(view.grid, starts[facing], target[facing], sharpness)
        yield towards, cosine.clamp(min=0) / along, seen


def _disc(samples: int) -> list[tuple[float, float]]:
    """Points spread evenly over the unit disc: a sunflower's spiral, one in each ring of equal area."""
    places = []
    for k in range(samples):
        turn, reach = k * math.pi * (3 - math.sqrt(5)), math.sqrt((k + 0.5) / samples)
        places.append((reach * math.cos(turn), reach * math.sin(turn)))
    return places


def _across(
    axis: Float[Tensor, "n 3"], places: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Two unit vectors across each axis and each other, turned by an angle that is a hash of the place."""
    helper = torch.eye(3)[axis.abs().argmin(-1)]
    first = normalize(torch.linalg.cross(axis, helper), dim=-1)
    second = torch.linalg.cross(axis, first)
    turn = 2 * math.pi * ((places @ torch.tensor(TURN_HASH)).sin() * 43758.5453).frac()[:, None]
    return turn.cos() * first + turn.sin() * second, turn.cos() * second - turn.sin() * first


def _glossy(
    view: View,
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


def with_materials(view: View, on_object: Material | None = None, on_ground: Material | None = None) -> View:
    """The view with other materials on object or ground; None: as it was recovered. See reconstruct.edit."""
    chosen = ((on_object, WholeObject()), (on_ground, Ground()))
    return apply_edits(view, [Edit(material, region) for material, region in chosen if material is not None])


def environment(
    view: View, radiance: Float[Tensor, "rows columns 3"], rows: int = 16, turn: float = 0.0
) -> Float[Tensor, "height width 3"]:
    """Linear picture under a surrounding: sum of (albedo + specular) / pi * radiance * cosine * shadow * solid angle.

    The ground hides everything below its horizon, and reflects nothing onto the object. Highlights sharper than a
    patch of the map are widened to it, and what they reflect of an even surrounding is kept exact. Memory is that of a
    few copies of the picture, whatever the map's size.

    Args:
        radiance: equirectangular, row 0 around +z, column j at azimuth 2 pi (j + 0.5) / columns from +x towards +y.
        rows: of elevation to which a finer map is averaged, even; the cost is rows^2 shadow rays per pixel.
        turn: of the map about the vertical, rad, from +x towards +y.
    """
    return last(environment_steps(view, radiance, rows, turn))


def environment_steps(
    view: View, radiance: Float[Tensor, "rows columns 3"], rows: int = 16, turn: float = 0.0
) -> Iterator[Float[Tensor, "height width 3"] | None]:
    """environment in parts: None after each few directions, the picture at the end."""
    directions, amount = sky_lights(radiance, rows, turn)
    patch = math.pi / sky_size(radiance, rows)[0]
    lit = torch.isfinite(view.maps.depth)
    normals = view.maps.normals[lit]
    starts = shadow_starts(view.grid, view.maps.points[lit], normals, view.maps.mask[lit])
    arrived, mirrored = torch.zeros_like(normals), torch.zeros_like(normals)
    together = max(1, RAYS_PER_STEP // max(1, len(starts)))
    for first in range(0, len(directions), together):
        some = directions[first : first + together]
        shares = unshadowed(view.grid, starts, torch.cat([some, torch.zeros(len(some), 1)], 1))
        for direction, power, share in zip(some, amount[first : first + together], shares, strict=True):
            direct = ((normals @ direction).clamp(min=0) * share)[:, None] * power
            arrived += direct
            mirrored += _glossy(view, lit, direction.expand_as(normals), direct, patch)
        yield None
    radiance_seen = view.albedo[lit] * arrived
    if view.gloss is not None:
        radiance_seen += mirrored * _evenness(view, lit, sky_size(radiance, rows))
    yield _picture(lit, radiance_seen)


def _evenness(view: View, lit: Bool[Tensor, "height width"], size: tuple[int, int]) -> Float[Tensor, "n 3"]:
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
