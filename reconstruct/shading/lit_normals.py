"""Normals from which lights reach a pixel: what shadow pictures say of the way a surface faces.

A lit pixel faces its light. A dark one is turned away, or lies in a cast shadow; where the surface so far, which as a
shadow hull contains the object, does not stand between pixel and light, it is most probably turned away. Each photo so
cuts the sphere of normals in two [Okabe, Sato and Sato, Attached Shadow Coding, ICCV 2009]. With L of a light's
direction, the log odds of a candidate normal n, against a normal that is turned from every light, are

    sum over photos of facing(n . L) * (-log WRONG if lit, log P(cast) if dark)

and the estimate is the mean of all candidates that the camera can see, weighted by their odds.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

CANDIDATES = 400  # normals, evenly over the sphere: 10 degrees apart
WRONG = 0.02  # share of lit samples that are turned from their light
CAST_FREE, CAST_BLOCKED = 0.05, 0.9  # of dark samples that face their light: cast shadows, by the surface so far
GRAZING = 0.06  # cosine over which a normal turns from dark to lit
VISIBLE = 0.05  # least cosine of a visible normal to the ray that sees it
OFF_AXIS = 0.4  # cosine: a normal turned further from the mean of all rays is not asked
KNOWN, OPEN = np.radians(15.0), np.radians(30.0)  # radius of the cap of likely normals: confidence 1 and 0
CHUNK = 4096  # pixels at once


def normals_of_lit(
    lit: Float[Tensor, "photos n"],
    confidence: Float[Tensor, "photos n"],
    towards: Float[Tensor, "photos n 3"],
    free: Float[Tensor, "photos n"],
    rays: Float[Tensor, "n 3"],
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]]:
    """Return unit normals and their confidence in [0, 1], world frame.

    Args:
        lit: 1 = the light reaches the pixel.
        confidence: in [0, 1], of that.
        towards: unit, world, from each pixel's point to each light.
        free: 1 = nothing of the surface so far stands between the point and the light.
        rays: unit, world, from the camera.
    """
    candidates = _even_directions(CANDIDATES)
    candidates = candidates[candidates @ rays.mean(0) < OFF_AXIS]
    cast = CAST_FREE * free + CAST_BLOCKED * (1 - free)
    odds = confidence * torch.where(lit > 0.5, -np.log(WRONG), cast.log())
    normals, length = torch.empty(len(rays), 3), torch.empty(len(rays))
    for start in range(0, len(rays), CHUNK):
        own = slice(start, start + CHUNK)
        total = torch.where(rays[own] @ candidates.T < -VISIBLE, 0.0, -torch.inf)
        for photo, worth in zip(towards, odds, strict=True):
            total += worth[own, None] * ((photo[own] @ candidates.T) / GRAZING + 0.5).clamp(0, 1)
        mean = torch.softmax(total, 1) @ candidates
        length[own] = mean.norm(dim=-1)
        normals[own] = mean / length[own, None].clamp(min=1e-6)
    radius = torch.arccos((2 * length - 1).clamp(-1, 1))  # of a cap whose mean is as long
    return normals, ((OPEN - radius) / (OPEN - KNOWN)).clamp(0, 1)


def _even_directions(count: int) -> Float[Tensor, "count 3"]:
    """Return unit vectors on a Fibonacci spiral."""
    index = torch.arange(count, dtype=torch.float64)
    z = 1 - (2 * index + 1) / count
    angle, level = index * np.pi * (3 - 5**0.5), (1 - z * z).sqrt()
    return torch.stack([level * angle.cos(), level * angle.sin(), z], -1).float()
