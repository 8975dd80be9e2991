"""Pictures of a solved scene under lights it was never photographed with, shadows and highlights included."""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from calibration.light import Light, irradiance
from reconstruct.edit import Edit, Ground, WholeObject, apply_edits
from reconstruct.materials import Material, reflectance, specular
from reconstruct.shadows import RAYS_PER_BATCH, shadow_starts, unshadowed
from reconstruct.view import View

PIXELS_AT_ONCE = 2**17  # 27 numbers each: 14 MB


def relight(
    view: View,
    light: Light,
    lobe: tuple[float, ...] = (),
    ambient: Float[np.ndarray, "3"] | None = None,
    lamp: tuple[float, int] = (0.0, 1),
) -> Float[Tensor, "height width 3"]:
    """Linear picture of the scene under one light; 0 where nothing is seen.

    (albedo + specular) * irradiance * shadow + albedo * ambient [ShadowNeuS eq:render_rgb].

    Args:
        lobe: beam profile of `calibration.light.lobe_gain`.
        ambient: radiance of a surface with albedo 1 in the dark photo.
        lamp: (radius, samples) of a lamp of finite size: world length, or radians for a directional light; its shadows
            are the mean over so many points of a disc that faces the scene. (0, 1): hard shadows.
    """
    lit = torch.isfinite(view.maps.depth)
    points, normals = view.maps.points[lit], view.maps.normals[lit]
    direct = torch.from_numpy(irradiance(points.double().numpy(), normals.double().numpy(), light, lobe)).float()
    direct *= lit_share(view, light, lamp)[lit][:, None]
    towards = _towards(torch.from_numpy(light.homogeneous()).float(), points)
    radiance = view.albedo[lit] * direct + _glossy(view, lit, towards, direct)
    if ambient is not None:
        radiance += view.albedo[lit] * torch.as_tensor(ambient, dtype=torch.float32)
    picture = torch.zeros_like(view.albedo)
    picture[lit] = radiance
    return picture


def lit_share(view: View, light: Light, lamp: tuple[float, int] = (0.0, 1)) -> Float[Tensor, "height width"]:
    """How much of a light each pixel's surface sees: 1 lit, 0 in shadow, turned away, or nothing there."""
    seen = torch.isfinite(view.maps.depth)
    points, normals = view.maps.points[seen], view.maps.normals[seen]
    starts = shadow_starts(view.grid, points, normals, view.maps.mask[seen])
    facing = (normals * _towards(torch.from_numpy(light.homogeneous()).float(), points)).sum(-1) > 0
    share = torch.zeros(len(points))
    if facing.any():
        lights = lamp_points(light, points[facing].mean(0), *lamp)
        share[facing] = unshadowed(view.grid, starts[facing], lights).mean(0)
    out = torch.zeros(seen.shape)
    out[seen] = share
    return out


