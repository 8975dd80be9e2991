"""The BRDF: albedo and nine spherical-Gaussian lobes x RGB; materials that replace recovered ones."""

import math
from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Bool, Float
from torch import Tensor

LOBES = 9  # [ShadowNeuS, supplement]
FIRST_EXPONENT = 2  # sharpness e^2 ... e^10, as in the authors' code
SHARPNESS = tuple(math.exp(FIRST_EXPONENT + k) for k in range(LOBES))
DIELECTRIC = 0.04  # F0 of plastic, wood, stone or skin; that of metals is much higher
GRAZING = 0.05  # cosine (87 degrees) below which a surface's slope is not known well enough to divide by it
QUADRATURE = (48, 96)  # half vectors by distance from the normal and around it: reflectance to 0.1 %
SAMPLING = 0.4  # variance of the sharpest lobe in squared sample spacings: the sampled sum is then constant to 0.1 %
ANGLES = 64  # of view, for which reflectance is tabulated


@dataclass(frozen=True)
class Gloss:
    """The specular part of surfaces, of a picture's or of some pixels': sum over m of weights[m] * lobes[m]."""

    lobes: Float[Tensor, "materials lobes 3"]  # coefficients, non-negative; relative to Light.power, as albedo is
    weights: Float[Tensor, "*pixels materials"]  # non-negative; 0 on the ground

    def coefficients(self) -> Float[Tensor, "*pixels lobes 3"]:
        """Return the lobe coefficients of each pixel, 27 numbers."""
        return torch.einsum("...m,mlc->...lc", self.weights, self.lobes)


@dataclass(frozen=True)
class MetalRough:
    """A material in the terms of glTF, whose vertices have colours of their own and share the rest."""

    base: Float[Tensor, "n 3"]  # linear, in [0, 1]
    metallic: float
    roughness: float  # perceptual: the square root of GGX alpha


def lobe_values(
    normals: Float[Tensor, "*#batch 3"],
    halfway: Float[Tensor, "*#batch 3"],
    sharpness: Float[Tensor, "*#batch lobes"] | None = None,
) -> Float[Tensor, "*#batch lobes"]:
    """Return the basis D_k = exp(lambda_k (h . n - 1)) [ShadowNeuS eq:render_rgb], default lambda_k = e^2 ... e^10.

    Args:
        normals, halfway: unit.
    """
    if sharpness is None:
        sharpness = torch.tensor(SHARPNESS, device=normals.device, dtype=normals.dtype)
    return (((normals * halfway).sum(-1, keepdim=True) - 1) * sharpness).exp()


def shape_factors(
    normals: Float[Tensor, "*#batch 3"],
    halfway: Float[Tensor, "*#batch 3"],
    towards: Float[Tensor, "*#batch 3"],
    eye: Float[Tensor, "*#batch 3"],
) -> tuple[Float[Tensor, "*#batch"], Float[Tensor, "*#batch"]]:
    """Return the correction factors of the paper's lobes for grazing light [Ashikhmin and Shirley 2000].

    Args:
        normals, halfway, towards, eye: unit: n, h, l (to the light) and v (to the camera).

    Returns:
        1 / ((l . h) max(n . l, n . v)), which makes the reflectance of a lobe nearly the same from all sides, and
        Schlick's (1 - l . h)^5.
    """
    along = (towards * halfway).sum(-1).clamp(GRAZING, 1)
    steepest = torch.maximum((normals * towards).sum(-1), (normals * eye).sum(-1)).clamp(min=GRAZING)
    return 1 / (along * steepest), (1 - along) ** 5


