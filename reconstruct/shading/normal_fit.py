"""The normal of one pixel: robust photometric stereo under near lights, with a prior.

The value of a lit sample is I_k = albedo (E_k (n . l_k) + indirect_k), with E_k the irradiance of light k on a surface
that faces it. This is linear in b = albedo * n and solved by weighted least squares. The weights (Geman and McClure's)
shrink for outliers such as shadows and highlights.
"""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from reconstruct.shading.noise import Noise

ROUNDS = 7  # of reweighting; the accepted residual shrinks from WIDE (or NEAR) to NARROW sigmas meanwhile
WIDE, NEAR, NARROW = 8.0, 3.0, 2.0
MODEL_SHARE = 0.03  # one sigma of the error of Lambert's law and the light model, of the predicted value
STRAY_SHARE = 0.3 * MODEL_SHARE  # one sigma of unmodelled light, of the irradiance of a surface that faces the light
INDIRECT_SHARE = 0.3  # one sigma of the light between surfaces, of its estimate
ALBEDO_SIGMA = 0.15  # of the neighbours' albedo: how alike neighbours are
NORMAL_SIGMA = 0.5  # rad: error of a surface's normal that shading has not corrected yet
SURELY_DIRECT = 0.25  # of albedo * irradiance: brighter than any light between surfaces
HIGHLIGHT_PATIENCE = 3.0  # times wider when brighter than expected: shadows are common, highlights are rare
FIRST_LIT_SHARE = 0.5  # of the third-brightest sample: darker ones are left out at first
CAST_SHADOW = 3.0  # -2 log of the odds that something else shadows a pixel that faces its light: one in five
TAIL = 16.0  # squared sigmas: largest cost of an unexplained sample


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
    ratio = torch.where(pixels.usable, pixels.value / pixels.strength, torch.zeros(()))
    third = ratio.topk(min(3, ratio.shape[1]), dim=1).values[:, -1:].clamp(min=1e-12)
    bright = (ratio > FIRST_LIT_SHARE * third) * (ratio / third).clamp(max=1)
    best, weight = robust_normals(pixels, bright * pixels.usable, prior)
    if prior is None:
        return best, weight
    cost = _improbability(pixels, best, prior)
    level = prior.albedo[:, None]
    for guess in [normalize(best, dim=-1)] + ([] if prior.normals is None else [prior.normals]):
        direct = (pixels.value - level * indirect_light(pixels, guess)) / (level * pixels.strength)
        lit = direct.clamp(0, 1) * (direct > SURELY_DIRECT) * pixels.usable
        middle = normalize((pixels.towards * lit[..., None]).sum(1), dim=-1)
        first = level * (guess if guess is prior.normals else middle)
        other, other_weight = robust_normals(pixels, lit, prior, first)
        other_cost = _improbability(pixels, other, prior)
        better = other_cost < cost
        cost = torch.where(better, other_cost, cost)
        best = torch.where(better[:, None], other, best)
        weight = torch.where(better[:, None], other_weight, weight)
    return best, weight


def _improbability(pixels: Pixels, solved: Float[Tensor, "n 3"], prior: Prior) -> Float[Tensor, " n"]:
    """Return -2 log probability of albedo * normal: each sample is lit, in shadow or neither; plus the prior."""
    lit, dark, length, normal = _sample_costs(pixels, solved)
    cost = (torch.minimum(lit, dark + CAST_SHADOW) * pixels.usable).sum(1)
    cost = cost + bounded(-((length[:, 0].clamp(min=1e-6) / prior.albedo.clamp(min=1e-6)).log() / ALBEDO_SIGMA).abs())
    if prior.normals is not None:
        known = (prior.normals != 0).any(-1)
        cost = cost + known * (2 - 2 * (normal * prior.normals).sum(-1)) / NORMAL_SIGMA**2
    return cost


