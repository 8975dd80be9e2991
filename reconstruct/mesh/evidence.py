"""Evidence for each vertex of a mesh: seen, constrained by shadows, or unconstrained."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage
from scipy.spatial import KDTree

from reconstruct.fields import Fields
from reconstruct.sdf.rays import in_line_of_sight
from reconstruct.solve.ray_counts import FEWEST_RAYS

UNCONSTRAINED, SHADOW, SEEN = 0, 1, 2  # values of a vertex's `evidence`
KINDS = ("unconstrained", "shadow", "seen")
EDGE_SIGMA = 0.3  # sigma of a constrained surface in pixel footprints; silhouettes are accurate to a third of a pixel
DRIFT = 0.5  # growth of sigma per distance from constrained surface, beyond which it is extrapolated as a plate
SEEN_WITHIN = 2.0  # voxels from a vertex to the first intersection of its camera ray with the surface


@dataclass(frozen=True)
class VertexEvidence:
    """Per vertex: UNCONSTRAINED, SHADOW or SEEN, and one sigma of its distance from the true surface, world length."""

    kind: UInt8[np.ndarray, " n"]
    sigma: Float[np.ndarray, " n"]


def vertex_evidence(fields: Fields, vertices: Float[np.ndarray, "n 3"]) -> VertexEvidence | None:
    """Return the evidence for each vertex of a solved scene's surface; None if the solve stored no ray counts.

    sigma^2 = (EDGE_SIGMA * pixel footprint)^2 + (DRIFT * D)^2, with D the distance to the nearest vertex that a
    camera sees or shadows constrain, and the footprint that of the closest camera that sees the vertex, if one does.
    EDGE_SIGMA and DRIFT were measured on two known scenes.

    Args:
        vertices: world.
    """
    if fields.evidence is None or not len(vertices):
        return None
    grid = fields.grid
    sights, footprints = [], []
    for view in fields.views():
        eye, own = torch.from_numpy(view.posed_camera.centre).float(), view.in_world(vertices)
        points = torch.from_numpy(own).float()
        in_sight = in_line_of_sight(view.grid, eye, points, SEEN_WITHIN * grid.spacing).numpy()
        sights.append(in_sight & _in_picture(view, own))
        footprints.append((points - eye).norm(dim=1).double().numpy() / view.camera.fx)
    seen, nearest = np.any(sights, axis=0), np.min(footprints, axis=0)
    footprint = np.where(seen, np.where(sights, footprints, np.inf).min(axis=0), nearest)
    place = (vertices - grid.origin.double().numpy()) / grid.spacing
    count = ndimage.map_coordinates(fields.evidence.float().numpy(), place.T, order=1, mode="nearest")
    kind = np.where(seen, SEEN, np.where(count >= FEWEST_RAYS, SHADOW, UNCONSTRAINED)).astype(np.uint8)
    held = kind != UNCONSTRAINED
    drift = KDTree(vertices[held]).query(vertices)[0] if held.any() else np.full(len(vertices), np.inf)
    return VertexEvidence(kind, np.hypot(EDGE_SIGMA * footprint, DRIFT * drift).astype(np.float32))


def _in_picture(fields: Fields, vertices: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    u, v = fields.posed_camera.project(vertices).T
    return (np.abs(u / (fields.camera.width - 1) - 0.5) <= 0.5) & (np.abs(v / (fields.camera.height - 1) - 0.5) <= 0.5)
