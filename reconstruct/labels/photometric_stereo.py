"""Normals, albedo and shadow labels of the object: robust photometric stereo under near lights, pixel by pixel."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from reconstruct.appearance.lobe_fit import Indirect, from_endless_ground
from reconstruct.labels.ground_test import GroundTest
from reconstruct.labels.outline import dilated, local_mean
from reconstruct.scene import Scene, grey_irradiance, grey_of
from reconstruct.shading.joint_normals import Picture, fit_together
from reconstruct.shading.noise import DEFAULT_NOISE, Noise
from reconstruct.shading.normal_fit import MODEL_SHARE, Pixels, Prior, fit_normals, indirect_light, misfit
from reconstruct.shading.normal_kernels import INDIRECT_SHARE

Beyond = Callable[[Tensor], Tensor]  # of pixels: the light between surfaces in each photo less an endless ground's

CHUNK = 8192  # pixels at once: 40 photos of them stay near the processor
DARKER_DOUBT = 1.0  # log ratio to the neighbours' albedo at which a darker fit is no longer trusted
USUAL_STEP = 3  # every third pixel will do for it
NEIGHBOURHOOD = 0.1  # of the object's longer side
GRAZING = 0.15  # cosine to the light below which shading hardly determines shadows
NORMAL_SIGMA = 0.12  # rad: error of a photometric normal
FEWEST_INLIERS, ENOUGH_INLIERS = 4.0, 10.0  # effective photos behind a normal: confidence 0 and 1
FEWEST_SHARE, ENOUGH_SHARE = 0.3, 0.7  # of the photos, if that is fewer: then albedo and surface must help out
OFTEN_FEW = 0.2  # of the object's pixels with fewer than FEWEST_INLIERS: then all normals are fitted together
LIT_TOGETHER = 3.0  # effective photos behind a normal that was fitted with its neighbours: confidence 1
MOST_SAMPLES = 1_000_000  # pixels times photos that are fitted together: 200 MB
EXPLAINED, UNEXPLAINED = 1.0, 4.0  # misfit of a pixel up to which its labels count in full, and from which not at all
USUAL_MISFIT = 0.25  # of the object's pixels, median; where it is larger, these two grow with it
EDGE_SHARE = 0.25  # of the confidence on mask-edge pixels, which mix two surfaces


@dataclass(frozen=True)
class ObjectLabels:
    """Labels of the object's pixels from shading; zeros elsewhere."""

    normals: Float[Tensor, "height width 3"]  # world
    normal_confidence: Float[Tensor, "height width"]
    albedo: Float[Tensor, "height width 3"]  # relative to Scene.power
    visibility: Float[Tensor, "photos height width"]
    confidence: Float[Tensor, "photos height width"]
    is_alone: bool = False  # each pixel by itself, though so few photos light them that neighbours should help out


