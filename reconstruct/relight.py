"""Pictures of a solved scene under lights it was never photographed with, shadows included, from the SDF."""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from calibration.light import Light, irradiance
from reconstruct.grid import SdfGrid
from reconstruct.march import visibility
from reconstruct.view import View

LIFT_VOXELS = 1.0  # shadow rays start this far above the object: its own roughness casts no shadow
SHARPNESS_PER_VOXEL = 8.0  # NeuS s of a shadow's edge: 10 % to 90 % within half a voxel


def relight(
    view: View,
    light: Light,
    lobe: tuple[float, ...] = (),
    ambient: Float[np.ndarray, "3"] | None = None,
    lamp: tuple[float, int] = (0.0, 1),
) -> Float[Tensor, "height width 3"]:
    """Linear picture of the scene under one light: albedo * (irradiance * shadow + ambient). 0 where nothing is seen.

    Args:
        lobe: beam profile of `calibration.light.lobe_gain`.
        ambient: radiance of a surface with albedo 1 in the dark photo.
        lamp: (radius, samples) of a lamp of finite size: world length, or radians for a directional light; its shadows
            are the mean over so many points of a disc that faces the scene. (0, 1): hard shadows.
    """
    lit = torch.isfinite(view.maps.depth)
    points, normals, starts = view.maps.points[lit], view.maps.normals[lit], _shadow_starts(view, lit)
    arrived = irradiance(points.double().numpy(), normals.double().numpy(), light, lobe)
    radiance = torch.from_numpy(arrived).float()
    facing = radiance.amax(-1) > 0
    if facing.any():
        lights = lamp_points(light, points[facing].mean(0), *lamp)
        radiance[facing] *= _unshadowed(view.grid, starts[facing], lights)[:, None]
    if ambient is not None:
        radiance += torch.as_tensor(ambient, dtype=torch.float32)
    picture = torch.zeros_like(view.albedo)
    picture[lit] = view.albedo[lit] * radiance
    return picture


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


def _shadow_starts(view: View, lit: Bool[Tensor, "height width"]) -> Float[Tensor, "n 3"]:
    """Where shadow rays leave: just above the object, and on the ground itself, which is exact."""
    lift = LIFT_VOXELS * view.grid.spacing * view.maps.mask[lit]
    return view.maps.points[lit] + lift[:, None] * view.maps.normals[lit]


def _unshadowed(grid: SdfGrid, starts: Float[Tensor, "n 3"], lights: Float[Tensor, "samples 4"]) -> Float[Tensor, "n"]:
    """The share of the lights that each point sees past the object."""
    total = torch.zeros(len(starts))
    for light in lights:
        total += visibility(grid, starts, light.expand(len(starts), 4), SHARPNESS_PER_VOXEL / grid.spacing)
    return total / len(lights)


def environment(
    view: View, radiance: Float[Tensor, "rows columns 3"], rows: int = 16
) -> Float[Tensor, "height width 3"]:
    """Linear picture under a surrounding: albedo / pi * sum of radiance * cosine * shadow * solid angle.

    The ground hides everything below its horizon, and reflects nothing onto the object.

    Args:
        radiance: equirectangular, row 0 around +z, column j at azimuth 2 pi (j + 0.5) / columns from +x towards +y.
        rows: of elevation to which a finer map is averaged, even; the cost is rows^2 shadow rays per pixel.
    """
    directions, amount = sky_lights(radiance, rows)
    lit = torch.isfinite(view.maps.depth)
    normals, starts = view.maps.normals[lit], _shadow_starts(view, lit)
    total = torch.zeros_like(normals)
    for direction, power in zip(directions, amount, strict=True):
        cosine = normals @ direction
        facing = cosine > 0
        if not facing.any():
            continue
        shadow = _unshadowed(view.grid, starts[facing], torch.cat([direction, torch.zeros(1)])[None])
        total[facing] += (cosine[facing] * shadow)[:, None] * power
    picture = torch.zeros_like(view.albedo)
    picture[lit] = view.albedo[lit] * total
    return picture


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
    size = (min(rows, height) // 2 * 2, min(2 * rows, width))
    pool = torch.nn.functional.adaptive_avg_pool2d
    weight = _band_height(height)[:, None].expand(height, width)
    share = pool(weight[None], size)[0, :, :, None]
    mean = pool((radiance * weight[..., None]).permute(2, 0, 1), size).permute(1, 2, 0) / share
    theta = math.pi * (torch.arange(size[0]) + 0.5) / size[0]
    phi = 2 * math.pi * (torch.arange(size[1]) + 0.5) / size[1]
    x, y = torch.sin(theta)[:, None] * torch.cos(phi), torch.sin(theta)[:, None] * torch.sin(phi)
    directions = torch.stack([x, y, torch.cos(theta)[:, None].expand(size)], -1)
    solid_angle = 2 * math.pi / size[1] * _band_height(size[0])
    power = mean * solid_angle[:, None, None] / math.pi
    shining = power.amax(-1) > 0
    shining[size[0] // 2 :] = False  # below the horizon
    return directions[shining], power[shining]


def _band_height(rows: int) -> Float[Tensor, "rows"]:
    """The extent in z of each band of elevation on the unit sphere: by Archimedes, its area over 2 pi."""
    z = torch.cos(torch.linspace(0, math.pi, rows + 1, dtype=torch.float64))
    return (z[:-1] - z[1:]).float()
