"""Compare a result folder with a reference folder whose `gt/` holds the truth; return a dict of measures.

There are two layouts: simulated scenes (`gt/depth.npy`, `gt/mesh.ply`; scene units, known camera) and simulated phone
captures (`gt/maps.npz`, `gt/object.ply`; mm). Of captures the camera is estimated, too, so results are brought to the
frame of the true board by way of the fixed camera, independent of their own world.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from calibration.calibration import Calibration, load_calibration
from calibration.camera import Camera
from calibration.light import Light
from calibration.pose import Pose
from calibration.posed_camera import PosedCamera
from capture.errors import ReconstructionError
from reconstruct.evaluate.score import Numbers, Prediction, Reference, compare_surfaces, compare_views
from reconstruct.evaluate.surface_distance import angle_deg
from reconstruct.stored_run.maps import read_maps, read_mask
from reconstruct.stored_run.ply import read_mesh
from reconstruct.stored_run.stored_run import CALIBRATION, MESH

SAMPLES = 60_000  # points drawn on each surface: the F-score repeats to 0.002
SCENE_LIMIT, CAPTURE_LIMIT = 0.01, 0.02  # of the true bounding-box diagonal, for the F-score
SCENE_MARGIN, CAPTURE_MARGIN_MM = 0.01, 2.0  # above the ground: of the diagonal, and mm; below, nothing is compared
QUARTER_TURNS = {1: 0, 3: 2, 6: 1, 8: -1}  # from the upright truth to the stored frame, by EXIF orientation


def evaluate(result: Path, reference: Path, samples: int | None = None) -> Numbers:
    """Compute all measures that the folder's layout allows. A reconstruction never calls this.

    Args:
        samples: points to draw on each surface; SAMPLES unless given.

    Raises:
        ReconstructionError: a file is missing, or result and reference do not belong together.
    """
    truth_from_world, numbers = Pose(np.eye(3), np.zeros(3)), Numbers()
    if is_capture := (reference / "gt" / "maps.npz").exists():
        found = load_calibration(result / CALIBRATION)
        truth = load_capture_truth(reference, found.camera.width, found.camera.height)
        truth_from_world = truth.posed_camera.world_from_camera @ found.world_from_camera.inverse()
        numbers = {"capture": reference.resolve().name} | _compare_cameras(truth.posed_camera, found)
        numbers |= _compare_lights(truth, found.lights, _json(reference / "gt" / "lights.json"), truth_from_world)
    elif (reference / "gt" / "depth.npy").exists():
        truth, numbers = load_scene_reference(reference), {"scene": reference.resolve().name}
    else:
        raise ReconstructionError(
            f"no truth was found in {reference}: gt/depth.npy (a scene) or gt/maps.npz (a capture) is needed. "
            "Give the folder that holds gt/."
        )
    camera = truth.posed_camera.camera
    maps = read_maps(result, (camera.height, camera.width))
    normals = truth_from_world.rotate(maps.normals.astype(float).reshape(-1, 3))
    numbers |= compare_views(truth, Prediction(maps.depth.astype(float).ravel(), normals, maps.mask.ravel()))
    if truth.mesh is not None:
        diagonal = float(np.linalg.norm(truth.mesh.extents))
        limit, margin = SCENE_LIMIT * diagonal, SCENE_MARGIN * diagonal
        if is_capture:
            limit, margin = CAPTURE_LIMIT * diagonal, CAPTURE_MARGIN_MM
        mesh = read_mesh(result / MESH).apply_transform(truth_from_world.matrix())
        numbers |= compare_surfaces(truth, mesh, limit, margin, samples or SAMPLES)
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
        _mesh(truth / "mesh.ply"),
    )


def load_capture_truth(folder: Path, width: int, height: int) -> Reference:
    """Load the truth of a capture from `folder/gt` for photos of this size (px), upright or as stored; board frame, mm.

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
    camera = Camera(width, height, k[0, 0], k[1, 1], k[0, 2], k[1, 2], (lens[0], lens[1], lens[2], lens[3], lens[4]))
    board_from_camera = Pose.from_matrix(np.array(chosen["T_cam_from_board"], float)).inverse()
    return Reference(
        PosedCamera(camera, board_from_camera, float(_json(truth / "ground.json")["offset_mm"])),
        depth.astype(float).ravel(),
        normals.astype(float).reshape(-1, 3),
        mask.astype(bool).ravel(),
        _mesh(truth / "object.ply"),
    )


def _compare_cameras(truth: PosedCamera, found: Calibration) -> Numbers:
    """Compare the focal length, the ground's normal, and its distance along the optical axis."""
    tilt = angle_deg(truth.world_from_camera.rotation[2:], found.world_from_camera.rotation[2:])
    away, expected = (float(np.linalg.norm(one.looked_at() - one.centre)) for one in (found.posed_camera, truth))
    return {
        "focal_error_pct": 100 * (found.camera.fx / truth.camera.fx - 1),
        "ground_normal_deg": float(tilt[0]),
        "ground_depth_pct": 100 * (away / expected - 1),
    }


def _compare_lights(truth: Reference, found: Sequence[Light], given: dict[str, Any], truth_from_world: Pose) -> Numbers:
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
            expected = np.array(true["position_mm"], float) - centre
            seen = truth_from_world.apply(light.position) - centre
            errors.append(100 * np.linalg.norm(seen - expected) / np.linalg.norm(expected))
            directions.append(angle_deg(expected[None], seen[None])[0])
    numbers: Numbers = {"photos_scored": len(errors), "bad_photos_used": bad_used, "good_photos_dropped": dropped}
    if errors:
        numbers["light_median_pct"] = float(np.median(errors))
        numbers["light_p90_pct"] = float(np.percentile(errors, 90))
        numbers["light_direction_median_deg"] = float(np.median(directions))
    return numbers


def _mesh(path: Path) -> trimesh.Trimesh | None:
    """Load a mesh without merging vertices; None where there is none."""
    return trimesh.load_mesh(path, process=False) if path.exists() else None


def _json(path: Path) -> dict[str, Any]:
    """Load a JSON file."""
    return json.loads(_existing(path).read_text(encoding="utf-8"))


def _existing(path: Path) -> Path:
    """Return the path after a check that the file exists."""
    if not path.is_file():
        raise ReconstructionError(f"{path.name} is missing in {path.parent}: give the folder of a finished run.")
    return path
