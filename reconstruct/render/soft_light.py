"""Light from all sides: of a sky, and of what a lamp's light lights in turn, at points of a solved scene.

A page's lamp moves, and a browser casts no rays. So this light is computed once, for lamps from everywhere, and kept as
eight numbers a point [Sloan, Kautz and Snyder 2002, Precomputed radiance transfer], the bounce as the four first
spherical harmonics of the lamp's direction.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
import trimesh
from jaxtyping import Float
from scipy.sparse import csr_array
from torch import Tensor

from reconstruct.fields import SolvedScene
from reconstruct.render.g_buffer import SeenMaterial, material_at
from reconstruct.render.radiosity import Patches, find_patches, nearest_patches
from reconstruct.render.receivers import Receivers, across, disc
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.rays import find_surface, shadow_starts

RAYS = 64  # of a point: each stands for 1/64 of the light on it; its neighbours' means take the grain away
LAMPS = 48  # directions over the hemisphere that four numbers are fitted to
GROUND_SIDE = 128  # points along a square of ground
SKY_BOUNCE = 12 / 7  # the overcast sky's radiance over all its directions, where open level ground receives 1
SMOOTHINGS = 3  # means over a vertex and its neighbours
LEVEL_SKY = 7 / 9  # irradiance of open level ground over pi times the zenith's radiance, under the overcast sky


@dataclass(frozen=True)
class SoftLight:
    """What arrives at points besides a lamp's own light. World frame."""

    sky: Float[Tensor, " n"]  # irradiance under an overcast sky, over that of open level ground
    bounce: Float[Tensor, "n 4"]  # b: a far lamp towards d, of irradiance 1, adds max(0, b . (1, d)) by one bounce
    tint: Float[Tensor, "n 3"]  # of what bounces; the largest channel is 1
    below: Float[Tensor, " n"] | None = None  # as `sky`, of a sky below the object without any ground

    def arriving(self, lamp: Float[Tensor, "3"], lamp_strength: float, sky_strength: float) -> Float[Tensor, "n 3"]:
        """Return the irradiance of the points.

        Args:
            lamp: unit vector towards it.
            lamp_strength: its irradiance on what faces it.
            sky_strength: irradiance of open level ground under the sky.
        """
        direct = self.bounce @ torch.cat([torch.ones(1), lamp])
        of_sky = SKY_BOUNCE * self.bounce[:, 0] + self.bounce[:, 3]
        bounced = lamp_strength * direct.clamp(min=0) + sky_strength * of_sky.clamp(min=0)
        return sky_strength * self.sky[:, None] + bounced[:, None] * self.tint


def soft_light(
    material: SeenMaterial, mesh: trimesh.Trimesh, normals: Float[Tensor, "n 3"], has_below: bool = False
) -> SoftLight:
    """Return the soft light at the vertices of a scene's mesh, above its ground.

    Args:
        normals: of the vertices, unit, outward.
        has_below: whether it is seen from below, too.
    """
    points, grid = torch.from_numpy(np.asarray(mesh.vertices)).float(), material.fields.grid
    mean = _NeighbourMeans(mesh)
    sky = mean(sky_share(grid, points, normals, on_object=True))
    below = mean(sky_share(grid, points, normals, on_object=True, up=-1.0)) if has_below else None
    patches, albedo = material.patches or _patches(material)
    if patches is None:
        return SoftLight(sky, torch.zeros(len(points), 4), torch.ones(len(points), 3), below)
    sent, usual = _sent_on(patches, grid)
    per_channel = torch.stack(
        [patches.bounced(albedo, sent[:, k, None].expand(-1, 3)) for k in range(4)], 1
    )  # patches, 4, RGB
    between = nearest_patches(patches, points, normals)
    at = mean(torch.stack([between.interpolated(per_channel[:, k]) for k in range(4)], 1))
    tint = torch.einsum("nkc,k->nc", at, usual).clamp(min=0)  # of the mean over all lamps
    largest = tint.amax(-1, keepdim=True)
    tint = torch.where(largest > 0, tint / largest.clamp(min=1e-9), 1.0)
    weight = tint / (tint * tint).sum(-1, keepdim=True)  # least squares of channel = tint * b
    return SoftLight(sky, (at * weight[:, None]).sum(-1), tint, below)


