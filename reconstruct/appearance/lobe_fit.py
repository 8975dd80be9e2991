"""Albedo and specular lobes of an object's pixels, by non-negative least squares over all photos."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import nnls
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn.functional import normalize

from capture.checks.robust import spread
from reconstruct.appearance.brdf import LOBES, facing_reflectances, fresnel, lobes_and_factors, specular
from reconstruct.scene import Scene, irradiance

CHUNK = 4096  # pixels at once: 40 photos of them, with nine lobes each, take 6 MB
ENOUGH_PIXELS = 3000  # for nine numbers per channel; callers thin out more, evenly
FEWEST_SAMPLES = 500  # lit ones; fewer do not determine lobes
MIN_COSINE = 0.1  # to the light: nearer to grazing, a sample depends more on the normal than on the material
ROUNDS = 4  # of reweighting; Fresnel's F0 is that of the round before
OUTLIER = 3.0  # sigmas of the residual at which a sample's weight is a quarter
DOUBT = 1e-3  # penalty per unit of reflectance, in residual variances per sample: lobes without evidence stay at zero
LEAST_GAIN = 0.1  # share of the mean square residual that lobes must explain; wrong normals alone give less
SCALE_SIGMA = 0.2  # prior sigma of a point's gloss scale about that of its neighbourhood
LOOSE_SIGMA = 1.0  # and about that of the object
NEIGHBOURS = 32  # samples of ENOUGH_PIXELS: about one per cent of the surface
RIDGE = 1e-9  # of the trace: keeps a lobe that no sample sees solvable


# Irradiance by light between surfaces in each photo, photos x n x 3, at points with normals, both n x 3, world.
Indirect = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Samples:
    """Surface points in every photo: observed values and the geometry of light and view. World frame."""

    value: Float[Tensor, "n photos 3"]  # linear
    weight: Float[Tensor, "n photos"]  # 1: surely lit and well exposed, 0: ignored
    strength: Float[Tensor, "n photos 3"]  # irradiance on a surface that faces the light
    indirect: Float[Tensor, "n photos 3"]  # irradiance from elsewhere
    towards: Float[Tensor, "n photos 3"]  # unit, to the light
    eye: Float[Tensor, "n 3"]  # unit, to the camera
    normals: Float[Tensor, "n 3"]

    def part(self, pixels: slice) -> "Samples":
        """Return the samples of some of the points."""
        return Samples(**{name: value[pixels] for name, value in vars(self).items()})


@dataclass(frozen=True)
class Lobes:
    """The specular lobes that all points of an object share."""

    coefficients: Float[Tensor, "lobes 3"]  # of appearance.brdf.specular; zeros where nothing glossy was seen
    sigma: float  # of a sample, robust


def gather(
    scene: Scene,
    points: Float[Tensor, "n 3"],
    normals: Float[Tensor, "n 3"],
    pixels: tuple[Tensor, Tensor],
    lit: Float[Tensor, "photos n"],
    indirect: Indirect,
) -> Samples:
    """Return the samples of some pixels, given their surface and visibility.

    Args:
        points, normals: of the pixels, world; normals unit.
        pixels: rows and columns.
        lit: visibility in each photo.
        indirect: from_endless_ground, or better (reconstruct.render.interreflection).
    """
    assert scene.rgb is not None
    towards, strength = irradiance(scene, points)
    facing = (towards * normals).sum(-1) > MIN_COSINE
    return Samples(
        value=scene.rgb[:, pixels[0], pixels[1]].transpose(0, 1),
        weight=(lit * scene.usable[:, pixels[0], pixels[1]] * facing).T,
        strength=strength.transpose(0, 1),
        indirect=(scene.ambient + indirect(points, normals)).transpose(0, 1),
        towards=towards.transpose(0, 1),
        eye=normalize(scene.eye - points, dim=-1),
        normals=normals,
    )


def from_endless_ground(bounce: Float[Tensor, " photos"]) -> Indirect:
    """Return the irradiance from an endless, uniformly lit, grey plane below: its radiosity * (1 - n_z) / 2.

    Args:
        bounce: radiosity in each photo, see reconstruct.labels.photometric_stereo.ground_light.
    """
    return lambda points, normals: (bounce[:, None] * (1 - normals[:, 2]) / 2)[..., None]


def fit_lobes(samples: Samples) -> Lobes:
    """Fit nine lobes x RGB that all samples share, with an albedo of its own for every point.

    Minimises sum w (I - albedo (E cos + indirect) - sum_k c_k D_k E cos)^2 + doubt * reflectance(c) over c >= 0 and all
    albedos [ShadowNeuS eq:render_rgb]. The albedos are eliminated exactly, which leaves nine unknowns per channel.
    Weights are Geman-McClure, over a few rounds. The lobes are zero if a Lambertian model fits nearly as well.
    """
    nothing = torch.zeros(LOBES, 3)
    if float((samples.weight > 0).sum()) < FEWEST_SAMPLES:
        return Lobes(nothing, np.inf)
    _, plain_sigma, plain = _reweighted(samples, is_glossy=False)
    solved, sigma, glossy = _reweighted(samples, is_glossy=True)
    gain = 1 - glossy / max(plain, 1e-20)
    return Lobes(solved, sigma) if gain > LEAST_GAIN else Lobes(nothing, plain_sigma)


def shared_lobes(samples: Samples) -> Float[Tensor, "lobes 3"]:
    """Fit the lobes as `fit_lobes` does, without asking whether a Lambertian model would do."""
    return _reweighted(samples, is_glossy=True)[0]


def _reweighted(samples: Samples, is_glossy: bool) -> tuple[Float[Tensor, "lobes 3"], float, float]:
    """Return shared coefficients, the residual's robust sigma, and its mean square over all samples with outliers."""
    coefficients, weight, sigma = torch.zeros(LOBES, 3), samples.weight, 0.0
    residual, pixels = torch.zeros(0), _blocks(len(weight))
    parts = [_Prepared.of(samples.part(some), is_glossy) for some in pixels]
    for _ in range(ROUNDS):
        if is_glossy:
            equations = torch.zeros(3, LOBES, LOBES + 1, dtype=torch.float64)
            for part, some in zip(parts, pixels, strict=True):
                equations += _eliminated(part, weight[some], coefficients)
            coefficients = _non_negative(equations, DOUBT * sigma**2 * float(weight.sum()))
        residual = [part.residual(weight[some], coefficients) for part, some in zip(parts, pixels, strict=True)]
        residual = torch.cat(residual)
        sigma = spread(residual[samples.weight > 0].numpy())
        weight = samples.weight * _trust(residual, sigma)
    return coefficients, sigma, float(residual[samples.weight > 0].square().mean())


