"""Normals and albedo of single pixels under near lights, where a solved surface tells which lights reach them.

The value of a lit sample is I_k = albedo (E_k (n . l_k) + indirect_k) + specular_k, with E_k the irradiance of the
calibrated lamp on a surface that faces it. For b = albedo * n this is linear: weighted least squares whose weights
(Geman and McClure's) shrink on what does not fit, as relief too small for the surface casts shadows of its own.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from reconstruct.appearance.brdf import specular
from reconstruct.appearance.lobe_fit import Samples
from reconstruct.labels.noise import Noise
from reconstruct.labels.normal_fit import HIGHLIGHT_PATIENCE, INDIRECT_SHARE, MODEL_SHARE, NARROW, NEAR, NORMAL_SIGMA

ROUNDS = 5  # of reweighting, from the surface's own normal
STRAY_SHARE = 0.06  # one sigma of light that the model misses, of what a facing surface gets
FEWEST_AGREEING, ENOUGH_AGREEING = (
    3.0,
    6.0,
)  # effective photos: below, the pixel keeps its surface's normal; above, none
MOST_GLOSS = 0.25  # of a sample: where more is highlight, what is left says little
GLOSS_ROUNDS = 3  # highlights by the surface's normal first, then by those found
MOST_TURNED = 0.5  # cosine to the surface's normal (60 degrees) below which a normal is not of the relief on it
ALBEDO_ROUNDS = 3
ALBEDO_OUTLIER = 0.15  # of a sample's own value: relief and shadow edges that the normal does not explain
DUST = 1e-9


@dataclass(frozen=True)
class Shine:
    """The glossy part of some pixels."""

    lobes: Float[Tensor, "materials lobes 3"]
    weights: Float[Tensor, "n materials"]


def highlights_of(samples: Samples, normals: Float[Tensor, "n 3"], shine: Shine | None) -> Float[Tensor, "n photos 3"]:
    """The specular part of every sample, for other normals than the surface's."""
    if shine is None:
        return torch.zeros(()).expand_as(samples.value)
    coefficients = torch.einsum("nm,mlc->nlc", shine.weights, shine.lobes)[:, None]
    mirrored = specular(coefficients, normals[:, None], samples.towards, samples.eye[:, None])
    cosine = (samples.towards @ normals[..., None]).clamp(min=0)
    return mirrored * cosine * samples.strength


def fit_detail(
    samples: Samples, albedo: Float[Tensor, " n"], noise: Noise, shine: Shine | None
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]]:
    """Unit normals, and how far they are to be trusted: 0 where too few photos agree on one.

    Args:
        samples: normals are the solved surface's, which those of badly seen pixels stay near; weight 0 where light does
            not surely arrive.
        albedo: about, mean of RGB.
    """
    normals = samples.normals
    trust = torch.zeros(len(albedo))
    for _ in range(1 if shine is None else GLOSS_ROUNDS):
        value, gloss = samples.value.mean(-1), highlights_of(samples, normals, shine).mean(-1)
        usable = samples.weight * (gloss <= MOST_GLOSS * value)
        value = value - gloss
        solved, agreeing = _reweighted(samples, value, usable, albedo[:, None] * samples.normals, noise)
        normals = normalize(solved, dim=-1)
        trust = ((agreeing - FEWEST_AGREEING) / (ENOUGH_AGREEING - FEWEST_AGREEING)).clamp(0, 1)
        strange = ((normals * samples.normals).sum(-1) < MOST_TURNED) | ((normals * samples.eye).sum(-1) <= 0)
        normals = torch.where(strange[:, None], samples.normals, normals)
        trust = trust * ~strange
    return normals, trust


def _reweighted(
    samples: Samples,
    value: Float[Tensor, "n photos"],
    usable: Float[Tensor, "n photos"],
    first: Float[Tensor, "n 3"],
    noise: Noise,
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]]:
    """albedo * normal, and how many photos it explains."""
    strength, indirect = samples.strength.mean(-1), samples.indirect.mean(-1)
    towards = [samples.towards[..., axis].contiguous() for axis in range(3)]
    known = noise.sigma(value.clamp(min=0)) ** 2 + (MODEL_SHARE * value) ** 2
    solved, share = first, usable
    for i in range(ROUNDS):
        length = torch.linalg.vector_norm(solved, dim=-1, keepdim=True).clamp(min=DUST)
        below = length * indirect
        stray = (STRAY_SHARE * length * strength) ** 2 + (INDIRECT_SHARE * below) ** 2
        if i > 0:
            direct = strength * sum(towards[axis] * solved[:, axis, None] for axis in range(3))
            residual = (value - below - direct) / (known + stray).sqrt()
            width = NEAR * (NARROW / NEAR) ** (i / (ROUNDS - 1))
            wider = torch.where(residual > 0, HIGHLIGHT_PATIENCE * width, width)
            share = usable * (direct > 0) / (1 + (residual / wider) ** 2) ** 2
        weight = share / (known + stray)
        solved = _least_squares(samples.normals, towards, strength, weight, value - below, length)
    return solved, share.sum(1)


def _least_squares(
    normals: Float[Tensor, "n 3"],
    towards: list[Tensor],
    strength: Float[Tensor, "n photos"],
    weight: Float[Tensor, "n photos"],
    value: Float[Tensor, "n photos"],
    length: Float[Tensor, "n 1"],
) -> Float[Tensor, "n 3"]:
    """b of least squares, held towards the surface's normal by NORMAL_SIGMA, and along it where no light arrives."""
    once = weight * strength
    twice, seen = once * strength, once * value
    matrix, right = torch.empty(len(normals), 3, 3), torch.empty(len(normals), 3)
    for a in range(3):
        scaled = twice * towards[a]
        right[:, a] = (seen * towards[a]).sum(1)
        for b in range(a, 3):
            matrix[:, a, b] = matrix[:, b, a] = (scaled * towards[b]).sum(1)
    stiffness = 1 / (NORMAL_SIGMA * length) ** 2
    along = normals[:, :, None] * normals[:, None, :]
    matrix += stiffness[..., None] * (torch.eye(3) - along)
    ridge = 1e-4 * matrix.diagonal(dim1=1, dim2=2).sum(-1)[:, None]
    matrix += ridge[..., None] * along
    right += ridge * length * normals
    return torch.linalg.solve(matrix, right)


def fit_albedo(
    samples: Samples, normals: Float[Tensor, "n 3"], shine: Shine | None
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]]:
    """Linear albedo of pixels with known normals, by reweighted least squares, and how many photos it explains."""
    value = samples.value - highlights_of(samples, normals, shine)
    cosine = (samples.towards @ normals[..., None]).clamp(min=0)
    one = cosine * samples.strength + samples.indirect
    share = samples.weight * (cosine[..., 0] > 0)
    albedo = torch.zeros(len(normals), 3)
    for i in range(ALBEDO_ROUNDS):
        if i > 0:
            expected = albedo[:, None] * one
            off = ((value - expected).mean(-1) / (ALBEDO_OUTLIER * expected.mean(-1)).clamp(min=DUST)) ** 2
            share = samples.weight * (cosine[..., 0] > 0) / (1 + off) ** 2
        weighted = share[..., None] * one
        albedo = (weighted * value).sum(1).clamp(min=0) / (weighted * one).sum(1).clamp(min=DUST)
    return albedo, share.sum(1)
