"""Evidence for each vertex of a mesh: seen, constrained by shadows, or unconstrained."""

from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage
from scipy.spatial import KDTree

from reconstruct.fields import SolvedScene
from reconstruct.render.g_buffer import in_cells
from reconstruct.sdf.rays import in_line_of_sight
from reconstruct.solve.ray_counts import FEWEST_RAYS

UNCONSTRAINED, SHADOW, SEEN = 0, 1, 2  # values of a vertex's `evidence`
KINDS = ("unconstrained", "shadow", "seen")
PIXELS_INSIDE = 0.1  # sigma of a constrained surface in pixel footprints, far from what is not constrained
PIXELS_BESIDE = 0.3  # the same beside an unconstrained part, where less of the surroundings holds it
PIXELS_AT_GROUND = 1.3  # the same at the ground, where shadows begin and all light is grazing
REACH = 0.1  # of the object's diagonal: how far from there these two fade by e
DRIFT = 0.25  # growth of sigma per distance from constrained surface, beyond which it is extrapolated as a plate
CELL = 0.05  # of that reach: side of the cells that a distance is told of as a whole where it need not be exact
NO_LONGER = 7.0  # times that reach: what is left of either is below a thousandth
GUESS_COHERENCE = 0.4  # of what guessed parts add to the volume if all were off to one side
SHEARED = 0.8  # of the lights' uncertainty as a share of their distance: growth with height of a shear along the sight
ACROSS = 0.5  # of that shear across a surface that may face any way: the mean |cosine| of its normal to the sight
SEEN_WITHIN = 2.0  # voxels from a vertex to the first intersection of its camera ray with the surface


@dataclass(frozen=True)
class VertexEvidence:
    """Per vertex: UNCONSTRAINED, SHADOW or SEEN, and one sigma of its distance from the true surface, world length."""

    kind: UInt8[np.ndarray, " n"]
    sigma: Float[np.ndarray, " n"]
    lean: Float[np.ndarray, " n"]  # the part of sigma that all vertices share: what lights do that are off together


def vertex_evidence(fields: SolvedScene, vertices: Float[np.ndarray, "n 3"]) -> VertexEvidence | None:
    """Return the evidence for each vertex of a solved scene's surface; None if the solve stored no ray counts.

    sigma^2 = f^2 (0.1^2 + (0.3 exp(-B / R))^2 + (1.3 exp(-h / R))^2) + (0.25 D)^2 + (0.8 c s h)^2 with

    f: a pixel's footprint, that of the closest camera that sees the vertex, if one does
    B: the distance to the nearest vertex that nothing constrains; h: the height above the ground
    R: a tenth of the object's diagonal
    D: the distance to the nearest vertex that a camera sees or shadows constrain
    s: one sigma of a light's place over its distance (`SolvedScene.light_share`)
    c: |cosine| between the normal and the line of sight, at least 0.5, where a camera sees the vertex; elsewhere 0.5

    The last term, `lean`, is what lights do that are off together, which calibrated ones mostly are: an object sheared
    along the line of sight explains their shadows then (Belhumeur, Kriegman, Yuille, The bas-relief ambiguity, 1999).
    That moves a surface across itself the more it faces the camera; 0.5 is the mean over all directions. The numbers
    were chosen on six solves of rendered captures (benchmarks/run_sigma.py). The scale of the
    printed board is not included.

    Args:
        vertices: world.
    """
    if fields.evidence is None or not len(vertices):
        return None
    grid = fields.grid
    sights, footprints, facing = [], [], []
    normals = torch.nn.functional.normalize(grid.gradient(torch.from_numpy(vertices).float()), dim=1)
    for view in fields.views():
        eye, own = torch.from_numpy(view.posed_camera.centre).float(), view.in_world(vertices)
        away = torch.from_numpy(vertices - view.in_common(view.posed_camera.centre[None])).float()
        facing.append(((away * normals).sum(1) / away.norm(dim=1)).abs().double().numpy())
        points = torch.from_numpy(own).float()
        in_sight = in_line_of_sight(view.grid, eye, points, SEEN_WITHIN * grid.spacing).numpy()
        u, v = view.posed_camera.project(own).T
        last = view.camera.width - 1, view.camera.height - 1
        sights.append(in_sight & (np.abs(u / last[0] - 0.5) <= 0.5) & (np.abs(v / last[1] - 0.5) <= 0.5))
        footprints.append((points - eye).norm(dim=1).double().numpy() / view.camera.fx)
    seen, nearest = np.any(sights, axis=0), np.min(footprints, axis=0)
    footprint = np.where(seen, np.where(sights, footprints, np.inf).min(axis=0), nearest)
    place = (vertices - grid.origin.double().numpy()) / grid.spacing
    count = ndimage.map_coordinates(fields.evidence.float().numpy(), place.T, order=1, mode="nearest")
    kind = np.where(seen, SEEN, np.where(count >= FEWEST_RAYS, SHADOW, UNCONSTRAINED)).astype(np.uint8)
    height = np.maximum(vertices[:, 2] - fields.ground_height, 0.0)
    across = np.maximum(np.where(sights, facing, 0.0).max(axis=0), ACROSS)
    lean = SHEARED * across * fields.light_share * height
    sigma = np.hypot(_sigma(vertices, height, kind, footprint), lean)
    return VertexEvidence(kind, sigma.astype(np.float32), lean.astype(np.float32))


