"""Compare a prediction with a scene's known truth, as seen by the camera and as a surface above the ground."""

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int, Shaped

from calibration.posed_camera import PosedCamera
from reconstruct.evaluate.surface_distance import (
    angle_deg,
    distance_to_mesh,
    f_score,
    hidden_from,
    nmze,
    register,
    sample_above,
    seen_from,
)

THRESHOLD = 0.01  # of the true bounding-box diagonal, for the F-score
GROUND_MARGIN = 0.01  # the same: closer to the ground nothing is compared, because a mesh may contain the ground
MASK_MARGIN = 0.005  # scene units: a mesh pixel this close to the ground is the ground inside the mesh
ENOUGH = 0.9  # share of the samples above the ground; with fewer, more are drawn
MOST_SAMPLES = 30  # times the wanted number, for a mesh with a large ground in it
MIN_ICP_PIXELS = 50
TRIM = 1.0  # per cent of the depths excluded at both ends for the robust nMZE

Numbers = dict[str, object]


@dataclass(frozen=True)
class Prediction:
    """A result at each pixel of the reference, world frame. Without a surface, z-depth is inf and normals are 0."""

    depth: Float[np.ndarray, " n"]
    normals: Float[np.ndarray, "n 3"]
    mask: Bool[np.ndarray, " n"] | None  # None: all pixels that show a surface above the ground


