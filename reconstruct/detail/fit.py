"""Normals and albedo of single pixels under near lights, with visibility from a solved surface.

The value of a lit sample is I_k = albedo (E_k (n . l_k) + indirect_k) + specular_k, with E_k the irradiance of the
calibrated light on a surface that faces it. The solved material gives the specular part; the rest is the model of
reconstruct.shading.normal_fit. Relief too fine for the surface casts shadows of its own, which are outliers.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from reconstruct.appearance.brdf import specular
from reconstruct.appearance.lobe_fit import Samples, least_squares_albedo
from reconstruct.shading.noise import Noise
from reconstruct.shading.normal_fit import Pixels, Prior, robust_normals

ROUNDS = 5  # of reweighting, from the surface's own normal
STRAY_SHARE = 0.06  # one sigma of unmodelled light, relative to the irradiance of a facing surface
FEWEST_AGREEING, ENOUGH_AGREEING = 3.0, 6.0  # effective photos: trust in the fitted normal rises from 0 to 1 between
MOST_GLOSS = 0.25  # of a sample: with a larger specular share, the diffuse rest is unreliable
GLOSS_ROUNDS = 3  # highlights from the surface's normals first, then from the fitted ones
MOST_TURNED = 0.5  # least cosine to the surface's normal (60 degrees) of a plausible normal
ALBEDO_ROUNDS = 3
ALBEDO_OUTLIER = 0.15  # of a sample's own value: relief and shadow edges that the normal does not explain
DUST = 1e-9


@dataclass(frozen=True)
class PixelGloss:
    """The specular lobes of some pixels' materials, as reconstruct.appearance.brdf.Gloss."""

    lobes: Float[Tensor, "materials lobes 3"]
    weights: Float[Tensor, "n materials"]


def specular_part(
    samples: Samples, normals: Float[Tensor, "n 3"], pixel_gloss: PixelGloss | None
) -> Float[Tensor, "n photos 3"]:
    """Return the specular part of every sample, linear, for unit world normals that may differ from the surface's."""
    if pixel_gloss is None:
        return torch.zeros(()).expand_as(samples.value)
    coefficients = torch.einsum("nm,mlc->nlc", pixel_gloss.weights, pixel_gloss.lobes)[:, None]
    mirrored = specular(coefficients, normals[:, None], samples.towards, samples.eye[:, None])
    cosine = (samples.towards @ normals[..., None]).clamp(min=0)
    return mirrored * cosine * samples.strength


def fit_detail(
    samples: Samples, albedo: Float[Tensor, " n"], noise: Noise, pixel_gloss: PixelGloss | None
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]]:
    """Fit unit world normals, and their trust in [0, 1]: 0 where too few photos agree.

    Args:
        samples: with the solved surface's normals, near which normals of poorly seen pixels stay; weight 0 unless the
            pixel is surely lit.
        albedo: approximate, mean of RGB.
    """
    normals = samples.normals
    trust = torch.zeros(len(albedo))
    for _ in range(1 if pixel_gloss is None else GLOSS_ROUNDS):
        value, gloss = samples.value.mean(-1), specular_part(samples, normals, pixel_gloss).mean(-1)
        usable = samples.weight * (gloss <= MOST_GLOSS * value)
        pixels = _pixels(samples, value - gloss, usable > 0, noise)
        first = albedo[:, None] * samples.normals
        solved, weight = robust_normals(pixels, usable, Prior(albedo, samples.normals), first, ROUNDS)
        normals, agreeing = normalize(solved, dim=-1), weight.sum(1)
        trust = ((agreeing - FEWEST_AGREEING) / (ENOUGH_AGREEING - FEWEST_AGREEING)).clamp(0, 1)
        strange = ((normals * samples.normals).sum(-1) < MOST_TURNED) | ((normals * samples.eye).sum(-1) <= 0)
        normals = torch.where(strange[:, None], samples.normals, normals)
        trust = trust * ~strange
    return normals, trust


def _pixels(
    samples: Samples, value: Float[Tensor, "n photos"], usable: Bool[Tensor, "n photos"], noise: Noise
) -> Pixels:
    """Convert the samples to grey, with indirect light that does not depend on the pixel's fitted normal."""
    return Pixels(
        value=value,
        usable=usable,
        towards=samples.towards,
        strength=samples.strength.mean(-1),
        bounce=torch.zeros(value.shape[1]),
        ambient=samples.indirect.mean(-1),
        noise=noise,
        stray=STRAY_SHARE,
    )


def fit_albedo(
    samples: Samples, normals: Float[Tensor, "n 3"], pixel_gloss: PixelGloss | None
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]]:
    """Fit the linear albedo of pixels with known normals by reweighted least squares; also its number of inliers."""
    value = samples.value - specular_part(samples, normals, pixel_gloss)
    cosine = (samples.towards @ normals[..., None]).clamp(min=0)
    one = cosine * samples.strength + samples.indirect
    share = samples.weight * (cosine[..., 0] > 0)
    albedo = torch.zeros(len(normals), 3)
    for i in range(ALBEDO_ROUNDS):
        if i > 0:
            expected = albedo[:, None] * one
            off = ((value - expected).mean(-1) / (ALBEDO_OUTLIER * expected.mean(-1)).clamp(min=DUST)) ** 2
            share = samples.weight * (cosine[..., 0] > 0) / (1 + off) ** 2
        albedo = least_squares_albedo(value, one, share)
    return albedo, share.sum(1)