def label_object(
    scene: Scene,
    points: Float[Tensor, "height width 3"],
    normals: Float[Tensor, "height width 3"] | None,
    mask: Float[Tensor, "height width"],
    ground: GroundTest | None = None,
    indirect: Indirect | None = None,
    first_look: bool = False,
) -> ObjectLabels:
    """Estimate normals, albedo and shadow labels of the pixels with mask > 0.5, given approximate surface points.

    Solves I_k = albedo (E_k max(n . l_k, 0) V_k + indirect) for albedo * n with weights that shrink for outliers:
    shadows are too dark, highlights too bright. The indirect light is ambient plus the bounce of the lit ground,
    albedo_ground * E_ground * (1 - n_z) / 2, the form factor of an infinite plane, scaled to the observed shadows. Of a
    surface that is known, light between its parts and the ground comes in place of the plane's [Nayar, Ikeuchi and
    Kanade, Shape from interreflections, IJCV 1991], whose form factor then tells how it changes with the normal.

    Args:
        points: world, the current surface; used where mask > 0.5.
        normals: the current surface's, world, where known (0 elsewhere): the prior of each pixel's normal, which
            decides where the photos are too few.
        ground: gives the noise and the light reflected by the ground; without it neither is known.
        indirect: irradiance of surface points by all that object and ground reflect; None: by an endless ground alone.
        first_look: for the albedo: no pixels are fitted together, which takes ten times as long.

    Raises:
        ValueError: the scene has shadow pictures only.
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
    gather = partial(_gather, scene, points, bounce=scaled, noise=noise)
    if indirect is not None and normals is not None:
        gather = partial(gather, beyond=partial(_beyond_endless_ground, points, normals, indirect, scaled))
    usual = _usual_albedo(where, gather)
    solved, inliers, errors = torch.zeros(len(places), 3), torch.zeros(len(places)), torch.zeros(len(places))
    for part, own in _chunks(places):
        pixels, (row, column) = gather(part), part.unbind(1)
        guess = None if normals is None else normals[row, column]
        solved[own], weight = fit_normals(pixels, Prior(usual[row, column], guess))
        inliers[own], errors[own] = weight.sum(1), misfit(pixels, solved[own])
        trust = _normal_trust(pixels, solved[own], weight, usual[row, column])
        _write(labels, scene, part, pixels, solved[own], weight, trust)
    few = bool((inliers < FEWEST_INLIERS).float().mean() > OFTEN_FEW) and len(places) * len(scene.lights) < MOST_SAMPLES
    if few and not first_look:
        _write_together(labels, scene, places, gather(places), normals, solved, inliers)
    share = torch.where(dilated(~where, 3), EDGE_SHARE, 1.0)
    if not few:
        share[tuple(places.T)] *= _explained(errors)
    trusted = replace(labels, normal_confidence=labels.normal_confidence * share, confidence=labels.confidence * share)
    return replace(trusted, is_alone=few and first_look)


def _explained(errors: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Return the share of trust that pixels keep whose photos no normal and albedo explain, by their misfit.

    An underside in sight of lit ground looks like a dark plate that faces up and is lit in all photos; its lit rays
    would carve the object. Of the samples called lit in two rendered captures, less than 1 in 5,000 is not with a
    misfit below .25, 2 to 5 in 100 with 1 to 1.5, a fifth to a half with 3 to 5, and a third to two thirds beyond;
    normals are 2, 5 to 9, 36 to 77 and 56 to 110 degrees off.
    """
    scale = (errors.median() / USUAL_MISFIT).clamp(min=1.0)
    return ((UNEXPLAINED - errors / scale) / (UNEXPLAINED - EXPLAINED)).clamp(0, 1)


def _chunks(places: Int[Tensor, "n 2"]) -> Iterator[tuple[Int[Tensor, "m 2"], slice]]:
    """Yield pixels in blocks, each with its part of the list."""
    for start in range(0, len(places), CHUNK):
        own = slice(start, start + CHUNK)
        yield places[own], own


def _write(
    labels: ObjectLabels,
    scene: Scene,
    places: Int[Tensor, "n 2"],
    pixels: Pixels,
    solved: Float[Tensor, "n 3"],
    weight: Float[Tensor, "n photos"],
    trust: Float[Tensor, " n"],
) -> None:
    """Set the labels of some pixels, in place, from their albedo * normal and the weights of their photos."""
    row, column = places.unbind(1)
    albedo = torch.linalg.vector_norm(solved, dim=-1).clamp(min=1e-6)
    normal = solved / albedo[:, None]
    visibility, confidence = _shadow_labels(pixels, normal, albedo)
    labels.normals[row, column], labels.normal_confidence[row, column] = normal, trust
    labels.visibility[:, row, column] = visibility.T
    labels.confidence[:, row, column] = confidence.T * (0.3 + 0.7 * trust)
    labels.albedo[row, column] = _colour(scene, pixels, places, normal, weight)