def _blocks(count: int) -> list[slice]:
    return [slice(first, first + CHUNK) for first in range(0, count, CHUNK)]


def _trust(residual: Float[Tensor, "n photos 3"], sigma: float) -> Float[Tensor, "n photos"]:
    """Return Geman-McClure weights of residuals."""
    return (1 + residual.square().mean(-1) / max(OUTLIER * sigma, 1e-12) ** 2) ** -2


def _facing(part: Samples) -> Float[Tensor, "n photos 3"]:
    """Return the direct irradiance of every sample."""
    return (part.towards * part.normals[:, None]).sum(-1, keepdim=True).clamp(min=0) * part.strength


@dataclass(frozen=True)
class _Prepared:
    """What all rounds of a fit share: samples as they would be without lobes, and the lobes' values and factors."""

    value: Float[Tensor, "n photos 3"]
    direct: Float[Tensor, "n photos 3"]  # irradiance from the light
    arriving: Float[Tensor, "n photos 3"]  # from everywhere
    lobes: Float[Tensor, "n photos lobes"]  # none for a Lambertian fit
    factor: Float[Tensor, "n photos"]  # see brdf.shape_factors
    grazing: Float[Tensor, "n photos"]

    @staticmethod
    def of(part: Samples, is_glossy: bool) -> "_Prepared":
        direct = _facing(part)
        if not is_glossy:
            nothing = part.weight[..., None][..., :0]
            return _Prepared(part.value, direct, direct + part.indirect, nothing, part.weight, part.weight)
        geometry = (part.normals[:, None], part.towards, part.eye[:, None])
        values, factor, grazing = lobes_and_factors(*geometry)
        return _Prepared(part.value, direct, direct + part.indirect, values, factor, grazing)

    def specular_share(self, coefficients: Float[Tensor, "lobes 3"]) -> Float[Tensor, "n photos 3"]:
        """Return what a lobe of coefficient 1 and value 1 reflects; F0 is that of the coefficients."""
        return fresnel(self.factor, self.grazing, coefficients) * self.direct

    def residual(
        self, weight: Float[Tensor, "n photos"], coefficients: Float[Tensor, "lobes 3"]
    ) -> Float[Tensor, "n photos 3"]:
        """Return observed minus predicted values, with each point's least-squares albedo."""
        matt = self.value
        if coefficients.any():
            matt = matt - (self.lobes @ coefficients) * self.specular_share(coefficients)
        return matt - least_squares_albedo(matt, self.arriving, weight)[:, None] * self.arriving


