"""Truth against itself scores zero, and a known change scores that change."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from flashlight_photos import looking_at
from scipy.spatial.transform import Rotation

from calibration.calibration import Calibration, save_calibration
from calibration.camera import Camera
from calibration.light import Light
from calibration.pose import Pose
from capture.errors import ReconstructionError
from reconstruct.evaluate.metrics import evaluate
from reconstruct.evaluate.surface_distance import hidden_from

SIDE, FOCAL = 80, 150.0
SAMPLES = 10_000  # on each surface: a tenth of the real measure, for speed
EYE = np.array([0.0, -3.0, 2.5])
POSE = looking_at(EYE, np.zeros(3))


def ball(radius: float = 0.5, centre=(0.0, 0.0, 0.2)) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    mesh.apply_translation(centre)
    return mesh


def maps_of(radius: float, centre, ground: float, camera: Camera, pose: Pose) -> tuple[np.ndarray, ...]:
    """Depth, normal and mask of a ball on a plane."""
    rays, away = pose.rotate(camera.unproject(camera.pixel_grid())), pose.translation - centre
    a, b = (rays**2).sum(-1), rays @ away
    inside = b**2 - a * (away @ away - radius**2)
    ball = np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0))) / a, np.inf)
    plane = (ground - pose.translation[2]) / rays[..., 2]
    mask, depth = ball < plane, np.minimum(ball, plane)
    normals = np.where(mask[..., None], (away + depth[..., None] * rays) / radius, [0, 0, 1.0])
    return depth, normals, mask


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    """A ball half sunk in a ground at z = 0, in the layout of the known scenes."""
    folder = tmp_path_factory.mktemp("scene")
    truth = folder / "gt"
    truth.mkdir()
    camera, pose, mesh = Camera(SIDE, SIDE, FOCAL, FOCAL, SIDE / 2 - 0.5, SIDE / 2 - 0.5), POSE, ball()
    depth, normals, mask = maps_of(0.5, (0.0, 0.0, 0.2), 0.0, camera, pose)
    np.save(truth / "depth.npy", depth.astype(np.float32))
    np.save(truth / "normal.npy", normals.astype(np.float32))
    cv2.imwrite(str(truth / "mask.png"), mask.astype(np.uint8) * 255)
    k = [[FOCAL, 0, SIDE / 2], [0, FOCAL, SIDE / 2], [0, 0, 1]]
    given = {"width": SIDE, "height": SIDE, "K": k, "world_from_camera": pose.matrix().tolist()}
    (truth / "camera.json").write_text(json.dumps(given))
    (truth / "ground.json").write_text(json.dumps({"type": "plane", "z": 0.0}))
    mesh.export(truth / "mesh.ply")
    return folder


def save_result(folder: Path, mesh: trimesh.Trimesh, depth, normals, mask) -> Path:
    mesh.export(folder / "mesh.ply")
    np.save(folder / "depth.npy", depth)
    np.save(folder / "normal.npy", normals)
    cv2.imwrite(str(folder / "mask.png"), mask.astype(np.uint8) * 255)
    return folder


def test_the_truth_against_itself_is_without_error_and_a_constant_depth_more_scores_that(scene, tmp_path):
    depth, normals = np.load(scene / "gt/depth.npy"), np.load(scene / "gt/normal.npy")
    mask = cv2.imread(str(scene / "gt/mask.png"), cv2.IMREAD_GRAYSCALE) > 0
    numbers = evaluate(save_result(tmp_path, ball(), depth, normals, mask), scene, SAMPLES)
    assert numbers["mask_iou"] == 1
    assert numbers["depth_mae"] < 1e-5  # float32 files
    assert numbers["normal_mae_deg"] < 0.01
    assert min(numbers["fscore"], numbers["hidden_recall"]) > 0.999  # a sliver in 10000 samples may be missed
    assert numbers["chamfer"] < 5e-3  # about half the distance between samples
    depth = np.where(mask, depth - 0.03, depth)
    numbers = evaluate(save_result(tmp_path, ball(), depth, normals, mask), scene, SAMPLES)
    assert numbers["depth_mae"] == pytest.approx(0.03, abs=1e-5)


def test_a_mesh_without_its_back_loses_what_the_camera_cannot_see_and_missed_pixels_count_as_the_ground(
    scene, tmp_path
):
    mesh = ball()
    mesh.update_faces(~hidden_from(mesh, POSE.inverse().matrix(), mesh.triangles_center, mesh.face_normals))
    depth, normals = np.load(scene / "gt/depth.npy"), np.load(scene / "gt/normal.npy")
    numbers = evaluate(save_result(tmp_path, mesh, depth, normals, np.zeros((SIDE, SIDE))), scene, SAMPLES)
    assert numbers["visible_recall"] > 0.97
    assert numbers["hidden_recall"] < 0.3
    assert (numbers["mask_iou"], numbers["normal_mae_deg"] > 20, numbers["depth_mae"] > 0.1) == (0, True, True)


def write_capture(folder: Path, world_from_board: Pose) -> tuple[Path, Path]:
    """A reference in the layout of the captures and a perfect result whose world lies elsewhere than the board's."""
    reference, result = folder / "capture", folder / "result"
    truth = reference / "gt"
    truth.mkdir(parents=True)
    result.mkdir()
    camera = Camera(SIDE, SIDE, FOCAL, FOCAL, 40.0, 39.0, (0.05, -0.02, 0.0, 0.0, 0.0))
    board_from_camera = Pose(POSE.rotation, 100 * EYE)
    mesh = ball(50, (0, 0, 20))
    depth, normals, mask = maps_of(50, (0, 0, 20), -0.2, camera, board_from_camera)
    np.savez(truth / "maps.npz", depth_mm=depth, normal=normals.astype(np.float16), mask=mask)
    camera_from_board = board_from_camera.inverse().matrix().tolist()
    lens = {"K": camera.matrix().tolist(), "dist_k1_k2_p1_p2_k3": camera.distortion}
    (truth / "camera.json").write_text(
        json.dumps({"width": SIDE, "height": SIDE, "T_cam_from_board": camera_from_board} | lens)
    )
    (truth / "ground.json").write_text(json.dumps({"normal": [0, 0, 1], "offset_mm": -0.2}))
    places = [[100.0 * i, 50.0, 400.0] for i in range(4)]
    photos = [{"file": f"p{i}.jpg", "position_mm": p, "usable": i != 3} for i, p in enumerate(places)]
    (truth / "lights.json").write_text(json.dumps({"photos": photos}))
    mesh.export(truth / "object.ply")

    lights = tuple(
        Light(f"p{i}.jpg", "point", position=world_from_board.apply(np.array(p)), used=i != 0)
        for i, p in enumerate(places)
    )
    ground = float(world_from_board.apply(np.array([0, 0, -0.2]))[2])
    found = Calibration(camera, world_from_board @ board_from_camera, ground, lights)
    save_calibration(found, result / "calibration.json")
    mesh.apply_transform(world_from_board.matrix())
    save_result(result, mesh, depth.astype(np.float32), world_from_board.rotate(normals), mask)
    return result, reference