def lobes_and_factors(
    normals: Float[Tensor, "*#batch 3"],
    towards: Float[Tensor, "*#batch 3"],
    eye: Float[Tensor, "*#batch 3"],
    blur: float = 0.0,
    used: Bool[Tensor, " every"] | None = None,
) -> tuple[Float[Tensor, "*#batch lobes"], Float[Tensor, "*#batch"], Float[Tensor, "*#batch"]]:
    """Return D_k and both results of `shape_factors`: what of `specular` does not depend on the coefficients.

    Args:
        normals, towards, eye, blur: as of `specular`.
        used: which of the nine lobes are wanted; None: all.
    """
    halfway = torch.nn.functional.normalize(towards + eye, dim=-1)
    sharpness = torch.tensor(SHARPNESS, device=normals.device, dtype=normals.dtype)
    sharpness = sharpness if used is None else sharpness[used]
    if blur > 0:
        return _widened(normals, halfway, towards, blur, sharpness), *shape_factors(normals, halfway, towards, eye)
    values = lobe_values(normals, halfway, sharpness)
    return values, *shape_factors(normals, halfway, towards, eye)


def fresnel(
    factor: Float[Tensor, "*#batch"], grazing: Float[Tensor, "*#batch"], coefficients: Float[Tensor, "*#batch lobes 3"]
) -> Float[Tensor, "*#batch 3"]:
    """Return the factor per channel of `specular`; the Fresnel term's F0 is that of the coefficients.

    Args:
        factor, grazing: see shape_factors.
    """
    rest = 1 / facing_reflectance(coefficients).clamp(DIELECTRIC, 1) - 1
    return factor[..., None] * (1 + rest * grazing[..., None])


def specular(
    coefficients: Float[Tensor, "*#batch lobes 3"],
    normals: Float[Tensor, "*#batch 3"],
    towards: Float[Tensor, "*#batch 3"],
    eye: Float[Tensor, "*#batch 3"],
    blur: float = 0.0,
) -> Float[Tensor, "*#batch 3"]:
    """Return the specular part of (albedo + specular) * irradiance [ShadowNeuS eq:render_rgb], in units of albedo.

    sum_k c_k D_k(h . n) * (1 + (1 / F0 - 1)(1 - l . h)^5) / ((l . h) max(n . l, n . v)): the paper's lobes with
    a Fresnel term and the shape of Ashikhmin and Shirley, which fit rendered plastic better at grazing light.
    F0 is the reflectance of the coefficients at normal incidence, but at least DIELECTRIC.

    Args:
        normals: unit.
        towards, eye: unit directions from the surface to the light and to the camera.
        blur: angle between the lights of an environment map, rad; sharper lobes are widened, their reflectance kept.
    """
    used = coefficients.any(-1).reshape(-1, LOBES).any(0)
    values, factor, grazing = lobes_and_factors(normals, towards, eye, blur, used)
    return (values[..., None, :] @ coefficients[..., used, :])[..., 0, :] * fresnel(factor, grazing, coefficients)


def _widened(normals: Tensor, halfway: Tensor, towards: Tensor, blur: float, sharpness: Tensor) -> Tensor:
    """Limit the lobes' sharpness to lights `blur` rad apart; half vectors are closer together by 1 / (2 l . h)."""
    turn = blur / (2 * (towards * halfway).sum(-1, keepdim=True).clamp(GRAZING, 1))
    wide = torch.minimum(sharpness, 1 / (SAMPLING * turn**2))
    return lobe_values(normals, halfway, wide) * (wide / sharpness)


def facing_reflectances() -> Float[Tensor, " lobes"]:
    """Return each lobe's reflectance at normal incidence with coefficient 1, about 8 / lambda."""
    return _table(torch.float32)[0][-1]


def facing_reflectance(coefficients: Float[Tensor, "*batch lobes 3"]) -> Float[Tensor, "*batch 3"]:
    """Return F0, the lobes' reflectance at normal incidence: sum_k c_k * 8 / lambda_k to first order."""
    return (coefficients * facing_reflectances().to(coefficients)[:, None]).sum(-2)


