"""What holds each place of a solved surface: it is seen, or shadows alone hold it, or nothing; and how well."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage
from scipy.spatial import KDTree
from torch import Tensor

from reconstruct.config import FitConfig
from reconstruct.fields import Fields
from reconstruct.labels.supervision import Supervision
from reconstruct.scene import Scene
from reconstruct.sdf import kernels
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.level_set import LevelSet
from reconstruct.sdf.rays import find_surface
from reconstruct.solve.kernel_passes import KernelPasses

UNCONSTRAINED, SHADOW, SEEN = 0, 1, 2  # what a vertex's `evidence` says
KINDS = ("unconstrained", "shadow", "seen")
FEWEST_RAYS = 0.05  # per node, from which shadows hold it: with fewer the error begins to grow
EDGE_SIGMA = 0.3  # pixel footprints: of a surface that rays hold; a third of a pixel is what silhouettes reach
DRIFT = 0.5  # growth of sigma per length away from surface that is held: it is continued by a plate, which is a guess
LOOKS = 4  # batches of rays that are counted: every label once or more at the usual ray number
SHARPNESS = 8.0  # NeuS s per voxel: a ray counts where it passes within about a quarter of a voxel
SPREAD = 1.0  # voxels: a node's count is the mean about it, as wide as the solver's averaging
SEEN_WITHIN = 2.0  # voxels between a vertex and where its camera ray first meets the surface


def ray_counts(scene: Scene, rays: Supervision, grid: SdfGrid, config: FitConfig) -> Float[Tensor, "nx ny nz"]:
    """For every node near the surface, the weight of shadow and camera rays whose edge passes there.

    The count c of the level set's step, at rest: shadow rays well inside or outside a shadow do not add to it. It is
    scaled to what it would be if every label were one ray.
    """
    phi = np.ascontiguousarray((grid.values / grid.spacing).numpy(), np.float32)
    surface = LevelSet(phi, grid.origin.double().numpy(), grid.spacing, is_distance=True)
    shoot = KernelPasses(surface, scene, rays, config)
    first = sum(level.iterations for level in config.levels)
    for i in range(LOOKS):
        shoot(first + i, SHARPNESS)
    count = surface.sums()[1]
    labels = float((rays.confidence > kernels.NO_WEIGHT).sum())
    count *= np.float32(labels / (LOOKS * shoot.n_rays))
    return torch.from_numpy(ndimage.gaussian_filter(count, SPREAD))


@dataclass(frozen=True)
class VertexEvidence:
    """Per vertex: UNCONSTRAINED, SHADOW or SEEN, and one sigma of its distance from the true surface, world length."""

    kind: UInt8[np.ndarray, "n"]
    sigma: Float[np.ndarray, "n"]


def vertex_evidence(fields: Fields, vertices: Float[np.ndarray, "n 3"]) -> VertexEvidence | None:
    """What holds each vertex of a solved scene's surface; None where the solve left no ray counts.

    sigma^2 = (EDGE_SIGMA * pixel footprint)^2 + (DRIFT * D)^2, D the distance to the nearest vertex that the camera
    sees or that shadows hold. EDGE_SIGMA and DRIFT were measured on two known scenes.

    Args:
        vertices: world.
    """
    if fields.evidence is None or not len(vertices):
        return None
    grid, eye = fields.grid, torch.from_numpy(fields.world_from_camera.translation).float()
    away = torch.from_numpy(vertices).float() - eye
    distance = away.norm(dim=1)
    first = find_surface(grid, eye.expand_as(away).contiguous(), (away / distance[:, None]).contiguous())
    seen = ((first - distance).abs() < SEEN_WITHIN * grid.spacing).numpy() & _in_picture(fields, vertices)
    place = (vertices - grid.origin.double().numpy()) / grid.spacing
    count = ndimage.map_coordinates(fields.evidence.float().numpy(), place.T, order=1, mode="nearest")
    kind = np.where(seen, SEEN, np.where(count >= FEWEST_RAYS, SHADOW, UNCONSTRAINED)).astype(np.uint8)
    held = kind != UNCONSTRAINED
    drift = KDTree(vertices[held]).query(vertices)[0] if held.any() else np.full(len(vertices), np.inf)
    footprint = distance.double().numpy() / fields.camera.fx
    return VertexEvidence(kind, np.hypot(EDGE_SIGMA * footprint, DRIFT * drift).astype(np.float32))


def _in_picture(fields: Fields, vertices: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    u, v = fields.camera.project(fields.world_from_camera.inverse().apply(vertices)).T
    return (np.abs(u / (fields.camera.width - 1) - 0.5) <= 0.5) & (np.abs(v / (fields.camera.height - 1) - 0.5) <= 0.5)
