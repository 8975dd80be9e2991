"""Move the vertices of a mesh of marching cubes a little, so that its triangles face as the distance function says.

Marching cubes puts each vertex on an edge of the grid, where the distances of two nodes alone decide its place. The
triangles between them face several degrees away from the surface they stand for. Here each vertex is moved towards the
planes of its triangles, each with the normal of the distance function [Sun, Rosin, Martin, Langbein 2007, Fast and
Effective Feature-Preserving Mesh Denoising, equation 11]. There, planes go through the triangles' centres, which lie
inside of where the surface is convex, so thin parts became thinner. Tangential planes of the surface would make them
thicker. Half-way between the two, they keep their size. Triangles stay the same.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_matrix

from reconstruct.sdf.grid import SdfGrid

STEPS = 16  # with MOMENTUM they do what 60 do without; more change normals by less than .02 degrees
MOMENTUM = 0.8  # share of a move that the next one repeats [Polyak 1964, heavy ball]
APART = 1.0  # voxels from a triangle to where its normal's differences are taken: shorter ones see single nodes' errors
FARTHEST = 0.25  # voxels that a vertex may move: cells of the grid keep their sides
SMOOTH = 0.85  # length of the gradient; below, faces meet at more than some 60 degrees: an edge, which stays as it is
MOST_ROUNDS = 20  # of taking moves back that turn a triangle over
AGREES = 0.2  # cosine between the triangle's own normal and the distance function's, below which its own is kept


def faced(
    grid: SdfGrid,
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "m 3"],
    fixed: Bool[np.ndarray, " n"],
) -> Float[np.ndarray, "n 3"]:
    """Return the vertices after STEPS moves v += m, m = mean over triangles of n n . (c - n d / 2 - v) + MOMENTUM m.

    World length. n is the triangle's wanted normal, c its centre, d the signed distance there. Normals and distances
    are taken once, at the centres at the start; d then changes as n . c does.

    Args:
        fixed: vertices that stay.
    """
    wanted, is_smooth = _normals(grid, vertices[faces])
    centres = _centres(vertices, faces)
    tangent = (wanted * centres).sum(1) - grid.sdf(torch.from_numpy(centres).float()).double().numpy()
    corners, triangles = faces.ravel(), np.repeat(np.arange(len(faces)), 3)
    around = csr_matrix((np.ones(len(corners)), (corners, triangles)), (len(vertices), len(faces)))
    share = 1 / np.maximum(np.asarray(around.sum(1)), 1)
    planes = (around @ (wanted[:, :, None] * wanted[:, None, :]).reshape(-1, 9)).reshape(-1, 3, 3)
    fixed = fixed | ~_inside(grid, vertices)
    fixed[faces[~is_smooth]] = True
    moved, last = vertices.copy(), np.zeros_like(vertices)
    for _ in range(STEPS):
        level = (np.einsum("mi,mi->m", wanted, _centres(moved, faces)) + tangent) / 2
        towards = around @ (wanted * level[:, None])
        step = share * (towards - np.einsum("nij,nj->ni", planes, moved))
        last = np.where(fixed[:, None], 0.0, step + MOMENTUM * last)
        moved += last
    way = moved - vertices
    length = np.linalg.norm(way, axis=1, keepdims=True)
    way *= np.minimum(1, FARTHEST * grid.spacing / np.maximum(length, 1e-12))
    return vertices + _without_folds(vertices, faces, way)


def _centres(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 3"]:
    return (vertices[faces[:, 0]] + vertices[faces[:, 1]] + vertices[faces[:, 2]]) / 3


def _without_folds(
    vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"], way: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Return the moves without those of vertices whose triangles would turn over."""
    before = across(vertices[faces])
    kept = way.copy()
    for _ in range(MOST_ROUNDS):
        folded = (across((vertices + kept)[faces]) * before).sum(1) <= 0
        if not (folded & kept[faces].any((1, 2))).any():
            break
        kept[faces[folded]] = 0
    return kept


def across(triangles: Float[np.ndarray, "m 3 3"]) -> Float[np.ndarray, "m 3"]:
    """Return the triangles' own normals, outward, twice their area long."""
    return np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])


def _inside(grid: SdfGrid, vertices: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Find the vertices around which the grid knows the distances on all sides."""
    place = (vertices - grid.origin.double().numpy()) / grid.spacing
    most = np.array(grid.values.shape) - 1 - 2 * APART
    return np.asarray(((place > 2 * APART) & (place < most)).all(1))


def _normals(
    grid: SdfGrid, triangles: Float[np.ndarray, "m 3 3"]
) -> tuple[Float[np.ndarray, "m 3"], Bool[np.ndarray, " m"]]:
    """Return the unit normals of the distance function at the centres, and where it is smooth.

    The triangles' own normals where they disagree.
    """
    wanted, is_smooth = facing(grid, triangles)
    own = across(triangles)
    own /= np.maximum(np.linalg.norm(own, axis=1, keepdims=True), 1e-12)
    return np.where((wanted * own).sum(1, keepdims=True) > AGREES, wanted, own), is_smooth


def facing(
    grid: SdfGrid, triangles: Float[np.ndarray, "m 3 3"]
) -> tuple[Float[np.ndarray, "m 3"], Bool[np.ndarray, " m"]]:
    """Return the unit normals of the distance function at the triangles' centres, world, and where it is smooth.

    At an edge the differences of a distance function are too short.
    """
    slopes = grid.gradient(torch.from_numpy(triangles.mean(1)).float(), APART).double().numpy()
    length = np.linalg.norm(slopes, axis=1)
    return slopes / np.maximum(length, 1e-12)[:, None], length > SMOOTH