def overcast(up: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Return a sky's radiance times pi, by the sine of its elevation, where open level ground receives 1.

    The zenith is three times as bright as the horizon [Moon and Spencer 1942; CIE standard overcast sky].
    """
    return (1 + 2 * up) / 3 / LEVEL_SKY * (up > 0)


def sky_share(
    grid: SdfGrid, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], on_object: bool, up: float = 1.0
) -> Float[Tensor, " n"]:
    """Return the overcast sky's irradiance at points above an endless ground, over that of open level ground.

    Args:
        on_object: else they lie on the ground.
        up: -1: the sky is below.
    """
    is_object = torch.full((len(points),), on_object)
    starts = shadow_starts(grid, points, normals, is_object)
    one, other = across(normals, points / grid.spacing)
    out = torch.zeros(len(points))
    for x, y in disc(RAYS):
        towards = x * one + y * other + (1 - x * x - y * y) ** 0.5 * normals
        light = overcast(up * towards[:, 2])
        asked = torch.nonzero(light > 0)[:, 0]
        is_open = torch.isinf(find_surface(grid, starts[asked], towards[asked]))
        out[asked] += light[asked] * is_open / RAYS
    return out


class _NeighbourMeans:
    """Takes SMOOTHINGS means over each vertex of a mesh and its neighbours."""

    def __init__(self, mesh: trimesh.Trimesh):
        n, ends = len(mesh.vertices), np.concatenate([mesh.edges_unique, mesh.edges_unique[:, ::-1]])
        ends = np.concatenate([ends, np.arange(n).repeat(2).reshape(-1, 2)])
        share = 1 / np.bincount(ends[:, 0], minlength=n).astype(np.float32)
        self._once = csr_array((share[ends[:, 0]], tuple(ends.T)), (n, n))

    def __call__(self, values: Float[Tensor, " n *more"]) -> Float[Tensor, " n *more"]:
        flat = values.reshape(len(values), -1).numpy()
        for _ in range(SMOOTHINGS):
            flat = self._once @ flat
        return torch.from_numpy(np.ascontiguousarray(flat, np.float32)).reshape(values.shape)


def ground_sky(fields: SolvedScene, centre: Float[np.ndarray, "3"], half: float) -> Float[np.ndarray, "side side"]:
    """Return `sky_share` of the ground on a square around `centre`, world; rows along +y, columns along +x.

    Args:
        half: of the square's side, world length.
    """
    steps = torch.linspace(-half, half, GROUND_SIDE)
    y, x = torch.meshgrid(steps + float(centre[1]), steps + float(centre[0]), indexing="ij")
    points = torch.stack([x, y, torch.full_like(x, fields.ground_height)], -1).reshape(-1, 3)
    up = torch.tensor([0.0, 0.0, 1.0]).expand_as(points)
    share = sky_share(fields.grid, points, up, on_object=False).reshape(GROUND_SIDE, GROUND_SIDE).numpy()
    share[-1], share[0], share[:, -1], share[:, 0] = (1.0,) * 4  # beyond it lies open ground
    return cv2.blur(share, (3, 3))


def _patches(material: SeenMaterial) -> tuple[Patches | None, Float[Tensor, "patches 3"]]:
    """Return the scene's patches with the albedo as it was found, where photos did not tell its scale."""
    found = find_patches(material.fields.grid, material.fields.ground_height)
    if found is None:
        return None, torch.zeros(0, 3)
    return found, material_at(material, found.points, found.on_object)[0]


def _sent_on(patches: Patches, grid: SdfGrid) -> tuple[Float[Tensor, "patches 4"], Float[Tensor, "4"]]:
    """Return each patch's own irradiance under far lamps as b . (1, d), by least squares; and the mean of (1, d)."""
    flat = torch.tensor(disc(LAMPS))
    lamps = torch.cat([flat, (1 - flat.square().sum(-1, keepdim=True)).sqrt()], 1)
    arriving = Receivers(grid, patches.points, patches.normals, patches.starts).from_afar(lamps)
    basis = torch.cat([torch.ones(LAMPS, 1), lamps], 1)
    return torch.linalg.lstsq(basis, arriving).solution.T, basis.mean(0)
