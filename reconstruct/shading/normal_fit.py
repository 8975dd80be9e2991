"""The normal of one pixel: robust photometric stereo under near lights, with a prior.

The value of a lit sample is I_k = albedo (E_k (n . l_k) + indirect_k), with E_k the irradiance of light k on a surface
that faces it. This is linear in b = albedo * n and solved by weighted least squares. The weights (Geman and McClure's)
shrink for outliers such as shadows and highlights.

Normals from which lights reach a pixel: what shadow pictures say of the way a surface faces.

A lit pixel faces its light. A dark one is turned away, or lies in a cast shadow; where the surface so far, which as a
shadow hull contains the object, does not stand between pixel and light, it is most probably turned away. Each photo so
cuts the sphere of normals in two [Okabe, Sato and Sato, Attached Shadow Coding, ICCV 2009]. With L of a light's
direction, the log odds of a candidate normal n, against a normal that is turned from every light, are

    sum over photos of facing(n . L) * (-log WRONG if lit, log P(cast) if dark)

and the estimate is the mean of all candidates that the camera can see, weighted by their odds.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from reconstruct.sdf.rays import PerThread, run, thread_count
from reconstruct.shading import normal_kernels as kernels
from reconstruct.shading.noise import Noise
from reconstruct.shading.normal_kernels import CAST_SHADOW, HIGHLIGHT_PATIENCE, INDIRECT_SHARE, TAIL

CANDIDATES = 400  # normals, evenly over the sphere: 10 degrees apart
WRONG = 0.02  # share of lit samples that are turned from their light
CAST_FREE, CAST_BLOCKED = 0.05, 0.9  # of dark samples that face their light: cast shadows, by the surface so far
GRAZING = 0.06  # cosine over which a normal turns from dark to lit
VISIBLE = 0.05  # least cosine of a visible normal to the ray that sees it
OFF_AXIS = 0.4  # cosine: a normal turned further from the mean of all rays is not asked
KNOWN, OPEN = np.radians(15.0), np.radians(30.0)  # radius of the cap of likely normals: confidence 1 and 0
CHUNK = 4096  # pixels at once
MODEL_SHARE = 0.03  # one sigma of the error of Lambert's law and the light model, of the predicted value
STRAY_SHARE = 0.3 * MODEL_SHARE  # one sigma of unmodelled light, of the irradiance of a surface that faces the light


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


@dataclass(frozen=True)
class Pixels:
    """Some object pixels: their values, and the light that would reach them. World frame, linear."""

    value: Float[Tensor, "n photos"]  # mean of RGB
    usable: Bool[Tensor, "n photos"]
    towards: Float[Tensor, "n photos 3"]  # unit, to the light
    strength: Float[Tensor, "n photos"]  # irradiance on a surface that faces the light
    bounce: Float[Tensor, " photos"]  # irradiance of lit ground on a surface that faces down
    ambient: float | Float[Tensor, "n photos"]  # irradiance whichever way the surface faces
    noise: Noise
    stray: float = STRAY_SHARE

    @cached_property
    def given_variance(self) -> Float[Tensor, "n photos"]:
        """The part of a lit sample's variance that does not depend on the result: noise and model error."""
        return self.noise.sigma(self.value.clamp(min=0)) ** 2 + (MODEL_SHARE * self.value) ** 2

    def variance(self, albedo: Float[Tensor, "n 1"], indirect: Float[Tensor, "n photos"]) -> Float[Tensor, "n photos"]:
        """Return the variance of a lit sample: the given part, unmodelled light, and unknown indirect light.

        Args:
            indirect: value of the sample in shadow.
        """
        return self.given_variance + (self.stray * albedo * self.strength) ** 2 + (INDIRECT_SHARE * indirect) ** 2


@dataclass(frozen=True)
class Prior:
    """Prior albedo and normals of some pixels."""

    albedo: Float[Tensor, " n"]  # of neighbours, mean of RGB
    normals: Float[Tensor, "n 3"] | None  # world, of the surface so far; 0 where there is none


