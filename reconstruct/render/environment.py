"""Environment maps: patches with their solid angles, and exposure.

A radiance map is equirectangular: row 0 around +z, column j at azimuth 2 pi (j + 0.5) / columns from +x towards +y.
"""

import math

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

FINER = 6  # a bright patch is divided into this many rows and columns
BRIGHT = 0.1  # share of all light: a patch that sends more casts a visible shadow of its own
LEAST_DIVIDED = 8  # rows: fewer are for a quick look
WHITE_PAPER = 0.6  # linear, 80 % of full scale, on open ground: slopes that face a low sun are brighter than that
FINEST_MAP = (256, 512)  # a texel is 0.7 degrees, a tenth of the patches that light is summed over
LUMINANCE = (0.2126, 0.7152, 0.0722)  # of linear RGB, ITU-R BT.709


def sky_lights(
    radiance: Float[Tensor, "rows columns 3"], rows: int, turn: float = 0.0
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Approximate the upper half of an equirectangular map by directional lights.

    Every patch that is not black gives one light, in the mean direction of its radiance, so a sun smaller than a patch
    keeps its place. A patch that sends more than a tenth of all light is divided once more, so that a sun disc casts a
    soft shadow instead of two hard ones. Every texel counts once, weighted by its solid angle.

    Args:
        radiance: linear map.
        rows: bands of elevation that the sphere is divided into, even; fewer if the map has fewer.
        turn: rotation of the map with its patches about the vertical, rad.

    Returns:
        Unit world directions towards the lights, and their powers / pi.
    """
    size = sky_size(radiance, rows)
    finer = min(FINER, len(radiance) // size[0], radiance.shape[1] // size[1]) if size[0] >= LEAST_DIVIDED else 1
    whole, parts = _upper(radiance, size), _upper(radiance, (finer * size[0], finer * size[1]))
    bright = whole[1].sum(-1) > BRIGHT * whole[1].sum()
    divided = bright.reshape(size[0] // 2, size[1]).repeat_interleave(finer, 0).repeat_interleave(finer, 1).flatten()
    directions, power = (torch.cat([whole[i][~bright], parts[i][divided]]) for i in range(2))
    shining = power.amax(-1) > 0
    c, s = math.cos(turn), math.sin(turn)
    return directions[shining] @ torch.tensor([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]), power[shining]


def _upper(
    radiance: Float[Tensor, "rows columns 3"], size: tuple[int, int]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Return the mean light direction and the power of each patch above the horizon; dark patches give their centre."""
    texels, _ = patches((len(radiance), radiance.shape[1]))
    mean = patch_power((radiance @ torch.tensor(LUMINANCE))[..., None] * texels, size)
    mean = torch.where(mean.norm(dim=-1, keepdim=True) > 0, mean, patches(size)[0])
    directions = torch.nn.functional.normalize(mean, dim=-1)
    return directions[: size[0] // 2].flatten(0, 1), patch_power(radiance, size)[: size[0] // 2].flatten(0, 1)


def patch_power(
    radiance: Float[Tensor, "rows columns channels"], size: tuple[int, int]
) -> Float[Tensor, "patch_rows patch_columns channels"]:
    """Return radiance * solid angle / pi summed over each patch, linear; a texel on an edge is divided by area."""
    height, width = radiance.shape[:2]
    texels = radiance.double() * (2 * band_height(height).double() / width)[:, None, None]
    mean = cv2.resize(texels.numpy(), size[::-1], interpolation=cv2.INTER_AREA).reshape(*size, -1)
    return torch.from_numpy(mean * (height / size[0] * width / size[1])).float()


def sky_size(radiance: Float[Tensor, "rows columns 3"], rows: int) -> tuple[int, int]:
    """Return the rows and columns of patches that a map is averaged to.

    Raises:
        ValueError: fewer than two rows.
    """
    if len(radiance) < 2 or rows < 2:
        raise ValueError("an environment needs two rows: one above and one below the horizon")
    return min(rows, len(radiance)) // 2 * 2, min(2 * rows, radiance.shape[1])


def patches(size: tuple[int, int]) -> tuple[Float[Tensor, "rows columns 3"], Float[Tensor, " rows"]]:
    """Return every patch's centre direction (unit, world), and the solid angle (sr) of a patch in each row."""
    theta = math.pi * (torch.arange(size[0]) + 0.5) / size[0]
    phi = 2 * math.pi * (torch.arange(size[1]) + 0.5) / size[1]
    x, y = torch.sin(theta)[:, None] * torch.cos(phi), torch.sin(theta)[:, None] * torch.sin(phi)
    directions = torch.stack([x, y, torch.cos(theta)[:, None].expand(size)], -1)
    return directions, 2 * math.pi / size[1] * band_height(size[0])


def band_height(rows: int) -> Float[Tensor, " rows"]:
    """Return the z extent of each elevation band of the unit sphere, which is its area / (2 pi) (Archimedes)."""
    z = torch.cos(torch.linspace(0, math.pi, rows + 1, dtype=torch.float64))
    return (z[:-1] - z[1:]).float()


# --- what can be done to a map ---------------------------------------------------------------------------------------


def ground_light(radiance: Float[Tensor, "rows columns 3"]) -> Float[Tensor, "3"]:
    """Return the linear radiance of open level ground of albedo 1: 1 / pi * integral of radiance * cosine above."""
    power = patch_power(radiance, (len(radiance) // 2 * 2, radiance.shape[1]))
    upper = len(power) // 2
    theta = math.pi * (torch.arange(upper) + 0.5) / len(power)
    return (power[:upper] * torch.cos(theta)[:, None, None]).sum((0, 1))


def exposed(radiance: Float[Tensor, "rows columns 3"]) -> Float[Tensor, "rows columns 3"]:
    """Scale a map so that white paper on open ground has the value WHITE_PAPER; files use different scales.

    A map that is black above the horizon is returned unchanged.
    """
    bright = float((ground_light(radiance) * torch.tensor(LUMINANCE)).sum())
    return radiance * (WHITE_PAPER / bright) if bright > 0 else radiance


def sky_map(panorama: Float[np.ndarray, "rows columns 3"]) -> Float[Tensor, "map_rows map_columns 3"]:
    """Return a panorama from `read_panorama`, exposed and reduced to at most FINEST_MAP; more would not be visible."""
    radiance = torch.from_numpy(panorama)
    size = min(len(radiance), FINEST_MAP[0]) // 2 * 2, min(radiance.shape[1], FINEST_MAP[1])
    return exposed(patch_power(radiance, size) * math.pi / patches(size)[1][:, None, None])
