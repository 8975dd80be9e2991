"""Normals, specular lobes and the power of each photo, fitted in turn where no ground tells how bright a light was.

One material and one power per photo are shared by all pixels; a normal and an albedo belong to one pixel. Highlights
as wide as a figure's forehead tilt Lambertian normals, and lobes read with tilted normals vanish: neither can be fitted
first. So each round fits the lobes with the normals so far (reconstruct.appearance.lobe_fit), then normals and albedos
with these lobes, by damped Gauss-Newton steps through the highlights' own slope, then the powers [semi-calibrated
photometric stereo: Cho, Matsushita, Tai and Kweon, ECCV 2016]. The photos decide what of it is there: matt objects keep
no lobes, photos of the stated power keep it.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from reconstruct.appearance import joint_kernels
from reconstruct.appearance.brdf import DIELECTRIC, LOBES, SHARPNESS, facing_reflectance, specular
from reconstruct.appearance.joint_kernels import DUST
from reconstruct.appearance.lobe_fit import LEAST_GAIN, Samples, highlights, least_squares_albedo, shared_lobes
from reconstruct.sdf.rays import run

ROUNDS, MATT_ROUNDS = 10, 3  # of fitting in turn; without lobes nothing slow is left to settle
STEPS, LAST_STEPS = 4, 12  # Gauss-Newton steps in a round, and of pixels that see finished lobes
FEWEST_PHOTOS = 8  # fewer do not tell a power from the normals
POWER_PRIOR = 0.02  # pull of the stated powers, in every round
SURELY_FACING = 0.25  # cosine to the light of samples that tell its power
MOST_OFF = 5.0  # ratio of seen to expected that a power is read from, either way


@dataclass(frozen=True)
class SharedMaterial:
    """What all pixels of an object share: its lobes, and the log of each photo's power over the stated one."""

    lobes: Float[Tensor, "lobes 3"]  # of appearance.brdf.specular; zeros of a matt object
    log_gains: Float[Tensor, " photos"]  # median 0


def fit_material(samples: Samples, noise: Float[Tensor, "n photos"]) -> SharedMaterial | None:
    """Fit lobes and powers with the normals of some pixels; None of fewer than FEWEST_PHOTOS photos.

    Lobes are kept where they lower the robust cost of all samples by LEAST_GAIN, see `fit_normals`; a Lambertian fit,
    with normals and powers of its own, is given the same chance.

    Args:
        samples: with the Lambertian normals to begin from; weight 0 where the sample is not well exposed.
        noise: one sigma of each sample's mean of RGB, linear.
    """
    photos = samples.value.shape[1]
    if photos < FEWEST_PHOTOS or not len(samples.value):
        return None
    matt, matt_cost, started = _fit_in_turn(samples, noise, torch.zeros(photos), MATT_ROUNDS, is_glossy=False)
    glossy, cost, _ = _fit_in_turn(started, noise, matt.log_gains, ROUNDS, is_glossy=True)
    return glossy if cost < (1 - LEAST_GAIN) * matt_cost else matt


def _fit_in_turn(
    samples: Samples, noise: Float[Tensor, "n photos"], gains: Float[Tensor, " photos"], rounds: int, is_glossy: bool
) -> tuple[SharedMaterial, float, Samples]:
    """Return the material, the mean cost of a pixel, and the samples with their new normals."""
    lobes, cost = torch.zeros(LOBES, 3), 0.0
    for _ in range(rounds):
        lit = with_gains(samples, gains)
        facing = (lit.towards * lit.normals[:, None]).sum(-1)
        if is_glossy:
            lobes = shared_lobes(replace(lit, weight=lit.weight * (facing > SURELY_FACING)))
        normals, albedo, every = fit_normals(lit, lobes, noise, STEPS)
        cost = float(every.mean())
        samples, lit = replace(samples, normals=normals), replace(lit, normals=normals)
        gains = (1 - POWER_PRIOR) * (gains + _log_errors(lit, albedo, lobes))
        gains = gains - gains.median()
    return SharedMaterial(lobes, gains), cost, samples