def volume_sigma(mesh: trimesh.Trimesh) -> float | None:
    """Return one sigma of the volume that a mesh encloses, cubed world length; None if its vertices say none.

    With A a vertex's share of the area, sigma^2 is the sum over the three kinds of evidence of (c sum A sigma)^2: what
    is seen and what shadows hold is off to one side together (c = 1), guessed parts partly to either (c = 0.4, measured
    on ten solves of rendered captures, benchmarks/run_sigma.py).
    """
    known = mesh.vertex_attributes
    if "evidence" not in known or "sigma" not in known:
        return None
    area = np.bincount(mesh.faces.ravel(), np.repeat(mesh.area_faces / 3, 3), len(mesh.vertices))
    kinds = np.asarray(known["evidence"]).ravel()
    moved = np.bincount(kinds, area * np.asarray(known["sigma"]).ravel(), len(KINDS))
    sigma = float(np.linalg.norm([GUESS_COHERENCE * moved[UNCONSTRAINED], moved[SHADOW], moved[SEEN]]))
    return sigma if np.isfinite(sigma) else None


def _sigma(
    vertices: Float[np.ndarray, "n 3"],
    height: Float[np.ndarray, " n"],
    kind: UInt8[np.ndarray, " n"],
    footprint: Float[np.ndarray, " n"],
) -> Float[np.ndarray, " n"]:
    """Return the terms of sigma that do not come from the lights."""
    is_held = kind != UNCONSTRAINED
    reach = max(REACH * float(np.linalg.norm(np.ptp(vertices, axis=0))), float(footprint.min()))
    at_ground = PIXELS_AT_GROUND * np.exp(-height / reach)
    beside = PIXELS_BESIDE * np.exp(-_distance_by_cells(~is_held, vertices, CELL * reach, NO_LONGER * reach) / reach)
    held = footprint * np.sqrt(PIXELS_INSIDE**2 + beside**2 + at_ground**2)
    return np.hypot(held, DRIFT * _distance_to(is_held, vertices))


def _distance_to(
    chosen: Bool[np.ndarray, " n"], vertices: Float[np.ndarray, "n 3"], farthest: float = np.inf
) -> Float[np.ndarray, " n"]:
    """Return each vertex's distance to the nearest chosen one; inf if there is none as near as `farthest`."""
    distance = np.where(chosen, 0.0, np.inf)
    if chosen.any() and not chosen.all():
        # Of 150,000 vertices far from 120,000 others, a balanced tree of tight nodes asks eight times as long.
        tree = KDTree(vertices[chosen], balanced_tree=False, compact_nodes=False)
        distance[~chosen] = tree.query(vertices[~chosen], distance_upper_bound=farthest, workers=-1)[0]
    return distance


def _distance_by_cells(
    chosen: Bool[np.ndarray, " n"], vertices: Float[np.ndarray, "n 3"], side: float, farthest: float
) -> Float[np.ndarray, " n"]:
    """Return the same, between the means of the vertices in cells of this side; 0 in cells of chosen ones.

    Of a relief's front before its flat back, all about as far away, each vertex by itself took 25 times as long.
    """
    cell, means = in_cells(vertices, side)
    is_chosen = np.zeros(len(means), bool)
    is_chosen[cell[chosen]] = True
    return _distance_to(is_chosen, means, farthest)[cell]
