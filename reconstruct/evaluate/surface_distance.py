"""Distances between surfaces, depth maps and normal maps, in plain numpy. Any frame and unit, shared by both sides.

All rays pass through the camera's centre, so meshes are projected instead of ray traced, see `seen_from`.
"""

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

ICP_KEEP = 0.9  # of the pairs: the worst tenth may be parts that the other surface lacks
ICP_STEPS = 25  # point to point, before point to plane
ICP_PLANE_STEPS = 40
ICP_SCALE_STEPS = 60  # point to point converges slowly when the scale is free
ICP_POINTS = 20000  # more move the result by less than the surface's own noise
ICP_HELD = 1e-3  # of what holds the best held motion, planes must hold one for it to be made
ICP_SETTLED = 1e-8  # change of the mean distance at which it stops
NEAREST_TRIANGLES = 6  # of a point's nearest samples; they contain the closest triangle, except at slivers
LIFT = 1e-4  # world length: the visibility of a point is tested from just above its own triangle
PAIRS_PER_BLOCK = 2**21  # ray-triangle pairs tested at once: 300 MB


@dataclass(frozen=True)
class Similarity:
    """The transform x -> scale * rotation @ x + shift."""

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]

    def apply(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return the transformed points."""
        return self.scale * points @ self.rotation.T + self.shift


def angle_deg(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Return the angles, degrees, between vectors of any length; accurate also near 0; 0 for a zero vector."""
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(-1)))


def nmze(depth: Float[np.ndarray, " n"], truth: Float[np.ndarray, " n"], trim: float = 0.0) -> float:
    """Return the mean difference of two depth maps, each first scaled to 0..1 by its own range [DeepShadow's nMZE].

    Args:
        trim: per cent excluded at both ends of the range; 0 is the original measure, which a single outlier dominates.
    """
    scaled = []
    for z in (depth, truth):
        low, high = np.percentile(z, [trim, 100 - trim])
        scaled.append(np.clip((z - low) / max(high - low, 1e-12), 0, 1))
    return float(np.abs(scaled[0] - scaled[1]).mean())


def register(
    moving: Float[np.ndarray, "n 3"],
    fixed: Float[np.ndarray, "m 3"],
    normals: Float[np.ndarray, "m 3"],
    with_scale: bool = False,
) -> Similarity:
    """Align points to a surface by ICP: point to point, then (rigid only) point to plane.

    Args:
        fixed, normals: points of the surface and their unit normals.
        with_scale: estimate a similarity instead of a rigid motion.
    """
    if len(moving) > ICP_POINTS:
        moving = moving[np.random.default_rng(0).choice(len(moving), ICP_POINTS, replace=False)]
    tree, motion = KDTree(fixed), Similarity(1.0, np.eye(3), np.zeros(3))
    stages = [(False, ICP_SCALE_STEPS)] if with_scale else [(False, ICP_STEPS), (True, ICP_PLANE_STEPS)]
    for to_plane, steps in stages:
        last = np.inf
        for _ in range(steps):
            moved = motion.apply(moving)
            distance, index = map(np.asarray, tree.query(moved))
            if to_plane:
                distance = np.abs(((fixed[index] - moved) * normals[index]).sum(1))
            kept = distance <= np.quantile(distance, ICP_KEEP)
            target = fixed[index[kept]]
            if to_plane:
                step = _onto_planes(moved[kept], target, normals[index[kept]])
                motion = Similarity(1.0, step.rotation @ motion.rotation, step.rotation @ motion.shift + step.shift)
            else:
                motion = _onto_points(moving[kept], target, with_scale)
            mean = float(distance[kept].mean())
            if abs(last - mean) < ICP_SETTLED:
                break
            last = mean
    return motion