def indirect_light(pixels: Pixels, normal: Float[Tensor, "n 3"]) -> Float[Tensor, "n photos"]:
    """Return the irradiance (linear, albedo 1) of a surface in shadow: ambient light and the ground's bounce.

    The bounce is scaled by (1 - n_z) / 2, the form factor of an infinite plane below.

    Args:
        normal: unit, world.
    """
    return pixels.ambient + pixels.bounce * (1 - normal[:, 2:]) / 2


def fit_normals(pixels: Pixels, prior: Prior | None = None) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n photos"]]:
    """Fit albedo * normal of each pixel, and return it with the final weights of its photos.

    The most probable result of up to three starts is kept. The starts differ in the samples taken as lit: the bright
    ones; those not dark for the neighbours' albedo; the same, starting from the surface's normal. Without a prior there
    is only the first.
    """
    kind = 0 if prior is None else 1 + (prior.normals is not None)
    return _fitted(pixels, prior, kind, torch.zeros_like(pixels.towards[:, 0]), torch.zeros_like(pixels.value))


def misfit(pixels: Pixels, solved: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Return how badly albedo * normal explains a pixel: the mean squared error of its samples, in sigmas, bounded.

    Each sample counts as lit or in shadow, whichever is more probable. What no surface under these lights can show, as
    light from the object itself or two surfaces in one pixel, has a large one.
    """
    albedo = solved.norm(dim=1, keepdim=True)
    indirect = albedo * indirect_light(pixels, normalize(solved, dim=-1))
    direct = ((pixels.towards @ solved[..., None])[..., 0] * pixels.strength).clamp(min=0)
    sigma = pixels.variance(albedo, indirect).sqrt()
    lit, dark = bounded((pixels.value - indirect - direct) / sigma), bounded((pixels.value - indirect) / sigma)
    error = torch.where(lit < dark + CAST_SHADOW, lit, dark)
    return (error * pixels.usable).sum(1) / pixels.usable.sum(1).clamp(min=1)


def bounded(residual: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Return Geman-McClure's cost of a residual in sigmas, wider above 0."""
    squared = torch.where(residual > 0, residual / HIGHLIGHT_PATIENCE, residual) ** 2
    return TAIL * squared / (TAIL + squared)


def robust_normals(
    pixels: Pixels,
    weight: Float[Tensor, "n photos"],
    prior: Prior,
    first: Float[Tensor, "n 3"],
    rounds: int,
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n photos"]]:
    """Solve iteratively reweighted least squares with Geman-McClure weights, from given first weights.

    Args:
        weight: in [0, 1], of the first round.
        prior: its normal attracts the solution, perpendicular to itself only; its albedo does not.
        first: initial albedo * normal, world.
        rounds: of reweighting, at least 3.

    Returns:
        albedo * normal (0 without any data), world, and the final weights in [0, 1].
    """
    return _fitted(pixels, prior, rounds, first, weight)


def _fitted(
    pixels: Pixels, prior: Prior | None, kind: int, first: Float[Tensor, "n 3"], weight: Float[Tensor, "n photos"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n photos"]]:
    """Run the kernel, see normal_kernels.fit_pixels."""
    ambient = torch.as_tensor(pixels.ambient).expand_as(pixels.value)
    samples = torch.stack([pixels.value, pixels.usable.float(), pixels.strength, pixels.given_variance, ambient])
    albedo = torch.ones(len(first)) if prior is None else prior.albedo
    normals = first if prior is None or prior.normals is None else prior.normals
    given = [np.ascontiguousarray(x.numpy(), np.float32) for x in (samples, pixels.towards, pixels.bounce)]
    priors = [np.ascontiguousarray(x.numpy(), np.float32) for x in (albedo, normals)]
    solved, weights = (np.array(x.numpy(), np.float32, order="C") for x in (first, weight))
    room = PerThread(np.empty((8, weights.shape[1]), np.float32) for _ in range(thread_count()))
    stray = np.float32(pixels.stray)
    run(kernels.fit_pixels, len(solved), *given, stray, *priors, kind, room, solved, weights)
    return torch.from_numpy(solved), torch.from_numpy(weights)
