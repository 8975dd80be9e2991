"""Interreflection in every photo of a solved scene, and the true albedo scale that its strength implies."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from reconstruct.fields import Fields
from reconstruct.render.g_buffer import SurfaceMaps, albedo_at, seen_material, surface_maps
from reconstruct.render.radiosity import Patches, find_patches, nearest_patches
from reconstruct.scene import Scene, irradiance
from reconstruct.sdf.shadow_rays import shadow_starts, unshadowed

FEWEST_SHADED = 500  # samples; fewer do not determine the interreflection
ENOUGH_PIXELS = 2000  # of the object, each seen in every photo
TURNED_AWAY = -0.1  # cosine to the light below which no error of a normal lets it shine
UNLIT = 0.01  # share of the light that arrives
LEAST = 0.05  # true albedo over the recovered one: smaller values come from errors of labels and shadow edges
MOST = 2.0


@dataclass(frozen=True)
class PhotoInterreflection:
    """Irradiance of all patches by interreflection in each photo, for the albedo in Fields."""

    patches: Patches
    arriving: Float[Tensor, "photos patches 3"]

    def at(self, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> Float[Tensor, "photos n 3"]:
        """Return the same irradiance at world points of the surface."""
        between = nearest_patches(self.patches, points, normals)
        return torch.stack([between.interpolated(interreflection) for interreflection in self.arriving])


def photo_interreflection(fields: Fields, scene: Scene) -> PhotoInterreflection | None:
    """Return the interreflection of a solved scene under the lights of its photos; None if there is no surface.

    A ground that is only assumed (not scene.ground_known) sends and receives nothing.
    """
    found = find_patches(fields.grid, scene.ground_height if scene.ground_known else None)
    if found is None:
        return None
    albedo = albedo_at(fields, seen_material(fields), found.points, found.on_object)
    towards, strength = irradiance(scene, found.points)
    share = (towards * found.normals).sum(-1).clamp(min=0) * unshadowed(fields.grid, found.starts, scene.lights)
    return PhotoInterreflection(found, torch.stack([found.bounced(albedo, e) for e in strength * share[..., None]]))


def true_scale(fields: Fields, scene: Scene, interreflection: PhotoInterreflection) -> float:
    """Estimate true albedo / recovered albedo, which lights of unknown power leave undetermined.

    Object pixels that no light reaches show albedo * (ambient + scale * interreflection). The result is the scale of
    least absolute error; 0 if no interreflection is visible.
    """
    assert scene.rgb is not None
    maps = surface_maps(fields.grid, fields.posed_camera)
    places = torch.nonzero(maps.mask)
    row, column = places[:: max(1, len(places) // ENOUGH_PIXELS)].unbind(1)
    albedo = fields.albedo[row, column]
    expected = (albedo * interreflection.at(maps.points[row, column], maps.normals[row, column])).mean(-1)
    seen = (scene.rgb[:, row, column] - albedo * scene.ambient).mean(-1)
    known = _shaded(fields, scene, maps, row, column) & scene.usable[:, row, column] & (expected > 0)
    if int(known.sum()) < FEWEST_SHADED:
        return 0.0
    ratio, order = (seen[known] / expected[known]).sort()
    running = expected[known][order].cumsum(0)
    median = float(ratio[torch.searchsorted(running, running[-1:] / 2)])
    return min(median, MOST) if median > LEAST else 0.0


def _shaded(
    fields: Fields, scene: Scene, maps: SurfaceMaps, row: Int[Tensor, " n"], column: Int[Tensor, " n"]
) -> Bool[Tensor, "photos n"]:
    """Find the object pixels that no light reaches, in each photo."""
    points, normals = maps.points[row, column], maps.normals[row, column]
    starts = shadow_starts(fields.grid, points, normals, torch.ones(len(points), dtype=torch.bool))
    towards, _ = irradiance(scene, points)
    away = (towards * normals).sum(-1) < TURNED_AWAY
    return away | (unshadowed(fields.grid, starts, scene.lights) < UNLIT)