def reflectance(
    coefficients: Float[Tensor, "*batch lobes 3"], cosine: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch 3"]:
    """Return the lobes' directional reflectance: 1 / pi * integral of `specular` * n.l.

    Args:
        cosine: between the incoming (or outgoing) direction and the normal.
    """
    plain, grazing = _table(coefficients.dtype)
    place = cosine.clamp(0, 1) * (ANGLES - 1)
    low = place.floor().clamp(max=ANGLES - 2).long()
    share = (place - low)[..., None]
    at = [((1 - share) * table[low] + share * table[low + 1])[..., None] for table in (plain, grazing)]
    rest = 1 / facing_reflectance(coefficients).clamp(DIELECTRIC, 1) - 1
    return (coefficients * at[0]).sum(-2) + rest * (coefficients * at[1]).sum(-2)


@cache
def _table(dtype: torch.dtype) -> tuple[Float[Tensor, "angles lobes"], Float[Tensor, "angles lobes"]]:
    """Tabulate each lobe's reflectance with coefficient 1 at evenly spaced cosines: without Fresnel; (1 - l.h)^5 alone.

    Integrated over half vectors distributed as the lobe (dl = 4 (v . h) dh), evenly stratified.
    """
    rings, around = QUADRATURE
    u = ((torch.arange(rings, dtype=torch.float64) + 0.5) / rings)[:, None]
    phi = 2 * math.pi * (torch.arange(around, dtype=torch.float64) + 0.5) / around
    cosine = torch.linspace(0, 1, ANGLES, dtype=torch.float64)
    eye = torch.stack([(1 - cosine**2).sqrt(), torch.zeros(ANGLES), cosine], -1)[:, None, None]
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    plain, grazing = [], []
    for sharpness in SHARPNESS:
        floor = math.exp(-sharpness)  # half vectors within 90 degrees of the normal
        z = 1 + (u + (1 - u) * floor).log() / sharpness
        side = (1 - z**2).clamp(min=0).sqrt()
        halfway = torch.stack([side * phi.cos(), side * phi.sin(), z.expand(rings, around)], -1)
        along = (eye * halfway).sum(-1, keepdim=True)
        towards = 2 * along * halfway - eye
        valid = (along[..., 0] > 0) & (towards[..., 2] > 0)
        factor, schlick = shape_factors(up, halfway, towards, eye)
        weight = 4 * along[..., 0] * towards[..., 2] * factor * valid
        total = 2 * (1 - floor) / sharpness  # integral of the lobe over half vectors, over pi
        plain.append(total * weight.mean((1, 2)))
        grazing.append(total * (weight * schlick).mean((1, 2)))
    return torch.stack(plain, 1).to(dtype), torch.stack(grazing, 1).to(dtype)


# --- limits and conversions ------------------------------------------------------------------------------------------


def conserving(
    albedo: Float[Tensor, "*batch 3"], coefficients: Float[Tensor, "*batch lobes 3"], cosine: Float[Tensor, "*batch"]
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch lobes 3"]]:
    """Limit coefficients, then linear albedo, so that both together reflect at most all light towards a direction.

    Args:
        cosine: between normal and direction.
    """
    mirrored = reflectance(coefficients, cosine)
    scale = 1 / mirrored.clamp(min=1)
    return torch.minimum(albedo, 1 - mirrored * scale).clamp(min=0), coefficients * scale[..., None, :]


def metal_rough(albedo: Float[Tensor, "n 3"], coefficients: Float[Tensor, "n lobes 3"]) -> MetalRough:
    """Convert albedo and lobes to the most similar glTF metallic-roughness material, which conserves energy.

    Roughness: from the lobes' mean log sharpness lambda, weighted by their reflectance. Near its centre a lobe is a GGX
    distribution of alpha = sqrt(2 / lambda), and roughness = sqrt(alpha). Metallic m: glTF's conversion of
    specular-glossiness (KHR_materials_pbrSpecularGlossiness), the root of 0.04 m^2 + (d + f - 0.08) m + 0.04 - f = 0
    with the perceived brightness f of F0 (`facing_reflectance`) and d of albedo / 0.96; 0 for f below 0.04; mean over
    the points. Base colour per point: from the albedo, and as m^2 grows from F0. Without lobes: rough, not metallic.
    """
    albedo, coefficients = conserving(albedo, coefficients, torch.ones(len(albedo)))
    mirrored, diffuse = facing_reflectance(coefficients), albedo / (1 - DIELECTRIC)
    if not coefficients.any():
        return MetalRough(albedo.clamp(0, 1), 0.0, 1.0)
    together = coefficients.mean(0, keepdim=True)
    shine = _brightness(mirrored)
    b, c = _brightness(diffuse) + shine - 2 * DIELECTRIC, (DIELECTRIC - shine).clamp(max=0)
    each = ((b**2 - 4 * DIELECTRIC * c).sqrt() - b) / (2 * DIELECTRIC)
    metallic = float(torch.where(c < 0, each, 0.0).clamp(0, 1).mean())
    from_diffuse = (diffuse / max(1 - metallic, 1e-3)).clamp(0, 1)
    from_mirror = ((mirrored - DIELECTRIC * (1 - metallic)) / max(metallic, 1e-3)).clamp(0, 1)
    base = torch.lerp(from_diffuse, from_mirror, metallic**2)
    return MetalRough(base, metallic, float(roughness(together)[0]))


def roughness(coefficients: Float[Tensor, "*batch lobes 3"]) -> Float[Tensor, "*batch"]:
    """Return the perceptual roughness from the lobes' mean log sharpness, see `metal_rough`; 1 without lobes."""
    share = (coefficients * facing_reflectances().to(coefficients)[:, None]).sum(-1)
    total = share.sum(-1)
    mean_log = (share * torch.tensor(SHARPNESS).log().to(share)).sum(-1) / total.clamp(
        min=torch.finfo(share.dtype).tiny
    )
    return torch.where(total > 0, ((2 / mean_log.exp()) ** 0.25).clamp(max=1), 1.0)


def _brightness(colour: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Return the perceived brightness as glTF's conversion defines it."""
    return (colour**2 @ torch.tensor([0.299, 0.587, 0.114])).sqrt()


# --- materials to choose ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Material:
    """A uniform material to put in the place of a recovered one."""

    albedo: tuple[float, float, float] | None = None  # linear; None: the recovered colour stays
    mirrored: tuple[float, float, float] = (0.0, 0.0, 0.0)  # F0: reflected at normal incidence, at most 1
    roughness: float = 0.5  # perceptual, as in glTF; what nine lobes can show lies between 0.1 and 0.72

    def __post_init__(self):
        values = (*(self.albedo or ()), *self.mirrored, self.roughness)
        if any(not 0 <= value <= 1 for value in values):
            raise ValueError(f"albedo, mirrored and roughness lie in [0, 1]; {values} was given")

    def coefficients(self) -> Float[Tensor, "lobes 3"]:
        """Return coefficients of the two lobes around lambda = 2 / roughness^4, which together reflect `mirrored`."""
        place = math.log(2 / max(self.roughness, 1e-3) ** 4) - FIRST_EXPONENT
        place = min(max(place, 0.0), LOBES - 1.0)
        share = torch.tensor([max(0.0, 1 - abs(place - k)) for k in range(LOBES)])
        return (share / facing_reflectances())[:, None] * torch.tensor(self.mirrored)


# Mirrored light: gold as in the example of glTF 2.0's text (a metal of base colour 1.000, 0.766, 0.336); emerald and
# plastic by Fresnel, ((n - 1) / (n + 1))^2, n = 1.58 of beryl and 1.5 (glTF's dielectric). Plaster: the albedo of a
# white wall. Emerald's green, and how rough worn gold, a polished stone and moulded plastic are, were chosen by eye.
MATERIALS = {
    "gold": Material((0.0, 0.0, 0.0), (1.0, 0.766, 0.336), 0.35),
    "emerald": Material((0.02, 0.25, 0.1), (0.05, 0.05, 0.05), 0.2),
    "plastic": Material(None, (DIELECTRIC, DIELECTRIC, DIELECTRIC), 0.35),
    "plaster": Material((0.8, 0.8, 0.78)),
}