def _onto_points(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "n 3"], with_scale: bool) -> Similarity:
    """Return the least-squares motion of a onto b, pair by pair [Umeyama 1991]."""
    centre_a, centre_b = a.mean(0), b.mean(0)
    u, s, vt = np.linalg.svd((b - centre_b).T @ (a - centre_a) / len(a))
    sign = np.array([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ np.diag(sign) @ vt
    scale = float((s * sign).sum() / ((a - centre_a) ** 2).sum(1).mean()) if with_scale else 1.0
    return Similarity(scale, rotation, centre_b - scale * rotation @ centre_a)


def _onto_planes(
    a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]
) -> Similarity:
    """Return the small rigid motion of a to the planes through b; linearised.

    Motions along which the planes hold nothing are left out: a ball would turn by the rounding of its pairs [Gelfand,
    Ikemoto, Rusinkiewicz and Levoy, Geometrically Stable Sampling for the ICP Algorithm, 3DIM 2003].
    """
    centre = a.mean(0)
    size = float(np.sqrt(((a - centre) ** 2).sum(1).mean()))  # so that a turn and a shift count alike
    j = np.c_[np.cross((a - centre) / size, normals), normals]
    value, motion = np.linalg.eigh(j.T @ j)
    held = value > ICP_HELD * value[-1]
    x = motion[:, held] @ ((j @ motion[:, held]).T @ ((b - a) * normals).sum(1) / value[held])
    rotation = Rotation.from_rotvec(x[:3] / size).as_matrix()
    return Similarity(1.0, rotation, centre + x[3:] - rotation @ centre)


def seen_from(
    mesh: trimesh.Trimesh, camera_from_world: Float[np.ndarray, "4 4"], slopes: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Return z-depth and triangle of the first hit of each ray through the camera's centre; inf and -1 without a hit.

    The triangles are projected to the plane z = 1 and sorted into its buckets, so that each ray is tested against few
    of them. The result is exact and needs no ray tracer. Triangles that reach behind the camera are ignored.

    Args:
        slopes: (x / z, y / z) of the rays, camera frame.
    """
    z, face = np.full(len(slopes), np.inf), np.full(len(slopes), -1)
    corners = (mesh.vertices @ camera_from_world[:3, :3].T + camera_from_world[:3, 3])[mesh.faces]
    front = np.flatnonzero((corners[:, :, 2] > 0).all(1))
    if not len(front) or not len(slopes):
        return z, face
    corners = corners[front]
    flat = corners[:, :, :2] / corners[:, :, 2:]
    rays, first, count, members = _buckets(flat, slopes)
    ends = np.cumsum(count)
    start = 0
    while start < len(rays):
        stop = max(start + 1, int(np.searchsorted(ends, (ends[start - 1] if start else 0) + PAIRS_PER_BLOCK)))
        c = count[start:stop]
        ray = np.repeat(rays[start:stop], c)
        within = np.arange(len(ray)) - np.repeat(np.cumsum(c) - c, c)
        triangle = members[np.repeat(first[start:stop], c) + within]
        depth = _hit_depth(corners[triangle], flat[triangle], slopes[ray])
        hit = np.flatnonzero(np.isfinite(depth))
        hit = hit[np.argsort(-depth[hit], kind="stable")]  # the nearest is written last
        z[ray[hit]], face[ray[hit]] = depth[hit], front[triangle[hit]]
        start = stop
    return z, face


def _buckets(
    flat: Float[np.ndarray, "m 3 2"], slopes: Float[np.ndarray, "n 2"]
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"], Int[np.ndarray, " k"], Int[np.ndarray, " pairs"]]:
    """Return the rays that may hit a triangle, the start and size of their buckets, and the triangles by bucket."""
    low, high = slopes.min(0), slopes.max(0)
    side = int(np.clip(np.sqrt(len(flat)), 16, 512))  # about one triangle of a closed object per bucket and layer
    scale = side / np.maximum(high - low, 1e-12)
    first = np.floor((flat.min(1) - low) * scale).astype(int)
    last = np.floor((flat.max(1) - low) * scale).astype(int)
    touches = ((last >= 0) & (first < side + 1)).all(1)
    triangle = np.flatnonzero(touches)
    first, last = np.clip(first[touches], 0, side), np.clip(last[touches], 0, side)
    size = last - first + 1
    cells = size.prod(1)
    owner = np.repeat(np.arange(len(triangle)), cells)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(cells) - cells, cells)
    across, down = within % size[owner, 0], within // size[owner, 0]
    bucket = (first[owner, 1] + down) * (side + 1) + first[owner, 0] + across
    order = np.argsort(bucket, kind="stable")
    count = np.bincount(bucket, minlength=(side + 1) ** 2)
    begin = np.cumsum(count) - count
    cell = np.floor((slopes - low) * scale).astype(int) @ [1, side + 1]
    rays = np.flatnonzero(count[cell])
    return rays, begin[cell[rays]], count[cell[rays]], triangle[owner[order]]


def _hit_depth(
    corners: Float[np.ndarray, "p 3 3"], flat: Float[np.ndarray, "p 3 2"], slopes: Float[np.ndarray, "p 2"]
) -> Float[np.ndarray, " p"]:
    """Return the z-depth at which each ray meets its triangle, inf if it misses. Edges belong to both triangles."""
    to_corner = flat - slopes[:, None]
    following = np.roll(to_corner, -1, axis=1)
    side = to_corner[:, :, 0] * following[:, :, 1] - to_corner[:, :, 1] * following[:, :, 0]
    inside = (side >= 0).all(1) | (side <= 0).all(1)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    along = (normal[:, :2] * slopes).sum(1) + normal[:, 2]
    inside &= along != 0
    return np.where(inside, (normal * corners[:, 0]).sum(1) / np.where(inside, along, 1), np.inf)


def hidden_from(
    mesh: trimesh.Trimesh,
    camera_from_world: Float[np.ndarray, "4 4"],
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
) -> Bool[np.ndarray, " n"]:
    """Find the points of a mesh that the camera does not see: those that face away or are occluded.

    Args:
        points, normals: on the mesh; unit normals.
    """
    rotation, shift = camera_from_world[:3, :3], camera_from_world[:3, 3]
    lifted = (points + LIFT * normals) @ rotation.T + shift
    back = ((normals @ rotation.T) * (points @ rotation.T + shift)).sum(1) >= 0
    first, _ = seen_from(mesh, camera_from_world, lifted[:, :2] / lifted[:, 2:])
    return back | (first < lifted[:, 2])


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


def f_score(precision: float, recall: float) -> float:
    """Return the harmonic mean of precision and recall."""
    return 2 * precision * recall / (precision + recall) if precision + recall else 0.0
