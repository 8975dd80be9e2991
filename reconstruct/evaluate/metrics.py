"""Compare a result folder with a reference folder whose `gt/` holds the truth; return a dict of measures.

There are two layouts: simulated scenes (`gt/depth.npy`, `gt/mesh.ply`; scene units, known camera) and simulated phone
captures (`gt/maps.npz`, `gt/object.ply`; mm). For captures the camera is estimated, too, so the comparison is in the
frame of the fixed camera, independent of the result's world frame.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from calibration.calibration import load_calibration
from calibration.camera import Camera
from calibration.light import Light
from calibration.pose import Pose
from calibration.posed_camera import PosedCamera
from capture.errors import ReconstructionError
from reconstruct.evaluate.score import (
    TRIM,
    Numbers,
    Prediction,
    Reference,
    compare_surfaces,
    compare_views,
    depth_l1_shift,
    mean_or_none,
    rendered,
)
from reconstruct.evaluate.surface_distance import angle_deg, f_score, hidden_from, nmze, register, sample_above
from reconstruct.stored_run.maps import read_maps, read_mask
from reconstruct.stored_run.ply import read_mesh
from reconstruct.stored_run.stored_run import CALIBRATION, MESH

SCENE_SAMPLES = 100_000  # points drawn on each surface: the F-score repeats to 0.001
CAPTURE_SAMPLES = 60_000
CAPTURE_THRESHOLD = 0.02  # of the true bounding-box diagonal, for the F-score
CAPTURE_MARGIN_MM = 2.0  # above the table: below, nothing is compared
QUARTER_TURNS = {1: 0, 3: 2, 6: 1, 8: -1}  # from the upright truth to the stored frame, by EXIF orientation


def evaluate(result: Path, reference: Path, samples: int | None = None) -> Numbers:
    """Compute all measures that the folder's layout allows. A reconstruction never calls this.

    Args:
        samples: points to draw on each surface; by default the layout's usual number.

    Raises:
        ReconstructionError: a file is missing, or result and reference do not belong together.
    """
    truth = reference / "gt"
    if (truth / "maps.npz").exists():
        return evaluate_capture(result, reference, samples or CAPTURE_SAMPLES)
    if (truth / "depth.npy").exists():
        return evaluate_scene(result, reference, samples or SCENE_SAMPLES)
    raise ReconstructionError(
        f"no truth was found in {reference}: gt/depth.npy (a scene) or gt/maps.npz (a capture) is needed. "
        "Give the folder that holds gt/."
    )


def evaluate_scene(result: Path, reference: Path, samples: int) -> Numbers:
    """Evaluate a scene with known camera: its mesh seen from the camera, its whole surface, and (`maps`) its maps.

    Raises:
        ReconstructionError: as `evaluate`.
    """
    truth = load_scene_reference(reference)
    mesh = read_mesh(result / MESH)
    numbers: Numbers = {"scene": reference.resolve().name}
    numbers |= compare_views(truth, rendered(truth, mesh), mesh)
    numbers |= compare_surfaces(truth, mesh, samples)
    if all((result / name).exists() for name in ("depth.npy", "normal.npy", "mask.png")):
        camera = truth.posed_camera.camera
        maps = read_maps(result, (camera.height, camera.width))
        views = Prediction(
            maps.depth.astype(float).ravel(), maps.normals.astype(float).reshape(-1, 3), maps.mask.ravel()
        )
        numbers["maps"] = compare_views(truth, views, None)
    return numbers


def load_scene_reference(folder: Path) -> Reference:
    """Load the truth of a scene from `folder/gt`, whose pixel centres are at half integers; ours are at integers.

    Raises:
        ReconstructionError: a file is missing.
    """
    truth = folder / "gt"
    given = _json(truth / "camera.json")
    k = np.array(given["K"], float)
    camera = Camera(given["width"], given["height"], k[0, 0], k[1, 1], k[0, 2] - 0.5, k[1, 2] - 0.5)
    pose = Pose.from_matrix(np.array(given["world_from_camera"], float))
    return Reference(
        PosedCamera(camera, pose, float(_json(truth / "ground.json")["z"])),
        np.load(_existing(truth / "depth.npy")).astype(float).ravel(),
        np.load(_existing(truth / "normal.npy")).astype(float).reshape(-1, 3),
        read_mask(_existing(truth / "mask.png")).ravel(),
        _load_mesh(truth / "mesh.ply"),
    )


@dataclass(frozen=True)
class CaptureTruth:
    """The truth of a capture, rotated to the frame of the stored photos. Camera frame, mm."""

    camera: Camera
    camera_from_board: Pose
    depth: Float[np.ndarray, "height width"]
    normals: Float[np.ndarray, "height width 3"]
    mask: Bool[np.ndarray, "height width"]
    ground_normal: Float[np.ndarray, "3"]
    ground_point: Float[np.ndarray, "3"]
    table_mm: float  # z of the table, board frame

    def rays(self) -> Float[np.ndarray, "n 3"]:
        """Return the directions with z = 1 of the object's pixels."""
        return self.camera.unproject(self.camera.pixel_grid()[self.mask])

    def centre(self) -> Float[np.ndarray, "3"]:
        """Return the centre of the object's visible part, camera frame, mm."""
        return np.median(self.rays() * self.depth[self.mask][:, None], 0)