def _write_together(
    labels: ObjectLabels,
    scene: Scene,
    places: Int[Tensor, "n 2"],
    pixels: Pixels,
    normals: Float[Tensor, "height width 3"] | None,
    solved: Float[Tensor, "n 3"],
    inliers: Float[Tensor, " n"],
) -> None:
    """Fit the normals of all pixels together, and set the labels where a pixel's own photos are few, in place.

    Args:
        solved, inliers: of each pixel by itself: albedo * normal, and effective photos behind it.
    """
    assert scene.rgb is not None
    row, column = places.unbind(1)
    bright = pixels.usable * pixels.value / pixels.strength
    bright = (bright / bright.amax(1, keepdim=True).clamp(min=1e-12)) ** 2
    seen = torch.einsum("nk,knc->nc", bright, scene.rgb[:, row, column] / scene.tint[:, None])
    picture = Picture(places, scene.directions, seen / seen.sum(-1, keepdim=True).clamp(min=1e-12))
    guess = None if normals is None else normals[row, column]
    joint, weight = fit_together(picture, pixels, guess, solved)
    alone = ((inliers - FEWEST_INLIERS) / (ENOUGH_INLIERS - FEWEST_INLIERS)).clamp(0, 1)
    trust = alone * labels.normal_confidence[row, column] + (1 - alone) * (weight.sum(1) / LIT_TOGETHER).clamp(0, 1)
    _write(labels, scene, places, pixels, alone[:, None] * solved + (1 - alone)[:, None] * joint, weight, trust)


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


def _gather(
    scene: Scene, points: Tensor, places: Tensor, bounce: Tensor, noise: Noise, beyond: Beyond | None = None
) -> Pixels:
    """Return the samples of some pixels; `beyond` is the light between surfaces beyond the ground's bounce there."""
    assert scene.rgb is not None
    row, column = places.unbind(1)
    towards, strength = grey_irradiance(scene, points[row, column])
    return Pixels(
        value=grey_of(scene.rgb[:, row, column]).T.contiguous(),
        usable=scene.usable[:, row, column].T.contiguous(),
        towards=towards.transpose(0, 1).contiguous(),
        strength=strength.T.contiguous(),
        bounce=bounce,
        ambient=float(scene.ambient.mean()) + (0.0 if beyond is None else beyond(places)),
        noise=noise,
    )


def _beyond_endless_ground(
    points: Tensor, normals: Tensor, indirect: Indirect, bounce: Tensor, places: Int[Tensor, "n 2"]
) -> Float[Tensor, "n photos"]:
    """Return the light between surfaces less what an endless ground would send; 0 where there is no surface."""
    row, column = places.unbind(1)
    at, facing = points[row, column], normals[row, column]
    known = (facing != 0).any(-1)
    out = torch.zeros(len(places), len(bounce))
    at, facing = at[known], facing[known]
    out[known] = (indirect(at, facing) - from_endless_ground(bounce)(at, facing)).mean(-1).T
    return out


def ground_light(
    scene: Scene,
    points: Float[Tensor, "height width 3"],
    where: Bool[Tensor, "height width"],
    ground: GroundTest | None,
) -> Float[Tensor, " photos"]:
    """Return the irradiance of lit ground on a surface that faces down, in each photo, scaled to the object's shadows.

    Args:
        points: world, the current surface.
        where: pixels that show the object.
    """
    if not where.any():
        return torch.zeros(len(scene.lights))
    bounce = _ground_bounce(scene, points[where], ground)
    noise = DEFAULT_NOISE if ground is None else ground.noise
    return bounce * _bounce_scale(scene, points, torch.nonzero(where), bounce, noise)


def _ground_bounce(scene: Scene, surface: Float[Tensor, "n 3"], ground: GroundTest | None) -> Float[Tensor, " photos"]:
    """Return the radiosity of the lit ground around the object in each photo; 0 without a ground test."""
    seen = None if ground is None else ground.albedo.mean(-1)[ground.albedo.sum(-1) > 0]
    if seen is None or not len(seen):
        return torch.zeros(len(scene.lights))
    centre = surface.median(0).values
    reach = (surface[:, :2] - centre[:2]).norm(dim=-1).max()
    angle = torch.arange(8) * (torch.pi / 4)
    ring = centre[:2] + reach * torch.stack([angle.cos(), angle.sin()], -1)
    towards, strength = grey_irradiance(scene, torch.cat([ring, torch.full((8, 1), scene.ground_height)], 1))
    return float(seen.median()) * (strength * towards[..., 2].clamp(min=0)).mean(1)


