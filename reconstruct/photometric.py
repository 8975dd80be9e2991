"""Normals, albedo and shadow labels of the object: robust photometric stereo under near lights, pixel by pixel."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d, normalize

from reconstruct.ground import GroundTest, Noise
from reconstruct.outline import local_mean
from reconstruct.scene import Scene, irradiance

CHUNK = 8192  # pixels at once: 40 photos of them stay near the processor
ROUNDS = 7  # of reweighting; the accepted residual shrinks from WIDE (or NEAR) to NARROW sigmas meanwhile
WIDE, NEAR, NARROW = 8.0, 3.0, 2.0
MODEL_SHARE = 0.03  # one sigma of what Lambert's law and the light model miss, of the predicted value
INDIRECT_SHARE = 0.3  # one sigma of the light between surfaces, of its estimate
ALBEDO_SIGMA = 0.15  # of the neighbours' albedo: how alike neighbours are
SURELY_DIRECT = 0.25  # of albedo * irradiance: brighter than any light between surfaces
SAME_ALBEDO_BONUS = 0.2  # of the photos may go unexplained for the albedo to be the neighbours'
DARKER_DOUBT = 1.0  # log ratio to the neighbours' albedo at which a darker fit is no longer trusted
USUAL_STEP = 3  # every third pixel will do for it
NEIGHBOURHOOD = 0.1  # of the object's longer side
GRAZING = 0.15  # cosine to the light below which shading says little about shadows
HIGHLIGHT_PATIENCE = 3.0  # times wider when brighter than expected: shadows are common, highlights are rare
FIRST_LIT_SHARE = 0.5  # of the third-brightest sample: darker ones are left out at first
NORMAL_SIGMA = 0.12  # rad: what a photometric normal is off by
FEWEST_INLIERS, ENOUGH_INLIERS = 4.0, 10.0  # effective photos behind a normal: confidence 0 and 1
EDGE_SHARE = 0.25  # of the confidence on mask-edge pixels, which mix two surfaces
DEFAULT_NOISE = Noise(1e-3, 0.01)


@dataclass(frozen=True)
class ObjectLabels:
    """What shading says about the object's pixels; zeros elsewhere."""

    normals: Float[Tensor, "height width 3"]  # world
    normal_confidence: Float[Tensor, "height width"]
    albedo: Float[Tensor, "height width 3"]  # relative to Scene.power
    visibility: Float[Tensor, "photos height width"]
    confidence: Float[Tensor, "photos height width"]


@dataclass(frozen=True)
class _Pixels:
    """Some object pixels: what was seen, and the light that would reach them."""

    value: Float[Tensor, "n photos"]  # mean of RGB
    usable: Bool[Tensor, "n photos"]
    towards: Float[Tensor, "n photos 3"]
    strength: Float[Tensor, "n photos"]
    bounce: Float[Tensor, "photos"]  # irradiance of lit ground on a surface that faces down
    ambient: float
    noise: Noise


def label_object(
    scene: Scene,
    points: Float[Tensor, "height width 3"],
    normals: Float[Tensor, "height width 3"] | None,
    mask: Float[Tensor, "height width"],
    ground: GroundTest | None = None,
) -> ObjectLabels:
    """Normals and shadow labels of the pixels with mask > 0.5, given where their surface is about.

    Solves I_k = albedo (E_k max(n . l_k, 0) V_k + indirect) for albedo * n by weights that shrink on what does not fit:
    shadows are too dark, highlights too bright. The indirect light is ambient plus the bounce of the lit ground,
    albedo_ground * E_ground * (1 - n_z) / 2, the form factor of an endless plane, scaled to the shadows that were seen.

    Args:
        points: world, the current surface; read where mask > 0.5.
        normals: the current surface's, world, where known (0 elsewhere): a second start for the weights.
        ground: noise, and the light that the ground throws back; without it neither is known.
    """
    if scene.rgb is None:
        raise ValueError("photometric stereo needs photos")
    where = (mask > 0.5) & points.isfinite().all(-1)
    labels = _blank(scene)
    if not where.any():
        return labels
    noise = DEFAULT_NOISE if ground is None else ground.noise
    places = torch.nonzero(where)
    scaled = ground_light(scene, points, where, ground)
    usual = _usual_albedo(scene, points, where, scaled, noise)
    for part in places.split(CHUNK):
        row, column = part.unbind(1)
        pixels = _gather(scene, points, part, scaled, noise)
        guess = None if normals is None else normals[row, column]
        solved, weight = _fit_normals(pixels, guess, usual[row, column])
        albedo = torch.linalg.vector_norm(solved, dim=-1).clamp(min=1e-6)
        normal = solved / albedo[:, None]
        trust = _normal_trust(pixels, albedo, weight, usual[row, column])
        visibility, confidence = _shadow_labels(pixels, normal, albedo)
        labels.normals[row, column], labels.normal_confidence[row, column] = normal, trust
        labels.visibility[:, row, column] = visibility.T
        labels.confidence[:, row, column] = confidence.T * (0.3 + 0.7 * trust)
        labels.albedo[row, column] = _colour(scene, pixels, part, normal, weight)
    edge = max_pool2d(1 - where.float()[None], 3, 1, 1)[0] > 0
    share = torch.where(edge, EDGE_SHARE, 1.0)
    return ObjectLabels(
        labels.normals,
        labels.normal_confidence * share,
        labels.albedo,
        labels.visibility,
        labels.confidence * share,
    )