def _eliminated(
    part: _Prepared, weight: Float[Tensor, "n photos"], coefficients: Float[Tensor, "lobes 3"]
) -> Float[Tensor, "3 lobes columns"]:
    """Return the normal equations (matrix | right side) of the lobes with every point's albedo eliminated.

    Args:
        coefficients: of the previous round, for the Fresnel term's F0.
    """
    share, out = part.specular_share(coefficients), []
    for channel in range(3):
        albedo_one = part.arriving[..., channel]
        both = torch.cat([part.lobes * share[..., channel, None], part.value[..., channel, None]], -1)
        weighted = both * weight[..., None]
        beside = (weighted * albedo_one[..., None]).sum(1)
        own = (weight * albedo_one**2).sum(1).clamp(min=1e-12)
        full = weighted.flatten(0, 1).T @ both.flatten(0, 1) - (beside / own[:, None]).T @ beside
        out.append(full[:LOBES].double())
    return torch.stack(out)


def _non_negative(equations: Float[Tensor, "3 lobes columns"], cost: float) -> Float[Tensor, "lobes 3"]:
    """Return the non-negative minimiser of c M c - 2 r c + cost * reflectance(c), channel by channel."""
    price = 0.5 * cost * facing_reflectances().double()
    out = []
    for matrix, right in zip(equations[:, :, :LOBES], equations[:, :, LOBES], strict=True):
        root = _root(matrix)
        target = torch.linalg.solve_triangular(root, (right - price)[:, None], upper=False)[:, 0]
        out.append(torch.from_numpy(nnls(root.T.numpy(), target.numpy())[0]))
    return torch.stack(out, 1).float()


def _root(matrix: Float[Tensor, "lobes lobes"]) -> Float[Tensor, "lobes lobes"]:
    """Return the Cholesky root of normal equations.

    With three or four photos, almost nothing remains after the albedo is eliminated, and rounding in single precision
    can make an eigenvalue negative; negative ones count as 0.
    """
    ridge = RIDGE * matrix.trace().clamp(min=1e-12) * torch.eye(LOBES, dtype=torch.float64)
    root, failed = torch.linalg.cholesky_ex(matrix + ridge)
    if not failed:
        return root
    values, vectors = torch.linalg.eigh(matrix)  # the trace may be 0, too: the ridge follows the largest of them
    least = RIDGE * values.abs().max().clamp(min=1e-12)
    return torch.linalg.cholesky((vectors * values.clamp(min=least)) @ vectors.T + least * torch.eye(LOBES))