def _bounce_scale(scene: Scene, points: Tensor, places: Tensor, bounce: Tensor, noise: Noise) -> float:
    """Return the ratio of observed to modelled bounce: the median over samples turned away from their light."""
    if not bounce.any():
        return 0.0
    some = places[:: max(1, len(places) // 2000)]
    pixels = _gather(scene, points, some, torch.zeros_like(bounce), noise)
    scaled_normal, _ = fit_normals(pixels)
    albedo = torch.linalg.vector_norm(scaled_normal, dim=-1, keepdim=True).clamp(min=1e-6)
    normal = scaled_normal / albedo
    turned_away = (pixels.towards @ normal[..., None])[..., 0] < -GRAZING
    modelled = bounce * (1 - normal[:, 2:]) / 2
    usable = turned_away & pixels.usable & (modelled > 0.1 * bounce)
    seen = ((pixels.value / albedo - pixels.ambient) / modelled.clamp(min=1e-12))[usable]
    return float(seen.median().clamp(0, 2)) if len(seen) > 50 else 0.0


def _usual_albedo(where: Bool[Tensor, "height width"], gather: Callable[[Tensor], Pixels]) -> Tensor:
    """Return the local mean albedo of well-lit pixels: the probable albedo of a badly lit pixel there."""
    places = torch.nonzero(where)[::USUAL_STEP]
    logs, weights = torch.zeros(where.shape), torch.zeros(where.shape)
    for part in places.split(CHUNK):
        row, column = part.unbind(1)
        solved, weight = fit_normals(gather(part))
        logs[row, column] = torch.linalg.vector_norm(solved, dim=-1).clamp(min=1e-6).log()
        weights[row, column] = weight.sum(1) ** 2
    extent = places.max(0).values - places.min(0).values
    window = 2 * int(NEIGHBOURHOOD * float(extent.max()) / 2) + 1
    total = local_mean(torch.stack([weights * logs, weights]), window)
    anywhere = (weights * logs).sum() / weights.sum().clamp(min=1e-12)  # where no such pixel is near
    return torch.where(total[1] > 0, total[0] / total[1].clamp(min=1e-12), anywhere).exp()


def _normal_trust(pixels: Pixels, solved: Tensor, weight: Tensor, usual: Tensor) -> Float[Tensor, " n"]:
    """Return the confidence of a normal, from the number of inliers, the spread of their lights and the albedo."""
    albedo = torch.linalg.vector_norm(solved, dim=-1).clamp(min=1e-6)
    inliers = weight.sum(1)
    photos = pixels.usable.shape[1]
    few, enough = min(FEWEST_INLIERS, FEWEST_SHARE * photos), min(ENOUGH_INLIERS, ENOUGH_SHARE * photos)
    count = ((inliers - few) / (enough - few)).clamp(0, 1)
    spread = (pixels.towards * weight[..., None]).transpose(1, 2) @ pixels.towards / inliers.clamp(min=1)[:, None, None]
    thin = torch.linalg.eigvalsh(spread)[:, 0]
    darker = (usual.log() - albedo.log()).clamp(min=0)
    return count * (thin / 0.03).clamp(0, 1) * (1 - darker / DARKER_DOUBT).clamp(min=EDGE_SHARE) * (albedo > 2e-6)


def _shadow_labels(
    pixels: Pixels, normal: Float[Tensor, "n 3"], albedo: Float[Tensor, " n"]
) -> tuple[Float[Tensor, "n photos"], Float[Tensor, "n photos"]]:
    """Return lit (1) or in shadow (0), and the confidence: the odds of the value in both cases, given its sigmas."""
    cosine = (pixels.towards @ normal[..., None])[..., 0]
    full = albedo[:, None] * pixels.strength
    indirect = albedo[:, None] * indirect_light(pixels, normal)
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


def _colour(scene: Scene, pixels: Pixels, places: Tensor, normal: Tensor, weight: Tensor) -> Float[Tensor, "n 3"]:
    """Return the albedo per channel: observed over expected colour, summed over the inlier photos."""
    assert scene.rgb is not None
    row, column = places.unbind(1)
    cosine = (pixels.towards @ normal[..., None])[..., 0].clamp(min=0)
    expected = torch.einsum("nk,kc->nc", weight * pixels.strength * cosine, scene.tint)
    expected = expected + weight.sum(1, keepdim=True) * scene.ambient
    expected = expected + (weight * (indirect_light(pixels, normal) - pixels.ambient)).sum(1, keepdim=True)
    seen = torch.einsum("nk,knc->nc", weight, scene.rgb[:, row, column])
    return torch.where(expected > 0, seen / expected.clamp(min=1e-12), torch.zeros(()))
