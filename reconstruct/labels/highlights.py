"""The object's material from its photos: remove highlights before estimating shape, then fit albedo and gloss."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from reconstruct.appearance.brdf import Gloss
from reconstruct.appearance.joint_fit import SharedMaterial, fit_material, fit_normals, with_gains
from reconstruct.appearance.lobe_fit import (
    ENOUGH_PIXELS,
    Indirect,
    Samples,
    fit_lobes,
    from_endless_ground,
    gather,
    highlights,
    least_squares_albedo,
    point_materials,
    usual_scale,
)
from reconstruct.labels.ground_test import GroundTest
from reconstruct.labels.photometric_stereo import ObjectLabels
from reconstruct.scene import Scene
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.rays import shadow_starts, unshadowed
from reconstruct.shading.noise import DEFAULT_NOISE

SURE_NORMAL = 0.5  # confidence: of the pixels that the lobes are learnt from
SURELY_LIT = 0.9  # of the light arrives: penumbras and shadow edges are left out
PIXELS_AT_ONCE, USUAL_PHOTOS = 16384, 40  # stay below 60 MB; of more photos, fewer pixels
JOINT_PIXELS = 1500  # that lobes, powers and normals are fitted to together
FEWEST_LIT = 3  # photos behind an albedo: with fewer, the albedo of the nearest known pixel is used


def material_without_ground(
    scene: Scene, points: Float[Tensor, "height width 3"], labels: ObjectLabels
) -> SharedMaterial | None:
    """Fit lobes and the power of each photo where no ground shows the light; None if the photos are too few.

    Args:
        points: world, the current surface.
        labels: from the unmodified photos: the normals to begin from.
    """
    row, column = torch.nonzero(labels.normal_confidence > SURE_NORMAL).unbind(1)
    step = max(1, len(row) // JOINT_PIXELS)
    samples = _open_samples(scene, points, labels, (row[::step], column[::step]))
    return fit_material(samples, DEFAULT_NOISE.sigma(samples.value.mean(-1).clamp(min=0)))


def with_powers(scene: Scene, material: SharedMaterial) -> Scene:
    """Return the scene with the powers that its photos show."""
    return replace(scene, power=scene.power * material.log_gains.exp()[:, None])


def matt_photos(
    scene: Scene, points: Float[Tensor, "height width 3"], labels: ObjectLabels, material: SharedMaterial
) -> Scene:
    """Remove the highlights of a known material, each with the pixel's normal that explains highlight and shading.

    Args:
        scene: with the stated powers; the result has those of the material.
        points, labels: as of material_without_ground.
    """
    assert scene.rgb is not None
    if not material.lobes.any():
        return with_powers(scene, material)
    rgb = scene.rgb.clone()
    for pixels in _blocks((labels.normals != 0).any(-1), len(rgb)):
        samples = with_gains(_open_samples(scene, points, labels, pixels), material.log_gains)
        noise = DEFAULT_NOISE.sigma(samples.value.mean(-1).clamp(min=0))
        samples = replace(samples, normals=fit_normals(samples, material.lobes, noise)[0])
        rgb[:, pixels[0], pixels[1]] -= highlights(samples, material.lobes).transpose(0, 1)
    return with_powers(replace(scene, rgb=rgb.clamp_(min=0)), material)


def _open_samples(
    scene: Scene, points: Float[Tensor, "height width 3"], labels: ObjectLabels, pixels: tuple[Tensor, Tensor]
) -> Samples:
    """Return the well exposed samples, shadowed ones and those turned from their light included."""
    nothing = from_endless_ground(torch.zeros(len(scene.lights)))
    lit = torch.ones(len(scene.lights), len(pixels[0]))
    samples = gather(scene, points[pixels], labels.normals[pixels], pixels, lit, nothing)
    return replace(samples, weight=scene.usable[:, pixels[0], pixels[1]].T.float())


def lit_pixels(
    scene: Scene,
    grid: SdfGrid,
    points: Float[Tensor, "height width 3"],
    normals: Float[Tensor, "height width 3"],
) -> Bool[Tensor, "photos n"]:
    """Return in which photos no shadow falls on each pixel that sees the surface (normal not 0), in their order."""
    parts = [torch.zeros(len(scene.lights), 0, dtype=torch.bool)]
    for pixels in _blocks((normals != 0).any(-1), len(scene.lights)):
        at = points[pixels]
        starts = shadow_starts(grid, at, normals[pixels], torch.ones(len(at), dtype=torch.bool))
        parts.append(unshadowed(grid, starts, scene.lights) > SURELY_LIT)
    return torch.cat(parts, 1)


def surface_appearance(
    scene: Scene,
    points: Float[Tensor, "height width 3"],
    normals: Float[Tensor, "height width 3"],
    lit: Bool[Tensor, "photos n"],
    indirect: Indirect,
) -> tuple[Float[Tensor, "height width 3"], Gloss | None]:
    """Estimate albedo and gloss of the pixels that see the surface (normal not 0), with its own normals and shadows.

    The same surface under the same lights then reproduces the photos. Gloss is None for matt objects.

    Args:
        lit: see lit_pixels.
    """
    where = (normals != 0).any(-1)
    row, column = torch.nonzero(where).unbind(1)

    def samples(pixels: tuple[Tensor, Tensor], reached: Bool[Tensor, "photos m"]) -> Samples:
        return gather(scene, points[pixels], normals[pixels], pixels, reached.float(), indirect)

    step = max(1, len(row) // ENOUGH_PIXELS)
    some = row[::step], column[::step]
    thinned = samples(some, lit[:, ::step])
    lobes = fit_lobes(thinned)
    usual = torch.zeros(where.shape)
    usual[where] = usual_scale(thinned, lobes, points[some], points[where])
    albedo, scale, known = torch.zeros_like(points), torch.zeros(where.shape), torch.zeros_like(where)
    done = 0
    for pixels in _blocks(where, len(scene.lights)):
        own = samples(pixels, lit[:, done : done + len(pixels[0])])
        done += len(pixels[0])
        albedo[pixels], scale[pixels] = point_materials(own, lobes, usual[pixels])
        known[pixels] = own.weight.sum(1) >= FEWEST_LIT
    albedo, scale = _filled(albedo, known, where), _filled(scale[..., None], known, where)
    return albedo, Gloss(lobes.coefficients[None], scale) if lobes.coefficients.any() else None


def with_lit_ground(
    scene: Scene,
    ground: GroundTest,
    grid: SdfGrid,
    points: Float[Tensor, "height width 3"],
    normals: Float[Tensor, "height width 3"],
    albedo: Float[Tensor, "height width 3"],
) -> Float[Tensor, "height width 3"]:
    """Return the albedo with that of ground in which the ground test found no lit sample, such as edges of print.

    It is fitted to the photos whose light reaches the place past the surface. Where none does, and beyond the ground's
    end, the albedo stays 0.

    Args:
        points, normals: what each pixel sees, world; normal 0 on the ground.
    """
    if not scene.ground_known:
        return albedo
    where = (albedo == 0).all(-1) & (normals == 0).all(-1) & points.isfinite().all(-1)
    if ground.background is not None:
        where &= ~ground.background
    out, no_light = albedo.clone(), from_endless_ground(torch.zeros(len(scene.lights)))
    for pixels in _blocks(where, len(scene.lights)):
        at = points[pixels]
        up = torch.tensor([0.0, 0.0, 1.0]).expand_as(at)
        lit = unshadowed(grid, at, scene.lights) > SURELY_LIT
        part = gather(scene, at, up, pixels, lit.float(), no_light)
        arriving = part.strength * part.towards[..., 2:] + part.indirect
        out[pixels] = least_squares_albedo(part.value, arriving, part.weight)
    return out


def _blocks(where: Bool[Tensor, "height width"], photos: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield rows and columns of the set pixels, in blocks."""
    for part in torch.nonzero(where).split(max(1, PIXELS_AT_ONCE * USUAL_PHOTOS // max(USUAL_PHOTOS, photos))):
        row, column = part.unbind(1)
        yield row, column


def _filled(
    image: Float[Tensor, "height width channels"],
    known: Bool[Tensor, "height width"],
    where: Bool[Tensor, "height width"],
) -> Float[Tensor, "height width channels"]:
    """Fill the wanted unknown pixels of an image from the nearest known pixel."""
    if not known.any():
        return image
    nearest = distance_transform_edt(~known.numpy(), return_distances=False, return_indices=True)
    assert isinstance(nearest, np.ndarray)
    row, column = torch.from_numpy(nearest).long()
    return torch.where((where & ~known)[..., None], image[row, column], image)
