"""Simplify a closed mesh so that it stays closed."""

import fast_simplification
import numpy as np
import trimesh
from jaxtyping import Float, Integer
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from trimesh.visual import ColorVisuals

from capture.errors import ReconstructionError
from reconstruct.mesh.mesh import vertex_colours

MIN_FACES = 100  # below, no shape can be recognised
GROWTH = 1.1  # factor of the number of triangles at each further try
TRIES = 24  # up to 9 times as many, two seconds


def simplified(mesh: trimesh.Trimesh, faces: int) -> trimesh.Trimesh:
    """Simplify a mesh to about `faces` triangles with quadric error metrics [Garland and Heckbert 1997].

    If edge collapses pinch a thin part so that splitting cannot repair it, the result has more triangles. Normals and
    colours are those of the nearest vertices of the given mesh.

    Args:
        mesh: closed; coloured per vertex.
        faces: at least MIN_FACES; a mesh with no more triangles is returned unchanged.

    Raises:
        ReconstructionError: `faces` is below MIN_FACES.
    """
    if faces < MIN_FACES:
        raise ReconstructionError(f"{faces} triangles were asked for, at least {MIN_FACES} are needed for a shape.")
    target = faces
    for _ in range(TRIES):
        if target >= len(mesh.faces):
            return mesh
        reduced = fast_simplification.simplify(
            np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int32), target_count=target
        )
        small = _unpinched(reduced[0], reduced[1])
        if small.is_watertight and small.is_winding_consistent and small.volume > 0:
            return _with_attributes_of(small, mesh)
        target = int(target * GROWTH)
    return mesh


def bounds_a_solid(vertices: Float[np.ndarray, "n 3"], faces: Integer[np.ndarray, "m 3"]) -> bool:
    """Return whether the triangles enclose a volume: every edge is used equally often in both directions.

    Vertices at the same place count as one, so the test also works without topology (STL), with texture seams, and
    if two closed parts touch along an edge.
    """
    _, place = np.unique(vertices, axis=0, return_inverse=True)
    joined = place.reshape(-1)[faces]
    sides = joined[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).astype(np.int64)
    low, high = sides.min(1), sides.max(1)
    _, edge = np.unique(low * len(vertices) + high, return_inverse=True)
    net = np.bincount(edge.reshape(-1), np.sign(sides[:, 1] - sides[:, 0]))
    a, b, c = (np.asarray(vertices, np.float64)[faces[:, k]] for k in range(3))
    return len(faces) > 0 and not net.any() and float((a * np.cross(b, c)).sum()) > 0


def _unpinched(vertices: Float[np.ndarray, "n 3"], faces: Integer[np.ndarray, "m 3"]) -> trimesh.Trimesh:
    """Remove folded triangles, and split the mesh where more than two triangles share an edge.

    Afterwards every edge joins two triangles: of four at an edge, those connected around one of its ends are paired.
    Each connected fan around a vertex then gets its own vertex at the same place.
    """
    faces = _without_folds(faces)
    sides = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    ends, edge, count = np.unique(np.sort(sides, 1), axis=0, return_inverse=True, return_counts=True)
    edge = edge.reshape(-1)
    if (count == 2).all():
        return trimesh.Trimesh(vertices, faces, process=False)
    order = np.argsort(edge, kind="stable")
    plain = order[count[edge[order]] == 2].reshape(-1, 2)
    fan = _joined(faces, plain, ends[edge])
    pairs = [plain]
    for pinched in np.flatnonzero(count > 2):
        here = np.flatnonzero(edge == pinched)
        forward = sides[here, 0] == ends[pinched, 0]
        pairs.append(_paired(here[forward], here[~forward], fan[_corners(faces, here, ends[edge])]))
    fan = _joined(faces, np.concatenate(pairs), ends[edge])
    _, first, corner = np.unique(fan, return_index=True, return_inverse=True)
    return trimesh.Trimesh(vertices[faces.reshape(-1)[first]], corner.reshape(-1, 3), process=False)


def _without_folds(faces: Integer[np.ndarray, "m 3"]) -> Integer[np.ndarray, "k 3"]:
    """Remove pairs of triangles with the same three corners and opposite orientation."""
    _, kind = np.unique(np.sort(faces, 1), axis=0, return_inverse=True)
    kind = kind.reshape(-1)
    turn = np.where((faces[:, 0] < faces[:, 1]) ^ (faces[:, 1] < faces[:, 2]) ^ (faces[:, 2] < faces[:, 0]), 1, -1)
    net = np.bincount(kind, turn)[kind]
    left = np.flatnonzero(net * turn > 0)
    _, first = np.unique(kind[left], return_index=True)
    return faces[np.sort(left[first])]


def _corners(
    faces: Integer[np.ndarray, "m 3"], sides: Integer[np.ndarray, " k"], ends: Integer[np.ndarray, "sides 2"]
) -> Integer[np.ndarray, "k 2"]:
    """Return the corners (indices into faces.reshape(-1)) of the triangles with these sides, at the edges' two ends."""
    triangle = sides // 3
    return 3 * triangle[:, None] + (faces[triangle][:, None] == ends[sides][..., None]).argmax(-1)


def _joined(
    faces: Integer[np.ndarray, "m 3"], pairs: Integer[np.ndarray, "k 2"], ends: Integer[np.ndarray, "sides 2"]
) -> Integer[np.ndarray, " corners"]:
    """Return the connected component of each corner after the triangles of each pair are joined."""
    rows, columns = (_corners(faces, pairs[:, i], ends).reshape(-1) for i in (0, 1))
    graph = coo_matrix((np.ones(len(rows), bool), (rows, columns)), (faces.size, faces.size))
    return connected_components(graph, directed=False)[1]


def _paired(
    forward: Integer[np.ndarray, " k"], backward: Integer[np.ndarray, " k"], fans: Integer[np.ndarray, "n 2"]
) -> Integer[np.ndarray, "k 2"]:
    """Pair the sides of one edge in opposite directions, first those that share a fan at an end.

    Args:
        fans: of all sides at both ends, in ascending order of the sides.
    """
    fan_of = dict(zip(np.sort(np.append(forward, backward)).tolist(), fans, strict=True))
    left, pairs = backward.tolist(), []
    for one in forward.tolist():
        other = max(left, key=lambda side: int((fan_of[side] == fan_of[one]).sum()))
        left.remove(other)
        pairs.append((one, other))
    return np.array(pairs)


def _with_attributes_of(small: trimesh.Trimesh, full: trimesh.Trimesh) -> trimesh.Trimesh:
    """Copy normals and colours of the full mesh to the small one."""
    _, nearest = KDTree(full.vertices).query(small.vertices)
    small.vertex_normals = np.asarray(full.vertex_normals)[nearest]
    small.visual = ColorVisuals(small, vertex_colors=vertex_colours(full)[nearest])
    return small
