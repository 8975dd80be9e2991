"""Distances between surfaces and normals, and what a camera sees of them. Any frame and unit, shared by both sides."""

import cv2
import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

NEAREST_TRIANGLES = 6  # of a point's nearest samples; they contain the closest triangle, except at slivers
BUFFER = 2048  # px of the depth buffer in which hidden points are found, both sides
BEHIND = 5e-3  # of a mesh's diagonal: how far behind the nearest surface a point is hidden; few pixels span as much


def angle_deg(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Return the angles, degrees, between vectors of any length; accurate also near 0; 0 for a zero vector."""
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(-1)))


def hidden_from(
    mesh: trimesh.Trimesh,
    camera_from_world: Float[np.ndarray, "4 4"],
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
) -> Bool[np.ndarray, " n"]:
    """Find the points of a mesh that the camera does not see: those that face away or lie behind the nearest surface.

    Args:
        points, normals: on the mesh; unit normals.
    """
    rotation, shift = camera_from_world[:3, :3], camera_from_world[:3, 3]
    corners, seen = (np.asarray(p) @ rotation.T + shift for p in (mesh.vertices, points))
    faces = np.asarray(mesh.faces, np.int32)[(corners[mesh.faces][..., 2] > 0).all(1)]
    slopes = seen[:, :2] / seen[:, 2:]
    reach, far = float(np.abs(slopes).max()), 2 * float(max(corners[:, 2].max(), seen[:, 2].max()))
    depth = np.full((BUFFER, BUFFER), far, np.float32)
    how = cv2.TriangleRasterizeSettings().setCullingMode(cv2.RASTERIZE_CULLING_NONE)
    places = (corners * [1, -1, -1]).astype(np.float32)  # OpenGL's: up, towards the viewer
    cv2.triangleRasterizeDepth(places, faces, depth, np.eye(4), 2 * np.arctan(reach), 1e-3 * far, far, how)
    x, y = np.clip((slopes / reach + 1) / 2 * BUFFER, 0, BUFFER - 1).astype(int).T
    away = ((normals @ rotation.T) * seen).sum(1) >= 0
    return away | (depth[y, x] < seen[:, 2] - BEHIND * float(np.linalg.norm(mesh.extents)))


def sample_above(
    mesh: trimesh.Trimesh, height: float, count: int, seed: int
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
    """Draw `count` points uniformly on a surface; return those above z = height, and their triangles."""
    drawn = trimesh.sample.sample_surface(mesh, count, seed=seed)
    points, faces = np.asarray(drawn[0]), np.asarray(drawn[1])
    above = points[:, 2] > height
    return points[above], faces[above]


def distance_to_mesh(
    points: Float[np.ndarray, "n 3"],
    mesh: trimesh.Trimesh,
    samples: Float[np.ndarray, "m 3"],
    faces: Int[np.ndarray, " m"],
) -> Float[np.ndarray, " n"]:
    """Return the distance from points to a surface, exact to the triangles of the nearest samples.

    Args:
        samples, faces: points on the surface and their triangles.
    """
    nearest, index = map(np.asarray, KDTree(samples).query(points, k=NEAREST_TRIANGLES, workers=-1))
    repeated = np.repeat(points, NEAREST_TRIANGLES, 0)
    gap = repeated - trimesh.triangles.closest_point(np.asarray(mesh.triangles)[faces[index].reshape(-1)], repeated)
    gap[~np.isfinite(gap).all(1)] = np.inf  # a sliver has no closest point
    return np.minimum(np.linalg.norm(gap.reshape(*index.shape, 3), axis=2).min(1, initial=np.inf), nearest[:, 0])