def _blank(scene: Scene) -> ObjectLabels:
    height, width = scene.directions.shape[:2]
    n_photos = len(scene.lights)
    return ObjectLabels(
        torch.zeros(height, width, 3),
        torch.zeros(height, width),
        torch.zeros(height, width, 3),
        torch.zeros(n_photos, height, width),
        torch.zeros(n_photos, height, width),
    )


def _gather(scene: Scene, points: Tensor, places: Tensor, bounce: Tensor, noise: Noise) -> _Pixels:
    assert scene.rgb is not None
    row, column = places.unbind(1)
    towards, strength = irradiance(scene, points[row, column])
    return _Pixels(
        value=scene.rgb[:, row, column].mean(-1).T.contiguous(),
        usable=scene.usable[:, row, column].T.contiguous(),
        towards=towards.transpose(0, 1).contiguous(),
        strength=strength.mean(-1).T.contiguous(),
        bounce=bounce,
        ambient=float(scene.ambient.mean()),
        noise=noise,
    )


def ground_light(
    scene: Scene,
    points: Float[Tensor, "height width 3"],
    where: Bool[Tensor, "height width"],
    ground: GroundTest | None,
) -> Float[Tensor, "photos"]:
    """Irradiance of lit ground on a surface that faces down, in each photo, as strong as the object's shadows show."""
    if not where.any():
        return torch.zeros(len(scene.lights))
    bounce = _ground_bounce(scene, points[where], ground)
    noise = DEFAULT_NOISE if ground is None else ground.noise
    return bounce * _bounce_scale(scene, points, torch.nonzero(where), bounce, noise)


def _ground_bounce(scene: Scene, surface: Float[Tensor, "n 3"], ground: GroundTest | None) -> Float[Tensor, "photos"]:
    """Radiosity of the lit ground around the object in each photo; 0 without a ground test."""
    seen = None if ground is None else ground.albedo.mean(-1)[ground.albedo.sum(-1) > 0]
    if seen is None or not len(seen):
        return torch.zeros(len(scene.lights))
    centre = surface.median(0).values
    reach = (surface[:, :2] - centre[:2]).norm(dim=-1).max()
    angle = torch.arange(8) * (torch.pi / 4)
    ring = centre[:2] + reach * torch.stack([angle.cos(), angle.sin()], -1)
    towards, strength = irradiance(scene, torch.cat([ring, torch.full((8, 1), scene.ground_height)], 1))
    return float(seen.median()) * (strength.mean(-1) * towards[..., 2].clamp(min=0)).mean(1)