def load_capture_truth(folder: Path, width: int, height: int) -> CaptureTruth:
    """Load the truth of a capture from `folder/gt` for photos of this size (px), upright or as stored.

    Raises:
        ReconstructionError: a file is missing, or the truth is for photos of another size.
    """
    truth = folder / "gt"
    given = _json(truth / "camera.json")
    upright, stored = given.get("upright", given), given.get("stored", given)
    chosen = next((c for c in (upright, stored) if (c["width"], c["height"]) == (width, height)), None)
    if chosen is None:
        raise ReconstructionError(
            f"the result is for photos of {width} x {height} px, {folder} has {stored['width']} x {stored['height']}. "
            "Give the reference of the same capture."
        )
    turns = 0 if chosen is upright else QUARTER_TURNS[given["exif_orientation"]]
    with np.load(_existing(truth / "maps.npz")) as maps:
        depth, normals, mask = (np.rot90(maps[name], turns) for name in ("depth_mm", "normal", "mask"))
    k = np.array(chosen["K"], float)
    lens = tuple(map(float, chosen["dist_k1_k2_p1_p2_k3"]))
    pose = Pose.from_matrix(np.array(chosen["T_cam_from_board"], float))
    ground = _json(truth / "ground.json")
    normal = np.array(ground["normal"], float)
    return CaptureTruth(
        Camera(width, height, k[0, 0], k[1, 1], k[0, 2], k[1, 2], (lens[0], lens[1], lens[2], lens[3], lens[4])),
        pose,
        depth.astype(float),
        pose.rotate(normals.astype(float)),
        mask.astype(bool),
        pose.rotate(normal),
        pose.apply(normal * ground["offset_mm"]),
        float(ground["offset_mm"]),
    )


def evaluate_capture(result: Path, reference: Path, samples: int) -> Numbers:
    """Evaluate a phone capture: camera, ground, lights, maps and surface in the fixed camera's frame.

    Raises:
        ReconstructionError: as `evaluate`.
    """
    found = load_calibration(result / CALIBRATION)
    truth = load_capture_truth(reference, found.camera.width, found.camera.height)
    camera_from_world = found.world_from_camera.inverse()
    numbers: Numbers = {"capture": reference.resolve().name}
    numbers["focal_error_pct"] = 100 * (found.camera.fx / truth.camera.fx - 1)
    numbers |= _compare_ground(truth, found.ground_height, camera_from_world)
    numbers |= _compare_lights(truth, found.lights, _json(reference / "gt" / "lights.json"), camera_from_world)
    numbers |= _compare_maps(truth, result, camera_from_world)
    if (reference / "gt" / "object.ply").exists():
        true_mesh = _load_mesh(reference / "gt" / "object.ply")
        numbers |= _compare_meshes(truth, true_mesh, read_mesh(result / MESH), camera_from_world, samples)
    return numbers


def _compare_ground(truth: CaptureTruth, height: float, camera_from_world: Pose) -> Numbers:
    """Compare the ground's normal, and its distance along the optical axis."""
    up = np.array([0.0, 0.0, 1.0])
    normal = camera_from_world.rotate(up)
    point = camera_from_world.apply(up * height)
    true_axis = truth.ground_normal @ truth.ground_point / truth.ground_normal[2]
    return {
        "ground_normal_deg": float(angle_deg(truth.ground_normal[None], normal[None])[0]),
        "ground_depth_pct": float(100 * (normal @ point / normal[2] / true_axis - 1)),
    }