def _towards(light: Float[Tensor, "4"], points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Unit directions from points to a homogeneous light."""
    return normalize(light[:3] - light[3] * points, dim=-1)


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


def lamp_points(light: Light, target: Float[Tensor, "3"], radius: float, samples: int) -> Float[Tensor, "samples 4"]:
    """Homogeneous points that stand for a round lamp facing the target, evenly over its disc (a sunflower's spiral)."""
    centre = torch.from_numpy(light.homogeneous()).float()
    if radius <= 0 or samples <= 1:
        return centre[None]
    axis = torch.nn.functional.normalize(centre[:3] - centre[3] * target, dim=0)
    across = torch.linalg.cross(axis, torch.eye(3)[axis.abs().argmin()])
    across = torch.nn.functional.normalize(across, dim=0)
    k = torch.arange(samples)
    turn, reach = k * math.pi * (3 - math.sqrt(5)), radius * torch.sqrt((k + 0.5) / samples)
    offsets = reach[:, None] * (turn.cos()[:, None] * across + turn.sin()[:, None] * torch.linalg.cross(axis, across))
    return torch.cat([centre[:3] + offsets, centre[3].expand(samples, 1)], 1)


def environment(
    view: View, radiance: Float[Tensor, "rows columns 3"], rows: int = 16
) -> Float[Tensor, "height width 3"]:
    """Linear picture under a surrounding: sum of (albedo + specular) / pi * radiance * cosine * shadow * solid angle.

    The ground hides everything below its horizon, and reflects nothing onto the object. Highlights sharper than a
    patch of the map are widened to it, and what they reflect of an even surrounding is kept exact. Memory is that of a
    few copies of the picture, whatever the map's size.

    Args:
        radiance: equirectangular, row 0 around +z, column j at azimuth 2 pi (j + 0.5) / columns from +x towards +y.
        rows: of elevation to which a finer map is averaged, even; the cost is rows^2 shadow rays per pixel.
    """
    directions, amount = sky_lights(radiance, rows)
    patch = math.pi / _sky_size(radiance, rows)[0]
    lit = torch.isfinite(view.maps.depth)
    normals = view.maps.normals[lit]
    starts = shadow_starts(view.grid, view.maps.points[lit], normals, view.maps.mask[lit])
    arrived, mirrored = torch.zeros_like(normals), torch.zeros_like(normals)
    together = max(1, RAYS_PER_BATCH // max(1, len(starts)))
    for first in range(0, len(directions), together):
        some = directions[first : first + together]
        shares = unshadowed(view.grid, starts, torch.cat([some, torch.zeros(len(some), 1)], 1))
        for direction, power, share in zip(some, amount[first : first + together], shares, strict=True):
            direct = ((normals @ direction).clamp(min=0) * share)[:, None] * power
            arrived += direct
            mirrored += _glossy(view, lit, direction.expand_as(normals), direct, patch)
    picture = torch.zeros_like(view.albedo)
    picture[lit] = view.albedo[lit] * arrived + mirrored * _evenness(view, lit, _sky_size(radiance, rows))
    return picture


def _evenness(view: View, lit: Bool[Tensor, "height width"], size: tuple[int, int]) -> Float[Tensor, "n 3"]:
    """What the lobes reflect of an even surrounding, over what the sum over its patches makes of it."""
    out = torch.ones(int(lit.sum()), 3)
    if view.gloss is None:
        return out
    normals, weights = view.maps.normals[lit], view.gloss.weights[lit]
    summed = torch.zeros_like(out)
    directions, solid_angle = _patches(size)
    for direction, angle in zip(directions.flatten(0, 1), solid_angle.repeat_interleave(size[1]), strict=True):
        direct = ((normals @ direction).clamp(min=0) * angle / math.pi)[:, None].expand_as(normals)
        summed += _glossy(view, lit, direction.expand_as(normals), direct, math.pi / size[0])
    cosine = (normals * normalize(view.eye - view.maps.points[lit], dim=-1)).sum(-1)
    for some in torch.nonzero((summed > 0).all(-1))[:, 0].split(PIXELS_AT_ONCE):
        coefficients = torch.einsum("nm,mlc->nlc", weights[some], view.gloss.lobes)
        out[some] = reflectance(coefficients, cosine[some]) / summed[some]
    return out


def sky_lights(
    radiance: Float[Tensor, "rows columns 3"], rows: int
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Directional lights that stand for the upper half of an equirectangular map: unit directions, and powers / pi.

    Every band of elevation counts with its solid angle, so that finer maps are averaged right and the poles are not
    counted many times.
    """
    height, width = radiance.shape[:2]
    if height < 2 or rows < 2:
        raise ValueError("an environment needs two rows: one above and one below the horizon")
    size = _sky_size(radiance, rows)
    pool = torch.nn.functional.adaptive_avg_pool2d
    weight = _band_height(height)[:, None].expand(height, width)
    share = pool(weight[None], size)[0, :, :, None]
    mean = pool((radiance * weight[..., None]).permute(2, 0, 1), size).permute(1, 2, 0) / share
    directions, solid_angle = _patches(size)
    power = mean * solid_angle[:, None, None] / math.pi
    shining = power.amax(-1) > 0
    shining[size[0] // 2 :] = False  # below the horizon
    return directions[shining], power[shining]


def _sky_size(radiance: Float[Tensor, "rows columns 3"], rows: int) -> tuple[int, int]:
    """Rows and columns of patches that a map is averaged to."""
    return min(rows, len(radiance)) // 2 * 2, min(2 * rows, radiance.shape[1])


def _patches(size: tuple[int, int]) -> tuple[Float[Tensor, "rows columns 3"], Float[Tensor, "rows"]]:
    """The middle of every patch of the whole sphere, and the solid angle of one in each row."""
    theta = math.pi * (torch.arange(size[0]) + 0.5) / size[0]
    phi = 2 * math.pi * (torch.arange(size[1]) + 0.5) / size[1]
    x, y = torch.sin(theta)[:, None] * torch.cos(phi), torch.sin(theta)[:, None] * torch.sin(phi)
    directions = torch.stack([x, y, torch.cos(theta)[:, None].expand(size)], -1)
    return directions, 2 * math.pi / size[1] * _band_height(size[0])


def _band_height(rows: int) -> Float[Tensor, "rows"]:
    """The extent in z of each band of elevation on the unit sphere: by Archimedes, its area over 2 pi."""
    z = torch.cos(torch.linspace(0, math.pi, rows + 1, dtype=torch.float64))
    return (z[:-1] - z[1:]).float()