@dataclass(frozen=True)
class Reference:
    """The truth of a scene, pixels flattened. World frame."""

    posed_camera: PosedCamera
    depth: Float[np.ndarray, " n"]
    normals: Float[np.ndarray, "n 3"]
    mask: Bool[np.ndarray, " n"]
    mesh: trimesh.Trimesh

    def rays(self) -> Float[np.ndarray, "n 3"]:
        """Return the pixels' world directions of z-depth 1."""
        return self.posed_camera.rays(self.posed_camera.camera.pixel_grid().reshape(-1, 2))

    def points(self, depth: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
        """Return the pixels' world points at a z-depth; the camera's centre where it is inf."""
        return self.posed_camera.centre + np.where(np.isfinite(depth), depth, 0)[:, None] * self.rays()

    def ground_depth(self) -> Float[np.ndarray, " n"]:
        """Return the z-depth of the ground without the object; inf above the horizon."""
        down = self.rays()[:, 2]
        depth = (self.posed_camera.ground_height - self.posed_camera.centre[2]) / np.where(down == 0, 1e-30, down)
        return np.where(depth > 0, depth, np.inf)

    def camera_from_world(self) -> Float[np.ndarray, "4 4"]:
        """Return the camera's pose as a matrix."""
        return self.posed_camera.world_from_camera.inverse().matrix()


def rendered(truth: Reference, mesh: trimesh.Trimesh) -> Prediction:
    """Render a mesh on its ground from the true camera: z-depth and face normals, the ground's where it is nearer."""
    camera = truth.posed_camera.camera
    through = camera.unproject(camera.pixel_grid().reshape(-1, 2))
    depth, face = seen_from(mesh, truth.camera_from_world(), through[:, :2])
    normals = np.zeros((len(depth), 3))
    normals[face >= 0] = mesh.face_normals[face[face >= 0]]
    normals[(normals * truth.rays()).sum(1) > 0] *= -1
    normals[~(depth <= truth.ground_depth())] = [0.0, 0.0, 1.0]
    return Prediction(depth, normals, None)


def compare_views(truth: Reference, seen: Prediction, mesh: trimesh.Trimesh | None) -> Numbers:
    """Compare depth, normals and mask over the true object pixels; a missed pixel counts as the ground behind it.

    Args:
        mesh: to be aligned by ICP and rendered again; None: it is not.
    """
    ground, foreground = truth.ground_depth(), truth.mask
    hit = np.isfinite(seen.depth) & (seen.depth > 0) & (seen.depth <= ground)
    above = truth.points(np.where(hit, seen.depth, np.inf))[:, 2] - truth.posed_camera.ground_height > MASK_MARGIN
    found = seen.mask if seen.mask is not None else hit & above
    low = truth.points(truth.depth)[:, 2] - truth.posed_camera.ground_height <= MASK_MARGIN
    counted = ~(foreground & low)  # true object this low cannot be distinguished from a ground inside the mesh
    depth = np.where(hit, seen.depth, ground)
    normals = seen.normals
    k, both = foreground & np.isfinite(depth), foreground & found
    error = np.abs(depth - truth.depth)
    numbers: Numbers = {
        "mask_iou": mean_or_none((found & foreground)[(found | foreground) & counted]),
        "foreground_pixels": int(foreground.sum()),
        "foreground_pixels_without_prediction": int((foreground & ~found).sum()),
        "depth_l1_raw": mean_or_none(error[k]),
        "depth_median_raw": median_or_none(error[k]),
        "depth_l1_overlap": mean_or_none(error[both]),
        "depth_l1_shift": depth_l1_shift(depth[k], truth.depth[k]),
    }
    finite = np.isfinite(depth) & np.isfinite(truth.depth)
    numbers["nmze"] = nmze(depth[finite], truth.depth[finite])
    numbers["nmze_1_99"] = nmze(depth[finite], truth.depth[finite], TRIM)
    valid = foreground & (np.linalg.norm(normals, axis=1) > 1e-6)
    angles = angle_deg(normals[valid], truth.normals[valid])
    numbers |= {"normal_mae_deg": mean_or_none(angles), "normal_median_deg": median_or_none(angles)}
    if both.sum() >= MIN_ICP_PIXELS:
        numbers |= _aligned(truth, depth, normals, both, mesh)
    return numbers


def _aligned(
    truth: Reference,
    depth: Float[np.ndarray, " n"],
    normals: Float[np.ndarray, "n 3"],
    both: Bool[np.ndarray, " n"],
    mesh: trimesh.Trimesh | None,
) -> Numbers:
    """Return depth errors after rigid ICP and after ICP with scale; the ground is not moved."""
    numbers: Numbers = {}
    foreground = truth.mask
    points, true_points = truth.points(depth), truth.points(truth.depth)
    eye, forward = truth.posed_camera.centre, truth.posed_camera.forward
    k = foreground & np.isfinite(depth)
    for key, with_scale in (("depth_l1_icp", False), ("depth_l1_icp_similarity", True)):
        motion = register(points[both], true_points[foreground], truth.normals[foreground], with_scale)
        moved = np.where(both[k, None], motion.apply(points[k]), points[k])
        numbers[key] = mean_or_none(np.abs((moved - eye) @ forward - truth.depth[k]))
        if with_scale:
            continue
        valid = foreground & (np.linalg.norm(normals, axis=1) > 1e-6)
        turned = normals[valid] @ motion.rotation.T
        numbers["normal_mae_icp_deg"] = mean_or_none(angle_deg(turned, truth.normals[valid]))
        numbers["icp_rotation_deg"] = float(np.degrees(np.arccos(np.clip((np.trace(motion.rotation) - 1) / 2, -1, 1))))
        centre = true_points[foreground].mean(0)
        numbers["icp_shift"] = float(np.linalg.norm(motion.rotation @ centre + motion.shift - centre))
        if mesh is not None:
            again = rendered(truth, trimesh.Trimesh(motion.apply(mesh.vertices), mesh.faces, process=False))
            z, ground = np.minimum(again.depth, truth.ground_depth()), truth.ground_depth()
            shown = foreground & np.isfinite(z)
            numbers["depth_l1_icp_rendered"] = mean_or_none(np.abs(z - truth.depth)[shown])
            numbers["depth_l1_icp_rendered_overlap"] = mean_or_none(np.abs(z - truth.depth)[shown & (z < ground)])
    return numbers


def compare_surfaces(truth: Reference, mesh: trimesh.Trimesh, samples: int) -> Numbers:
    """Return Chamfer distance and F-score above the ground, and recall of the surface hidden from the camera.

    Args:
        samples: points to draw on each surface.
    """
    diagonal = float(np.linalg.norm(truth.mesh.extents))
    limit, margin = THRESHOLD * diagonal, GROUND_MARGIN * diagonal
    wanted, wanted_faces = _sample_enough(truth.mesh, truth.posed_camera.ground_height + margin, samples, seed=0)
    normals = truth.mesh.face_normals[wanted_faces]
    hidden = hidden_from(truth.mesh, truth.camera_from_world(), wanted, normals)
    numbers: Numbers = {
        "bbox_diagonal": diagonal,
        "threshold": limit,
        "ground_margin": margin,
        "hidden_fraction": float(hidden.mean()),
    }
    found, found_faces = _sample_enough(mesh, truth.posed_camera.ground_height + margin, samples, seed=1)
    if len(found) < 10:
        return numbers | dict.fromkeys(("precision", "recall", "fscore", "visible_recall", "hidden_recall"), 0.0)
    accuracy = distance_to_mesh(found, truth.mesh, wanted, wanted_faces)
    complete = distance_to_mesh(wanted, mesh, found, found_faces)
    precision, recall = float((accuracy < limit).mean()), float((complete < limit).mean())
    return numbers | {
        "accuracy": float(accuracy.mean()),
        "completeness": float(complete.mean()),
        "chamfer": float((accuracy.mean() + complete.mean()) / 2),
        "precision": precision,
        "recall": recall,
        "fscore": f_score(precision, recall),
        "visible_recall": mean_or_none(complete[~hidden] < limit),
        "hidden_recall": mean_or_none(complete[hidden] < limit),
        "hidden_completeness": mean_or_none(complete[hidden]),
    }


def _sample_enough(
    mesh: trimesh.Trimesh, height: float, samples: int, seed: int
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
    """Draw about `samples` points above a height, with their triangles, for any share of surface below it."""
    points, faces = sample_above(mesh, height, samples, seed)
    if 0 < len(points) < ENOUGH * samples:
        count = int(min(samples * samples / len(points), MOST_SAMPLES * samples))
        points, faces = sample_above(mesh, height, count, seed)
    return points, faces


def depth_l1_shift(depth: Float[np.ndarray, " n"], truth: Float[np.ndarray, " n"]) -> float | None:
    """Return the mean depth error after the mean difference is removed, for depth known up to a shift."""
    return mean_or_none(np.abs(depth - truth - np.mean(depth - truth))) if len(depth) else None


def mean_or_none(values: Shaped[np.ndarray, " n"]) -> float | None:
    """Return the mean; None for an empty array (JSON has no NaN)."""
    return float(values.mean()) if len(values) else None


def median_or_none(values: Float[np.ndarray, " n"]) -> float | None:
    """Return the median; None for an empty array."""
    return float(np.median(values)) if len(values) else None