def _compare_lights(
    truth: CaptureTruth, found: Sequence[Light], given: dict[str, Any], camera_from_world: Pose
) -> Numbers:
    """Compare light positions, in per cent of their distance from the object, over photos usable in both."""
    true_lights = {Path(light["file"]).stem: light for light in given["photos"]}
    centre = truth.centre()
    errors, directions, bad_used, dropped = [], [], [], []
    for light in found:
        true = true_lights.get(Path(light.photo).stem)
        if true is None:
            continue
        if light.used != true["usable"]:
            (bad_used if light.used else dropped).append(light.photo)
        elif light.used and light.position is not None:
            expected = truth.camera_from_board.apply(np.array(true["position_mm"], float)) - centre
            seen = camera_from_world.apply(light.position) - centre
            errors.append(100 * np.linalg.norm(seen - expected) / np.linalg.norm(expected))
            directions.append(angle_deg(expected[None], seen[None])[0])
    numbers: Numbers = {"photos_scored": len(errors), "bad_photos_used": bad_used, "good_photos_dropped": dropped}
    if errors:
        numbers["light_median_pct"] = float(np.median(errors))
        numbers["light_p90_pct"] = float(np.percentile(errors, 90))
        numbers["light_direction_median_deg"] = float(np.median(directions))
    return numbers


def _compare_maps(truth: CaptureTruth, result: Path, camera_from_world: Pose) -> Numbers:
    """Compare mask, depth and normals over the true object pixels; a missed pixel counts as the ground behind it."""
    maps = read_maps(result, (truth.mask.shape[0], truth.mask.shape[1]))
    depth, normals, mask = maps.depth.astype(float), maps.normals.astype(float), maps.mask
    rays, expected = truth.rays(), truth.depth[truth.mask]
    ground = truth.ground_normal @ truth.ground_point / (rays @ truth.ground_normal)
    shown = (mask & np.isfinite(depth))[truth.mask]
    z = np.where(shown, depth[truth.mask], ground)
    n = np.where(mask[truth.mask][:, None], camera_from_world.rotate(normals[truth.mask]), truth.ground_normal)
    numbers: Numbers = {
        "mask_iou": mean_or_none((mask & truth.mask)[mask | truth.mask]),
        "depth_mae_mm": float(np.abs(z - expected).mean()),
        "depth_median_mm": float(np.median(np.abs(z - expected))),
        "depth_shift_mm": depth_l1_shift(z, expected),
        "normal_mae_deg": float(angle_deg(n + 1e-12, truth.normals[truth.mask] + 1e-12).mean()),
        "nmze": nmze(z, expected),
        "nmze_1_99": nmze(z, expected, TRIM),
    }
    for key, with_scale in (("depth_icp_mm", False), ("depth_icp_similarity_mm", True)):
        if shown.any():
            true_points = rays * expected[:, None]
            motion = register(rays[shown] * z[shown, None], true_points, truth.normals[truth.mask], with_scale)
            moved = np.where(shown, motion.apply(rays * z[:, None])[:, 2], z)
            numbers[key] = float(np.abs(moved - expected).mean())
    return numbers


def _compare_meshes(
    truth: CaptureTruth, true_mesh: trimesh.Trimesh, mesh: trimesh.Trimesh, camera_from_world: Pose, samples: int
) -> Numbers:
    """Compare the whole surfaces above the table by point-to-point distances of samples."""
    board_from_world = truth.camera_from_board.inverse() @ camera_from_world
    mesh.apply_transform(board_from_world.matrix())
    limit = CAPTURE_THRESHOLD * float(np.linalg.norm(true_mesh.extents))
    found, _ = sample_above(mesh, truth.table_mm + CAPTURE_MARGIN_MM, samples, seed=0)
    wanted, faces = sample_above(true_mesh, truth.table_mm + CAPTURE_MARGIN_MM, samples, seed=0)
    if not len(found) or not len(wanted):
        return {"precision": 0.0, "recall": 0.0, "fscore_2pct": 0.0}
    accuracy, complete = KDTree(wanted).query(found)[0], KDTree(found).query(wanted)[0]
    precision, recall = float((accuracy < limit).mean()), float((complete < limit).mean())
    hidden = hidden_from(true_mesh, truth.camera_from_board.matrix(), wanted, true_mesh.face_normals[faces])
    return {
        "precision": precision,
        "recall": recall,
        "hidden_recall": mean_or_none(complete[hidden] < limit),
        "fscore_2pct": f_score(precision, recall),
        "chamfer_mm": float((accuracy.mean() + complete.mean()) / 2),
    }


def _load_mesh(path: Path) -> trimesh.Trimesh:
    """Load a mesh without merging vertices."""
    return trimesh.load_mesh(_existing(path), process=False)


def _json(path: Path) -> dict[str, Any]:
    """Load a JSON file."""
    return json.loads(_existing(path).read_text(encoding="utf-8"))


def _existing(path: Path) -> Path:
    """Return the path after a check that the file exists."""
    if not path.is_file():
        raise ReconstructionError(f"{path.name} is missing in {path.parent}: give the folder of a finished run.")
    return path
