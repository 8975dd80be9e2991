"""Normals and albedo of single pixels under near lights, with visibility from a solved surface.

The value of a lit sample is I_k = albedo (E_k (n . l_k) + indirect_k) + specular_k, with E_k the irradiance of the
calibrated light on a surface that faces it. The solved material gives the specular part; the rest is the model of
reconstruct.shading.normal_fit. Relief too fine for the surface casts shadows of its own, which are outliers.

Sample the details of all views at points of their surface: which normal and albedo a place has.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from calibration.camera import Camera
from reconstruct.appearance.brdf import Gloss, specular
from reconstruct.appearance.lobe_fit import Samples, least_squares_albedo
from reconstruct.detail.file import SURE, Detail
from reconstruct.render.g_buffer import RenderView
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.rays import in_line_of_sight
from reconstruct.shading.noise import Noise
from reconstruct.shading.normal_fit import Pixels, Prior, robust_normals

SAME_VOXELS = 1.0  # a point this close to the camera's first hit counts as seen
POINTS_AT_ONCE = 2**18
LEAST_FACING = 0.01  # cosine; a view that sees a place at less counts as this
NO_WEIGHT = 1e-12
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
class DetailSample:
    """A detail sampled at points of the surface."""

    normals: Float[Tensor, "n 3"]  # unit, world; 0 where there is none
    albedo: Float[Tensor, "n 3"]
    confidence: Float[Tensor, " n"]  # in [0, 1]; 0 where no camera of the capture sees the place


def detail_at(details: Sequence[Detail], grid: SdfGrid, points: Float[Tensor, "n 3"]) -> DetailSample:
    """Interpolate the details of all views at points on the surface, in the frame that the views share.

    Where several views see a point, it gets their mean, weighted as their materials are (reconstruct/render/joined.py):
    by facing^2 / footprint^2, and by the confidence, which falls to 0 towards outlines. So no seam is left.
    """
    parts = [_of_views(details, grid, part) for part in points.split(POINTS_AT_ONCE)]
    if not parts:
        return DetailSample(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0))
    return DetailSample(*(torch.cat([getattr(p, name) for p in parts]) for name in ("normals", "albedo", "confidence")))


def _of_views(details: Sequence[Detail], grid: SdfGrid, points: Float[Tensor, "n 3"]) -> DetailSample:
    found = [_of_view(detail, grid, points) for detail in details]
    if len(found) == 1:
        return found[0]
    normals, albedo, weights = torch.zeros_like(points), torch.zeros_like(points), torch.zeros(len(points), 1)
    for detail, one in zip(details, found, strict=True):
        offset = _eye(detail) - points
        away = torch.linalg.vector_norm(offset, dim=-1, keepdim=True)
        facing = ((one.normals * offset).sum(-1, keepdim=True) / away).clamp(min=LEAST_FACING)
        weight = one.confidence[:, None] * (facing * detail.posed_camera.camera.fx / away) ** 2
        normals, albedo, weights = normals + weight * one.normals, albedo + weight * one.albedo, weights + weight
    confidence = torch.stack([one.confidence for one in found]).amax(0) if found else torch.zeros(len(points))
    return DetailSample(normalize(normals, dim=-1), albedo / weights.clamp(min=NO_WEIGHT), confidence)


def _eye(detail: Detail) -> Float[Tensor, "3"]:
    """Return the camera's centre in the frame that all views share."""
    centre = detail.posed_camera.centre
    own = centre if detail.object_from_world is None else detail.object_from_world.apply(centre[None])[0]
    return torch.from_numpy(own).float()


def _of_view(detail: Detail, grid: SdfGrid, points: Float[Tensor, "n 3"]) -> DetailSample:
    """Interpolate one view's detail."""
    pixels, depth = detail.posed_camera.project_with_depth(detail.in_world(points.double().numpy()))
    u, v = pixels.T
    height, width = detail.confidence.shape
    inside = (depth > 0) & (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
    is_seen = torch.from_numpy(inside) & in_line_of_sight(grid, _eye(detail), points, SAME_VOXELS * grid.spacing)
    out = DetailSample(torch.zeros_like(points), torch.zeros_like(points), torch.zeros(len(points)))
    places = np.flatnonzero(is_seen.numpy())
    columns, rows = np.minimum(u[places].astype(int), width - 2), np.minimum(v[places].astype(int), height - 2)
    right, down = u[places] - columns, v[places] - rows
    total = np.zeros((len(places), 7))
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        share = (down if i else 1 - down) * (right if j else 1 - right)
        at = rows + i, columns + j
        sure = share * detail.confidence[at] / SURE
        total[:, :3] += sure[:, None] * detail.normals[at]
        total[:, 3:6] += sure[:, None] * detail.albedo[at]
        total[:, 6] += sure
    if detail.object_from_world is not None:
        total[:, :3] = total[:, :3] @ detail.object_from_world.rotation.T
    found = torch.from_numpy(total).float()
    out.normals[places] = normalize(found[:, :3], dim=-1)
    out.albedo[places] = found[:, 3:6] / found[:, 6:].clamp(min=1e-6)
    out.confidence[places] = found[:, 6]
    return out


def with_detail(view: RenderView, details: Sequence[Detail], camera: Camera) -> RenderView:
    """Return the view with finer normals and albedo where a camera of the capture saw the surface.

    Args:
        view: in the frame that all views share.
        details: where there are none, the view is returned unchanged.
        camera: of the view, at about the capture camera's distance.
    """
    if not details:
        return view
    details = [detail.reduced(detail.posed_camera.camera.fx / camera.fx) for detail in details]
    at = detail_at(details, view.grid, view.maps.points[view.maps.mask])
    share = at.confidence[:, None]
    normals, albedo = view.maps.normals.clone(), view.albedo.clone()
    normals[view.maps.mask] = normalize(torch.lerp(normals[view.maps.mask], at.normals, share), dim=-1)
    albedo[view.maps.mask] = torch.lerp(albedo[view.maps.mask], at.albedo, share)
    return replace(view, maps=replace(view.maps, normals=normals), albedo=albedo)


def specular_part(
    samples: Samples, normals: Float[Tensor, "n 3"], pixel_gloss: Gloss | None
) -> Float[Tensor, "n photos 3"]:
    """Return the specular part of every sample, linear, for unit world normals that may differ from the surface's."""
    if pixel_gloss is None:
        return torch.zeros(()).expand_as(samples.value)
    mirrored = specular(pixel_gloss.coefficients()[:, None], normals[:, None], samples.towards, samples.eye[:, None])
    cosine = (samples.towards @ normals[..., None]).clamp(min=0)
    return mirrored * cosine * samples.strength


def fit_detail(
    samples: Samples, albedo: Float[Tensor, " n"], noise: Noise, pixel_gloss: Gloss | None
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
    samples: Samples, normals: Float[Tensor, "n 3"], pixel_gloss: Gloss | None
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