def _bounce_scale(scene: Scene, points: Tensor, places: Tensor, bounce: Tensor, noise: Noise) -> float:
    """What share of the modelled bounce is there: the median over samples turned away from their light."""
    if not bounce.any():
        return 0.0
    some = places[:: max(1, len(places) // 2000)]
    pixels = _gather(scene, points, some, torch.zeros_like(bounce), noise)
    scaled_normal, _ = _fit_normals(pixels, None, None)
    albedo = torch.linalg.vector_norm(scaled_normal, dim=-1, keepdim=True).clamp(min=1e-6)
    normal = scaled_normal / albedo
    turned_away = (pixels.towards @ normal[..., None])[..., 0] < -GRAZING
    modelled = bounce * (1 - normal[:, 2:]) / 2
    usable = turned_away & pixels.usable & (modelled > 0.1 * bounce)
    seen = ((pixels.value / albedo - pixels.ambient) / modelled.clamp(min=1e-12))[usable]
    return float(seen.median().clamp(0, 2)) if len(seen) > 50 else 0.0


def _usual_albedo(
    scene: Scene, points: Tensor, where: Bool[Tensor, "height width"], bounce: Tensor, noise: Noise
) -> Float[Tensor, "height width"]:
    """Albedo of well-lit pixels, averaged over a neighbourhood: what a badly lit one there probably has."""
    places = torch.nonzero(where)[::USUAL_STEP]
    logs, weights = torch.zeros(where.shape), torch.zeros(where.shape)
    for part in places.split(CHUNK):
        row, column = part.unbind(1)
        solved, weight = _fit_normals(_gather(scene, points, part, bounce, noise), None, None)
        logs[row, column] = torch.linalg.vector_norm(solved, dim=-1).clamp(min=1e-6).log()
        weights[row, column] = weight.sum(1) ** 2
    extent = places.max(0).values - places.min(0).values
    window = 2 * int(NEIGHBOURHOOD * float(extent.max()) / 2) + 1
    total = local_mean(torch.stack([weights * logs, weights]), window)
    return (total[0] / total[1].clamp(min=1e-12)).exp()


def _indirect(pixels: _Pixels, normal: Float[Tensor, "n 3"]) -> Float[Tensor, "n photos"]:
    """Irradiance that reaches a surface in shadow."""
    return pixels.ambient + pixels.bounce * (1 - normal[:, 2:]) / 2


def _fit_normals(
    pixels: _Pixels, guess: Float[Tensor, "n 3"] | None, albedo: Float[Tensor, "n"] | None
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n photos"]]:
    """albedo * normal of each pixel, and the final weight of its photos: the best of up to three starts.

    From the bright samples; the same pulled to a given albedo; from the samples that a guessed normal explains.
    """
    ratio = torch.where(pixels.usable, pixels.value / pixels.strength, torch.zeros(()))
    third = ratio.topk(min(3, ratio.shape[1]), dim=1).values[:, -1:].clamp(min=1e-12)
    bright = (ratio > FIRST_LIT_SHARE * third) * (ratio / third).clamp(max=1)
    best, weight, cost = _reweighted(pixels, bright * pixels.usable, None)
    if albedo is not None:
        level = albedo[:, None]
        direct = (pixels.value - level * _indirect(pixels, normalize(best, dim=-1))) / (level * pixels.strength)
        lit = direct.clamp(0, 1) * (direct > SURELY_DIRECT) * pixels.usable
        other, other_weight, other_cost = _reweighted(pixels, lit, albedo)
        better = (other_cost < cost + SAME_ALBEDO_BONUS)[:, None]
        best, weight = torch.where(better, other, best), torch.where(better, other_weight, weight)
        cost = torch.where(better[:, 0], other_cost, cost)
    if guess is not None:
        facing = (pixels.towards @ guess[..., None])[..., 0].clamp(min=0)
        expected = ratio / facing.clamp(min=GRAZING)
        level = torch.where(facing > GRAZING, expected, torch.nan).nanquantile(0.7, dim=1, keepdim=True)
        fits = ((expected / level - 1).abs() < 0.3) & (facing > GRAZING) & pixels.usable
        other, other_weight, other_cost = _reweighted(pixels, fits.float(), None)
        better = (other_cost < cost)[:, None]
        best, weight = torch.where(better, other, best), torch.where(better, other_weight, weight)
    return best, weight


def _reweighted(
    pixels: _Pixels, weight: Float[Tensor, "n photos"], albedo: Float[Tensor, "n"] | None
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n photos"], Float[Tensor, "n"]]:
    """Iteratively reweighted least squares with Geman-McClure weights, from given first weights.

    Returns:
        albedo * normal, the final weights, and the cost: the share of the photos that is not explained as lit.
    """
    rows = pixels.towards * pixels.strength[..., None]
    solved = torch.zeros_like(pixels.towards[:, 0])
    if albedo is not None:
        solved = albedo[:, None] * normalize((pixels.towards * weight[..., None]).sum(1), dim=-1)
    cost = torch.zeros_like(pixels.value[:, 0])
    for i in range(ROUNDS):
        length = torch.linalg.vector_norm(solved, dim=-1, keepdim=True)
        normal = solved / length.clamp(min=1e-6)
        indirect = length * _indirect(pixels, normal)
        w = weight / _sigma(pixels, length, indirect) ** 2
        matrix = (rows * w[..., None]).transpose(1, 2) @ rows
        right = (rows * (w * (pixels.value - indirect))[..., None]).sum(1)
        if albedo is not None:
            pull = 1 / (ALBEDO_SIGMA * albedo.clamp(min=1e-6)) ** 2
            matrix = matrix + pull[:, None, None] * normal[:, :, None] * normal[:, None, :]
            right = right + (pull * albedo)[:, None] * normal
        ridge = 1e-4 * matrix.diagonal(dim1=1, dim2=2).sum(-1).clamp(min=1e-6)
        solved = torch.linalg.solve(matrix + ridge[:, None, None] * torch.eye(3), right)
        direct = (rows @ solved[..., None])[..., 0]
        length = torch.linalg.vector_norm(solved, dim=-1, keepdim=True)
        indirect = length * _indirect(pixels, solved / length.clamp(min=1e-6))
        residual = (pixels.value - indirect - direct) / _sigma(pixels, length, indirect)
        widest = WIDE if albedo is None else NEAR
        width = widest * (NARROW / widest) ** (i / (ROUNDS - 1))
        share = 1 / (1 + (residual / torch.where(residual > 0, HIGHLIGHT_PATIENCE * width, width)) ** 2)
        weight = share**2 * pixels.usable * (direct > 0)
        cost = 1 - (share * pixels.usable * (direct > 0)).sum(1) / pixels.usable.sum(1).clamp(min=1)
    return solved, weight, cost


def _sigma(
    pixels: _Pixels, albedo: Float[Tensor, "n 1"], indirect: Float[Tensor, "n photos"]
) -> Float[Tensor, "n photos"]:
    """One sigma of a lit sample: noise, model error in proportion to it, and unknown indirect light."""
    model = MODEL_SHARE * pixels.value
    base = 0.3 * MODEL_SHARE * albedo * pixels.strength
    spread = INDIRECT_SHARE * indirect
    return (pixels.noise.sigma(pixels.value) ** 2 + model**2 + base**2 + spread**2).sqrt()


def _normal_trust(pixels: _Pixels, albedo: Tensor, weight: Tensor, usual: Tensor) -> Float[Tensor, "n"]:
    """Confidence of a normal: enough photos agree, from directions that are spread enough, and it faces the camera."""
    inliers = weight.sum(1)
    count = ((inliers - FEWEST_INLIERS) / (ENOUGH_INLIERS - FEWEST_INLIERS)).clamp(0, 1)
    spread = (pixels.towards * weight[..., None]).transpose(1, 2) @ pixels.towards / inliers.clamp(min=1)[:, None, None]
    thin = torch.linalg.eigvalsh(spread)[:, 0]
    darker = (usual.log() - albedo.log()).clamp(min=0)
    return count * (thin / 0.03).clamp(0, 1) * (1 - darker / DARKER_DOUBT).clamp(min=EDGE_SHARE) * (albedo > 2e-6)


def _shadow_labels(
    pixels: _Pixels, normal: Float[Tensor, "n 3"], albedo: Float[Tensor, "n"]
) -> tuple[Float[Tensor, "n photos"], Float[Tensor, "n photos"]]:
    """Lit (1) or in shadow (0), and how sure: the odds of the seen value under both, given what is uncertain."""
    cosine = (pixels.towards @ normal[..., None])[..., 0]
    full = albedo[:, None] * pixels.strength
    indirect = albedo[:, None] * _indirect(pixels, normal)
    floor = (pixels.noise.floor**2 + (INDIRECT_SHARE * indirect) ** 2).sqrt()
    direct = full * cosine.clamp(min=GRAZING / 3)
    share = (pixels.value - indirect) / direct
    angle = NORMAL_SIGMA * (1 - cosine**2).clamp(min=0).sqrt() / cosine.clamp(min=GRAZING / 3)
    sigma2 = (5 * MODEL_SHARE) ** 2 + (floor / direct) ** 2 + angle**2
    odds = (2 * share.clamp(-0.5, 1.5) - 1) / (2 * sigma2)
    certain = (odds / 2).tanh().abs() * (cosine / GRAZING).clamp(0, 1)
    is_dark = (pixels.value - indirect) < GRAZING * full
    away = (-cosine / GRAZING).clamp(0, 1) * torch.where(is_dark, 1.0, EDGE_SHARE)
    visibility = ((share > 0.5) & (cosine > 0)).float()
    return visibility, torch.where(cosine > 0, certain, away) * pixels.usable


def _colour(scene: Scene, pixels: _Pixels, places: Tensor, normal: Tensor, weight: Tensor) -> Float[Tensor, "n 3"]:
    """Albedo per channel: seen over expected colour, summed over the photos that fit."""
    assert scene.rgb is not None
    row, column = places.unbind(1)
    cosine = (pixels.towards @ normal[..., None])[..., 0].clamp(min=0)
    tint = scene.power / scene.power.mean(-1, keepdim=True)
    expected = torch.einsum("nk,kc->nc", weight * pixels.strength * cosine, tint)
    expected = expected + weight.sum(1, keepdim=True) * scene.ambient
    expected = expected + (weight * (_indirect(pixels, normal) - pixels.ambient)).sum(1, keepdim=True)
    seen = torch.einsum("nk,knc->nc", weight, scene.rgb[:, row, column])
    return torch.where(expected > 0, seen / expected.clamp(min=1e-12), torch.zeros(()))
