"""Move the vertices of a mesh of marching cubes a little, so that its triangles face as the distance function says.

Marching cubes puts each vertex on an edge of the grid, where the distances of two nodes alone decide its place. The
triangles between them face several degrees away from the surface they stand for. Here each vertex is moved towards the
planes of its triangles, each with the normal of the distance function [Sun, Rosin, Martin, Langbein 2007, Fast and
Effective Feature-Preserving Mesh Denoising, equation 11]. There, planes go through the triangles' centres, which lie
inside of where the surface is convex, so thin parts became thinner. Tangential planes of the surface would make them
thicker. Half-way between the two, they keep their size. Triangles stay the same.

Turn edges of a mesh over, so that its triangles face as the distance function says.

Two triangles that share an edge fill a quad; its other diagonal divides it into two triangles that may face more like
the surface they stand for. Marching cubes takes diagonals from a table. Here edges are turned over as long as the sum
over the triangles of area times deviation falls: a data-dependent triangulation [Dyn, Levin, Rippa 1990, Data Dependent
Triangulations for Piecewise Linear Interpolation] whose data are the normals of the distance function. The number of
triangles and vertices, and the places of these, stay.
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
ROUNDS = 4  # of turning edges that share no triangle; a fifth turns less than a hundredth of the first one's
LEAST_GAIN = 1e-3  # of twice the area, in radians: less is rounding
SAME_SIDE = 0.7  # cosine between a new triangle's normal and the distance function's, at least
NARROW = np.sin(np.radians(10.0))  # sine of a triangle's least angle, below which no edge makes it narrower


def faced(
    grid: SdfGrid, vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"], fixed: Bool[np.ndarray, " n"]
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


def flipped(
    grid: SdfGrid, vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"], fixed: Bool[np.ndarray, " n"]
) -> Int[np.ndarray, "m 3"]:
    """Return the triangles of a closed mesh after some of its edges were turned over.

    Args:
        vertices: world frame.
        fixed: vertices of a flat cut: a triangle that has only such is neither changed nor made.
    """
    faces, is_open = faces.copy(), np.ones(len(faces), bool)  # of an edge that was worth turning, or beside one
    for _ in range(ROUNDS):
        ends, opposite, sides = _edges(faces)
        stays = np.asarray(fixed[faces].all(1))
        some = (is_open[sides[:, 0]] | is_open[sides[:, 1]]) & ~(stays[sides[:, 0]] | stays[sides[:, 1]])
        known, (ends, opposite, sides) = _key(ends, len(vertices)), (ends[some], opposite[some], sides[some])
        one = np.stack([ends[:, 0], opposite[:, 1], opposite[:, 0]], 1)
        other = np.stack([opposite[:, 1], ends[:, 1], opposite[:, 0]], 1)
        gain = _gain(grid, vertices, faces, sides, (one, other))
        worth = np.flatnonzero(gain > 0)
        gain[worth[_are_in(_key(opposite[worth], len(vertices)), known)]] = 0  # an edge already
        gain[fixed[one].all(1) | fixed[other].all(1)] = 0
        is_open[:] = False
        is_open[sides[gain > 0]] = True
        chosen = _apart(gain, sides, opposite, len(faces))
        if not len(chosen):
            break
        faces[sides[chosen, 0]], faces[sides[chosen, 1]] = one[chosen], other[chosen]
    return faces


def _edges(
    faces: Int[np.ndarray, "m 3"],
) -> tuple[Int[np.ndarray, "e 2"], Int[np.ndarray, "e 2"], Int[np.ndarray, "e 2"]]:
    """Return each edge's ends, the corners opposite to it, and its triangles.

    The first triangle runs from the first end to the second, the other back.
    """
    start, end, corner = faces.ravel(), faces[:, [1, 2, 0]].ravel(), faces[:, [2, 0, 1]].ravel()
    owner = np.repeat(np.arange(len(faces)), 3)
    order = np.lexsort((start, np.maximum(start, end), np.minimum(start, end)))
    first, second = order[0::2], order[1::2]
    return (
        np.stack([start[first], end[first]], 1),
        np.stack([corner[first], corner[second]], 1),
        np.stack([owner[first], owner[second]], 1),
    )


def _gain(
    grid: SdfGrid,
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "m 3"],
    sides: Int[np.ndarray, "e 2"],
    new: tuple[Int[np.ndarray, "e 3"], Int[np.ndarray, "e 3"]],
) -> Float[np.ndarray, " e"]:
    """Return by how much each edge's turning lets the deviation fall; 0 where it must not be turned."""
    there, place = np.unique(sides, return_inverse=True)
    before, widest, _ = _deviation(grid, vertices[faces[there]])
    (one, one_width, one_faces), (other, other_width, other_faces) = (_deviation(grid, vertices[some]) for some in new)
    first, second = place.reshape(sides.shape).T
    gain = before[first] + before[second] - one - other
    narrow = np.minimum(one_width, other_width) < np.minimum(NARROW, np.minimum(widest[first], widest[second]))
    gain[narrow | (np.minimum(one_faces, other_faces) < SAME_SIDE)] = 0
    return gain


def _deviation(
    grid: SdfGrid, triangles: Float[np.ndarray, "m 3 3"]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Return twice the area times the deviation (rad), the sine of the least angle, and the deviation's cosine."""
    normal, wanted = across(triangles), facing(grid, triangles)[0]
    area = np.sqrt(np.einsum("mi,mi->m", normal, normal))
    cosine = np.clip(np.einsum("mi,mi->m", normal, wanted) / np.maximum(area, 1e-12), -1, 1)
    sides = triangles - triangles[:, [1, 2, 0]]
    lengths = np.sort(np.sqrt(np.einsum("mki,mki->mk", sides, sides)), 1)
    least = area / np.maximum(lengths[:, 1] * lengths[:, 2], 1e-12)
    return area * (np.arccos(cosine) - LEAST_GAIN), least, cosine


def _key(pairs: Int[np.ndarray, "e 2"], count: int) -> Int[np.ndarray, " e"]:
    """Return a number for each pair of vertices, whichever is first; as ordered as _edges' pairs are."""
    low, high = np.minimum(pairs[:, 0], pairs[:, 1]), np.maximum(pairs[:, 0], pairs[:, 1])
    return low.astype(np.int64) * count + high


def _are_in(keys: Int[np.ndarray, " k"], ordered: Int[np.ndarray, " e"]) -> Bool[np.ndarray, " k"]:
    return ordered[np.minimum(np.searchsorted(ordered, keys), len(ordered) - 1)] == keys


def _apart(
    gain: Float[np.ndarray, " e"], sides: Int[np.ndarray, "e 2"], opposite: Int[np.ndarray, "e 2"], triangles: int
) -> Int[np.ndarray, " chosen"]:
    """Return edges that share no triangle and make no edge twice: each with the largest gain of its two triangles."""
    order = np.argsort(-gain, kind="stable")
    rank = np.empty(len(gain), np.int64)
    rank[order] = np.arange(len(gain))
    first = np.full(triangles, len(gain))
    np.minimum.at(first, sides, rank[:, None])
    chosen = np.flatnonzero((gain > 0) & (first[sides] == rank[:, None]).all(1))
    return chosen[np.unique(np.sort(opposite[chosen], 1), axis=0, return_index=True)[1]]