def misfit(pixels: Pixels, solved: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Return how badly albedo * normal explains a pixel: the mean squared error of its samples, in sigmas, bounded.

    Each sample counts as lit or in shadow, whichever is more probable. What no surface under these lights can show, as
    light from the object itself or two surfaces in one pixel, has a large one.
    """
    lit, dark, _, _ = _sample_costs(pixels, solved)
    error = torch.where(lit < dark + CAST_SHADOW, lit, dark)
    return (error * pixels.usable).sum(1) / pixels.usable.sum(1).clamp(min=1)


def _sample_costs(
    pixels: Pixels, solved: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "n photos"], Float[Tensor, "n photos"], Float[Tensor, "n 1"], Float[Tensor, "n 3"]]:
    """Return the cost of each sample as lit and as one in shadow; and the albedo and the normal of the result."""
    length, normal, indirect, variance = _unlit(pixels, solved)
    sigma = variance.sqrt()
    direct = (_dot(pixels.towards, solved) * pixels.strength).clamp(min=0)
    lit = bounded((pixels.value - indirect - direct) / sigma)
    return lit, bounded((pixels.value - indirect) / sigma), length, normal


def bounded(residual: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Return Geman-McClure's cost of a residual in sigmas, wider above 0."""
    squared = torch.where(residual > 0, residual / HIGHLIGHT_PATIENCE, residual) ** 2
    return TAIL * squared / (TAIL + squared)


def robust_normals(
    pixels: Pixels,
    weight: Float[Tensor, "n photos"],
    prior: Prior | None,
    first: Float[Tensor, "n 3"] | None = None,
    to_albedo: bool = True,
    rounds: int = ROUNDS,
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n photos"]]:
    """Solve iteratively reweighted least squares with Geman-McClure weights, from given first weights.

    Args:
        weight: in [0, 1], of the first round.
        prior: its normal attracts the solution, perpendicular to itself only.
        first: initial albedo * normal, world; the accepted residual then begins at NEAR instead of WIDE sigmas.
        to_albedo: the prior's albedo attracts, too, if there is a `first`.
        rounds: of reweighting.

    Returns:
        albedo * normal (0 without any data), world, and the final weights in [0, 1].
    """
    rows = [pixels.towards[..., axis] * pixels.strength for axis in range(3)]
    products = [rows[i] * rows[j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))]
    solved = torch.zeros_like(pixels.towards[:, 0]) if first is None else first
    length, normal, indirect, variance = _unlit(pixels, solved)
    widest = WIDE if first is None else NEAR
    for i in range(rounds):
        w = weight / variance
        sums = [(w * product).sum(1) for product in products]
        matrix = torch.stack([sums[k] for k in (0, 1, 2, 1, 3, 4, 2, 4, 5)], -1).reshape(-1, 3, 3)
        w *= pixels.value - indirect
        right = torch.stack([(w * row).sum(1) for row in rows], -1)
        if prior is not None:
            pull, target = _pull(prior, normal, length, to_albedo and first is not None)
            matrix, right = matrix + pull, right + target
        ridge = 1e-4 * matrix.diagonal(dim1=1, dim2=2).sum(-1).clamp(min=1e-6)
        solved = torch.linalg.solve(matrix + ridge[:, None, None] * torch.eye(3), right)
        direct = rows[0] * solved[:, :1] + rows[1] * solved[:, 1:2] + rows[2] * solved[:, 2:]
        length, normal, indirect, variance = _unlit(pixels, solved)
        excess = pixels.value - indirect - direct
        width = widest * (NARROW / widest) ** (i / (rounds - 1))
        wide = torch.where(excess > 0, (HIGHLIGHT_PATIENCE * width) ** 2, width**2)
        share = 1 / (1 + excess**2 / (wide * variance))
        weight = share**2 * pixels.usable * (direct > 0)
    return solved, weight


def _pull(
    prior: Prior, normal: Float[Tensor, "n 3"], length: Float[Tensor, "n 1"], to_albedo: bool
) -> tuple[Float[Tensor, "n 3 3"], Float[Tensor, "n 3"]]:
    """Return the prior's part of the normal equations for albedo * normal."""
    matrix, right = torch.zeros(len(normal), 3, 3), torch.zeros_like(normal)
    if to_albedo:
        stiffness = 1 / (ALBEDO_SIGMA * prior.albedo.clamp(min=1e-6)) ** 2
        matrix = stiffness[:, None, None] * normal[:, :, None] * normal[:, None, :]
        right = (stiffness * prior.albedo)[:, None] * normal
    if prior.normals is not None:
        size = prior.albedo if to_albedo else length[:, 0]
        known = (prior.normals != 0).any(-1)
        stiffness = known / (NORMAL_SIGMA * size.clamp(min=1e-6)) ** 2
        across = torch.eye(3) - prior.normals[:, :, None] * prior.normals[:, None, :]
        matrix = matrix + stiffness[:, None, None] * across
    return matrix, right


def _dot(towards: Float[Tensor, "n photos 3"], solved: Float[Tensor, "n 3"]) -> Float[Tensor, "n photos"]:
    x, y, z = towards.unbind(-1)  # by planes: sums over a last axis of three take several times as long
    return x * solved[:, :1] + y * solved[:, 1:2] + z * solved[:, 2:]


def _unlit(
    pixels: Pixels, solved: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "n 1"], Float[Tensor, "n 3"], Float[Tensor, "n photos"], Float[Tensor, "n photos"]]:
    """Return albedo and normal of a result, its value in shadow, and the variance of a lit sample.

    Args:
        solved: albedo * normal, world.
    """
    length = torch.linalg.vector_norm(solved, dim=-1, keepdim=True)
    normal = solved / length.clamp(min=1e-6)
    indirect = length * indirect_light(pixels, normal)
    return length, normal, indirect, pixels.variance(length, indirect)