def highlights(part: Samples, coefficients: Float[Tensor, "lobes 3"]) -> Float[Tensor, "n photos 3"]:
    """Return the specular part of every sample as if it were lit; 0 without lobes."""
    if not coefficients.any():
        return torch.zeros_like(part.value)
    return specular(coefficients, part.normals[:, None], part.towards, part.eye[:, None]) * _facing(part)


def least_squares_albedo(
    value: Float[Tensor, "n photos 3"], arriving: Float[Tensor, "n photos 3"], weight: Float[Tensor, "n photos"]
) -> Float[Tensor, "n 3"]:
    """Fit the linear, non-negative albedo of diffuse points: sum w E I / sum w E^2 minimises sum w (I - albedo E)^2.

    Args:
        value: I, linear, without highlights.
        arriving: E, irradiance on the surface from everywhere, in linear pixel value for albedo 1.
        weight: w, 0 or more; a point whose weights are all 0 gets albedo 0.
    """
    w = weight[..., None]
    return (w * arriving * value).sum(1).clamp(min=0) / (w * arriving**2).sum(1).clamp(min=1e-12)


def point_materials(
    samples: Samples, lobes: Lobes, usual: Float[Tensor, " n"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]]:
    """Fit the albedo of every point (0 where no sample is lit) and its scale of the shared lobes.

    Args:
        usual: scale of the neighbourhood (see `usual_scale`); a point whose highlight no photo shows gets it.
    """
    parts = [_own_materials(samples.part(p), lobes, usual[p], SCALE_SIGMA) for p in _blocks(len(samples.value))]
    if not parts:
        return torch.zeros(0, 3), torch.zeros(0)
    return torch.cat([part[0] for part in parts]), torch.cat([part[1] for part in parts])


def usual_scale(
    samples: Samples, lobes: Lobes, points: Float[Tensor, "n 3"], where: Float[Tensor, "m 3"]
) -> Float[Tensor, " m"]:
    """Fit the scale of the shared lobes around each place, by least squares over NEIGHBOURS samples together.

    Args:
        points: of the samples, world.
        where: places to estimate the scale at, world.
    """
    if not lobes.coefficients.any():
        return torch.ones(len(where))
    ones = torch.ones(len(points))
    parts = [_own_materials(samples.part(p), lobes, ones[p], LOOSE_SIGMA) for p in _blocks(len(points))]
    above, seen = torch.cat([part[2] for part in parts]), torch.cat([part[3] for part in parts])
    _, index = KDTree(points.numpy()).query(where.numpy(), k=min(NEIGHBOURS, len(points)), workers=-1)
    near = torch.from_numpy(np.asarray(index)).reshape(len(where), -1)
    prior = (lobes.sigma / LOOSE_SIGMA) ** 2
    return ((above[near].sum(1) + prior) / (seen[near].sum(1) + prior)).clamp(min=0)


def _own_materials(
    part: Samples, lobes: Lobes, usual: Float[Tensor, " n"], spread: float
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"], Float[Tensor, " n"], Float[Tensor, " n"]]:
    """Fit albedo and scale (prior: usual +- spread); also return right side and information of the scale's fit."""
    gloss, one = highlights(part, lobes.coefficients), _facing(part) + part.indirect
    scale, weight, albedo = usual, part.weight, torch.zeros(len(gloss), 3)
    above = seen = torch.zeros(len(gloss))
    prior = max(lobes.sigma / spread, 1e-9) ** 2
    for _ in range(ROUNDS):
        w = weight[..., None]
        albedo = least_squares_albedo(part.value - scale[:, None, None] * gloss, one, weight)
        above, seen = (w * gloss * (part.value - albedo[:, None] * one)).sum((1, 2)), (w * gloss**2).sum((1, 2))
        scale = ((above + prior * usual) / (seen + prior)).clamp(min=0)
        residual = part.value - albedo[:, None] * one - scale[:, None, None] * gloss
        weight = part.weight * _trust(residual, lobes.sigma)
    return albedo, scale, above, seen
