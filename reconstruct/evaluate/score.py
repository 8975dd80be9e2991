"""Compare a prediction with a scene's known truth, as seen by the camera and as a surface above the ground."""

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Bool, Float

from calibration.posed_camera import PosedCamera
from reconstruct.evaluate.surface_distance import (
    NEAREST_TRIANGLES,
    angle_deg,
    distance_to_mesh,
    hidden_from,
    sample_above,
)

Numbers = dict[str, object]


@dataclass(frozen=True)
class Prediction:
    """A result at each pixel of the reference, in its frame: z-depth, unit normals, and where the object is."""

    depth: Float[np.ndarray, " n"]
    normals: Float[np.ndarray, "n 3"]
    mask: Bool[np.ndarray, " n"]


@dataclass(frozen=True)
class Reference:
    """The truth of a scene, pixels flattened, in a world of its own with z up."""

    posed_camera: PosedCamera
    depth: Float[np.ndarray, " n"]
    normals: Float[np.ndarray, "n 3"]
    mask: Bool[np.ndarray, " n"]
    mesh: trimesh.Trimesh | None = None

    def ground_depth(self) -> Float[np.ndarray, " n"]:
        """Return the z-depth of the ground without the object; inf above the horizon."""
        down = self.posed_camera.rays(self.posed_camera.camera.pixel_grid().reshape(-1, 2))[:, 2]
        depth = (self.posed_camera.ground_height - self.posed_camera.centre[2]) / np.where(down == 0, 1e-30, down)
        return np.where(depth > 0, depth, np.inf)

    def centre(self) -> Float[np.ndarray, "3"]:
        """Return the middle of the object's visible part: the median, along the camera's axes."""
        camera = self.posed_camera.camera
        rays = camera.unproject(camera.pixel_grid().reshape(-1, 2)[self.mask])
        return self.posed_camera.world_from_camera.apply(np.median(rays * self.depth[self.mask][:, None], 0))


def compare_views(truth: Reference, seen: Prediction) -> Numbers:
    """Compare depth, normals and mask over the true object pixels; a missed pixel counts as the ground behind it."""
    k = truth.mask
    shown = (seen.mask & np.isfinite(seen.depth))[k]
    error = np.abs(np.where(shown, seen.depth[k], truth.ground_depth()[k]) - truth.depth[k])
    error = error[np.isfinite(error)]  # above the horizon there is no ground
    angles = angle_deg(np.where(seen.mask[k, None], seen.normals[k], [0.0, 0.0, 1.0]), truth.normals[k])
    return {
        "mask_iou": mean_or_none((seen.mask & k)[seen.mask | k]),
        "depth_mae": mean_or_none(error),
        "depth_median": float(np.median(error)) if len(error) else None,
        "normal_mae_deg": mean_or_none(angles),
    }


def compare_surfaces(truth: Reference, mesh: trimesh.Trimesh, limit: float, margin: float, samples: int) -> Numbers:
    """Return Chamfer distance and F-score above the ground, and recall of the surface hidden from the camera.

    Args:
        mesh: in the frame of the truth.
        limit: world length: what is closer than this is right, for precision, recall and F-score.
        margin: world length above the ground, below which nothing is compared: a mesh may contain the ground.
        samples: points to draw on each surface.
    """
    assert truth.mesh is not None
    height = truth.posed_camera.ground_height + margin
    wanted, wanted_faces = sample_above(truth.mesh, height, samples, seed=0)
    found, found_faces = sample_above(mesh, height, samples, seed=1)
    if min(len(found), len(wanted)) < NEAREST_TRIANGLES:
        return dict.fromkeys(("precision", "recall", "fscore", "hidden_recall"), 0.0)
    camera_from_world = truth.posed_camera.world_from_camera.inverse().matrix()
    hidden = hidden_from(truth.mesh, camera_from_world, wanted, truth.mesh.face_normals[wanted_faces])
    accuracy = distance_to_mesh(found, truth.mesh, wanted, wanted_faces)
    complete = distance_to_mesh(wanted, mesh, found, found_faces)
    precision, recall = float((accuracy < limit).mean()), float((complete < limit).mean())
    return {
        "threshold": limit,
        "precision": precision,
        "recall": recall,
        "fscore": 2 * precision * recall / (precision + recall) if precision + recall else 0.0,
        "visible_recall": mean_or_none(complete[~hidden] < limit),
        "hidden_recall": mean_or_none(complete[hidden] < limit),
        "chamfer": float((accuracy.mean() + complete.mean()) / 2),
    }


def mean_or_none(values: Float[np.ndarray, " n"] | Bool[np.ndarray, " n"]) -> float | None:
    """Return the mean; None for an empty array (JSON has no NaN)."""
    return float(values.mean()) if len(values) else None