def with_gains(samples: Samples, log_gains: Float[Tensor, " photos"]) -> Samples:
    """Return samples under lights of these powers, relative to the stated ones."""
    return replace(samples, strength=samples.strength * log_gains.exp()[:, None])


def _log_errors(
    samples: Samples, albedo: Float[Tensor, " n"], lobes: Float[Tensor, "lobes 3"]
) -> Float[Tensor, " photos"]:
    """Return the median log of each photo's samples over their prediction; 0 without lit ones."""
    expected = _predicted(samples, samples.normals, albedo, lobes)
    ratio = samples.value.mean(-1) / expected.clamp(min=DUST**2)
    facing = (samples.towards * samples.normals[:, None]).sum(-1) > SURELY_FACING
    told = facing & (samples.weight > 0) & (ratio < MOST_OFF) & (ratio > 1 / MOST_OFF)
    return torch.where(told, ratio.clamp(min=DUST).log(), torch.nan).nanmedian(0).values.nan_to_num(0.0)


def fit_normals(
    samples: Samples, lobes: Float[Tensor, "lobes 3"], noise: Float[Tensor, "n photos"], steps: int = LAST_STEPS
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"], Float[Tensor, " n"]]:
    """Fit unit world normals and grey albedos of pixels whose lobes are known; also return each pixel's cost.

    Minimises sum_k rho((I_k - albedo (E_k n.l_k + indirect_k) - specular(n) E_k n.l_k) / sigma_k) by
    Levenberg-Marquardt steps over two angles and the log of the albedo, with rho of Geman and McClure, until each pixel
    rests or `steps` are done.

    Args:
        samples: with the normals to begin from.
        noise: as of `fit_material`.
    """
    value = samples.value.mean(-1)
    diffuse = samples.value - highlights(samples, lobes)
    facing = (samples.towards * samples.normals[:, None]).sum(-1, keepdim=True).clamp(min=0)
    lit = facing * samples.strength + samples.indirect
    albedo = least_squares_albedo(diffuse, lit, samples.weight).mean(-1).clamp(min=DUST)
    usable = (samples.weight > 0).to(value.dtype)
    seen = torch.stack([value, noise, usable], -1)
    light = torch.stack([samples.strength.mean(-1), samples.indirect.mean(-1)], -1)
    given = [_array(x) for x in (seen, light, samples.towards, samples.eye)]
    found = [_array(x).copy() for x in (samples.normals, albedo)]
    costs = np.empty_like(found[1])
    run(joint_kernels.fit_pixels, len(costs), *given, _grey_lobes(lobes), steps, *found, costs)
    normals, albedo, cost = (torch.from_numpy(x) for x in (*found, costs))
    return normals, albedo, cost


def _array(values: Tensor) -> np.ndarray:
    return np.ascontiguousarray(values.numpy(), np.float32)


def _grey_lobes(lobes: Float[Tensor, "lobes 3"]) -> Float[np.ndarray, "some 3"]:
    """Return each used lobe's sharpness, coefficient, and Fresnel's part of it at grazing light; means of RGB."""
    rest = 1 / facing_reflectance(lobes).clamp(DIELECTRIC, 1) - 1
    every = torch.stack([torch.tensor(SHARPNESS), lobes.mean(-1), (lobes * rest).mean(-1)], -1)
    return every[lobes.any(-1)].double().numpy()


def _predicted(
    samples: Samples, normals: Float[Tensor, "n 3"], albedo: Float[Tensor, " n"], lobes: Float[Tensor, "lobes 3"]
) -> Float[Tensor, "n photos"]:
    """Return the mean of RGB that unshadowed samples would have with these normals."""
    cosine = (samples.towards * normals[:, None]).sum(-1).clamp(min=0)
    diffuse = albedo[:, None] * (cosine * samples.strength.mean(-1) + samples.indirect.mean(-1))
    if not lobes.any():
        return diffuse
    mirrored = specular(lobes, normals[:, None], samples.towards, samples.eye[:, None]).mean(-1)
    return diffuse + mirrored * cosine * samples.strength.mean(-1)
