"""Interreflection in every photo of a solved scene, and the true albedo scale that its strength implies."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.optimize import least_squares
from torch import Tensor

from reconstruct.fields import SolvedScene
from reconstruct.render.g_buffer import SurfaceMaps, material_at, seen_material, surface_maps
from reconstruct.render.radiosity import Patches, find_patches, nearest_patches
from reconstruct.scene import Scene, irradiance
from reconstruct.sdf.rays import shadow_starts, unshadowed

FEWEST_SHADED = 500  # samples; fewer do not determine the interreflection
ENOUGH_PIXELS = 2000  # of the object, each seen in every photo
TURNED_AWAY = -0.1  # cosine to the light below which no error of a normal lets it shine
UNLIT = 0.01  # share of the light that arrives
LEAST = 0.05  # true albedo over the recovered one: smaller values come from errors of labels and shadow edges
MOST = 2.0
NEARLY_L1 = 0.1  # of the samples' median: residuals below it count squared
TINY = 1e-9


@dataclass(frozen=True)
class PhotoInterreflection:
    """Irradiance of all patches by interreflection in each photo, for the albedo in SolvedScene."""

    patches: Patches
    arriving: Float[Tensor, "photos patches 3"]

    def at(self, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> Float[Tensor, "photos n 3"]:
        """Return the same irradiance at world points of the surface."""
        between = nearest_patches(self.patches, points, normals)
        return torch.stack([between.interpolated(interreflection) for interreflection in self.arriving])


def photo_interreflection(fields: SolvedScene, scene: Scene) -> PhotoInterreflection | None:
    """Return the interreflection of a solved scene under the lights of its photos; None if there is no surface.

    A ground that is only assumed (not scene.ground_known) sends and receives nothing.
    """
    found = find_patches(fields.grid, scene.ground_height if scene.ground_known else None)
    if found is None:
        return None
    albedo, _ = material_at(seen_material(fields), found.points, found.on_object)
    towards, strength = irradiance(scene, found.points)
    share = (towards * found.normals).sum(-1).clamp(min=0) * unshadowed(fields.grid, found.starts, scene.lights)
    return PhotoInterreflection(found, torch.stack([found.bounced(albedo, e) for e in strength * share[..., None]]))


def true_scale(fields: SolvedScene, scene: Scene, interreflection: PhotoInterreflection) -> float:
    """Estimate true albedo / recovered albedo, which lights of unknown power leave undetermined.

    Object pixels that no light reaches show albedo * (ambient + scale * interreflection). The result is the scale of
    least absolute error; 0 if no interreflection is visible. Where no ground in shadow has told the ambient light, both
    are fitted; otherwise a lit room would pass for interreflection.
    """
    seen, albedo, expected = _shaded_samples(fields, scene, interreflection)
    if len(seen) < FEWEST_SHADED:
        return 0.0
    if scene.ground_known:
        ratio, order = (seen / expected).sort()
        running = expected[order].cumsum(0)
        scale = float(ratio[torch.searchsorted(running, running[-1:] / 2)])
    else:
        scale = _scale_beside_ambient(*(x.double().numpy() for x in (seen, albedo, expected)))
    return min(scale, MOST) if scale > LEAST else 0.0


def _scale_beside_ambient(
    seen: Float[np.ndarray, " n"], albedo: Float[np.ndarray, " n"], expected: Float[np.ndarray, " n"]
) -> float:
    """Return the scale of seen = scale * expected + ambient * albedo, both at least 0, by a robust fit."""
    model = np.stack([expected, albedo], -1)
    size, unit = model.mean(0) + TINY, float(np.median(np.abs(seen))) + TINY
    fit = least_squares(
        lambda c: (model / size) @ c - seen / unit, [0.5, 0.5], bounds=(0, np.inf), loss="soft_l1", f_scale=NEARLY_L1
    )
    return float(fit.x[0] * unit / size[0])


def _shaded_samples(
    fields: SolvedScene, scene: Scene, interreflection: PhotoInterreflection
) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"], Float[Tensor, " n"]]:
    """Return samples of the object that no light reaches, grey: seen less ambient, albedo, and what is expected."""
    assert scene.rgb is not None
    maps = surface_maps(fields.grid, fields.posed_camera)
    places = torch.nonzero(maps.mask)
    row, column = places[:: max(1, len(places) // ENOUGH_PIXELS)].unbind(1)
    albedo = fields.albedo[row, column]
    expected = (albedo * interreflection.at(maps.points[row, column], maps.normals[row, column])).mean(-1)
    seen = (scene.rgb[:, row, column] - albedo * scene.ambient).mean(-1)
    known = _shaded(fields, scene, maps, row, column) & scene.usable[:, row, column] & (expected > 0)
    return seen[known], albedo.mean(-1).expand_as(seen)[known], expected[known]


def _shaded(
    fields: SolvedScene, scene: Scene, maps: SurfaceMaps, row: Int[Tensor, " n"], column: Int[Tensor, " n"]
) -> Bool[Tensor, "photos n"]:
    """Find the object pixels that no light reaches, in each photo."""
    points, normals = maps.points[row, column], maps.normals[row, column]
    starts = shadow_starts(fields.grid, points, normals, torch.ones(len(points), dtype=torch.bool))
    towards, _ = irradiance(scene, points)
    away = (towards * normals).sum(-1) < TURNED_AWAY
    return away | (unshadowed(fields.grid, starts, scene.lights) < UNLIT)