def test_a_perfect_capture_is_without_error_wherever_its_world_lies_but_for_photos_wrongly_used_and_dropped(tmp_path):
    world = Pose(Rotation.from_rotvec([0.0, 0.0, np.pi]).as_matrix(), np.array([30.0, -20.0, 5.0]))
    numbers = evaluate(*write_capture(tmp_path, world), SAMPLES)
    for key in ("ground_normal_deg", "ground_depth_pct", "light_median_pct", "depth_mae"):
        assert abs(numbers[key]) < 1e-3, key
    assert numbers["normal_mae_deg"] < 0.05  # the truth is in float16
    assert (numbers["mask_iou"], numbers["focal_error_pct"], numbers["fscore"]) == (1, 0, 1)
    assert (numbers["bad_photos_used"], numbers["good_photos_dropped"]) == (["p3.jpg"], ["p0.jpg"])
    assert numbers["photos_scored"] == 2


def test_missing_and_foreign_files_are_named(scene, tmp_path):
    with pytest.raises(ReconstructionError, match="no truth was found"):
        evaluate(tmp_path, tmp_path)
    with pytest.raises(ReconstructionError, match=r"depth\.npy is missing"):
        evaluate(tmp_path, scene, SAMPLES)
    small = np.ones((4, 4), np.float32)
    save_result(tmp_path, ball(), small, np.ones((4, 4, 3)), small)
    with pytest.raises(ReconstructionError, match=r"\(4, 4\).*\(80, 80\) were needed"):
        evaluate(tmp_path, scene, SAMPLES)
