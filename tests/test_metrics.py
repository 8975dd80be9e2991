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
from reconstruct.evaluate.surface_distance import hidden_from, nmze, register, seen_from

SIDE, FOCAL = 80, 150.0
SAMPLES = 10_000  # on each surface: a tenth of the real measure, for speed
EYE = np.array([0.0, -3.0, 2.5])
POSE = looking_at(EYE, np.zeros(3))


def ball(radius: float = 0.5, centre=(0.0, 0.0, 0.2)) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    mesh.apply_translation(centre)
    return mesh


def maps_of(mesh: trimesh.Trimesh, ground: float, camera: Camera, pose: Pose) -> tuple[np.ndarray, ...]:
    """Depth, normal and mask of a mesh on a plane."""
    through = camera.unproject(camera.pixel_grid())
    depth, face = seen_from(mesh, pose.inverse().matrix(), through.reshape(-1, 3)[:, :2])
    plane = (ground - pose.translation[2]) / pose.rotate(through)[..., 2].ravel()
    mask = depth < plane
    normals = np.where(mask[:, None], mesh.face_normals[face], [0, 0, 1.0])
    shape = (camera.height, camera.width)
    return np.where(mask, depth, plane).reshape(shape), normals.reshape(*shape, 3), mask.reshape(shape)


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    """A ball half sunk in a ground at z = 0, in the layout of the known scenes."""
    folder = tmp_path_factory.mktemp("scene")
    truth = folder / "gt"
    truth.mkdir()
    camera, pose, mesh = Camera(SIDE, SIDE, FOCAL, FOCAL, SIDE / 2 - 0.5, SIDE / 2 - 0.5), POSE, ball()
    depth, normals, mask = maps_of(mesh, 0.0, camera, pose)
    np.save(truth / "depth.npy", depth.astype(np.float32))
    np.save(truth / "normal.npy", normals.astype(np.float32))
    cv2.imwrite(str(truth / "mask.png"), mask.astype(np.uint8) * 255)
    k = [[FOCAL, 0, SIDE / 2], [0, FOCAL, SIDE / 2], [0, 0, 1]]
    given = {"width": SIDE, "height": SIDE, "K": k, "world_from_camera": pose.matrix().tolist()}
    (truth / "camera.json").write_text(json.dumps(given))
    (truth / "ground.json").write_text(json.dumps({"type": "plane", "z": 0.0}))
    mesh.export(truth / "mesh.ply")
    return folder


def save_result(folder: Path, mesh: trimesh.Trimesh, depth=None, normals=None, mask=None) -> Path:
    mesh.export(folder / "mesh.ply")
    if depth is not None:
        np.save(folder / "depth.npy", depth)
        np.save(folder / "normal.npy", normals)
        cv2.imwrite(str(folder / "mask.png"), mask.astype(np.uint8) * 255)
    return folder


def test_the_truth_against_itself_is_without_error_and_a_constant_depth_more_scores_that_until_it_is_shifted(
    scene, tmp_path
):
    depth, normals = np.load(scene / "gt/depth.npy"), np.load(scene / "gt/normal.npy")
    mask = cv2.imread(str(scene / "gt/mask.png"), cv2.IMREAD_GRAYSCALE) > 0
    numbers = evaluate(save_result(tmp_path, ball(), depth, normals, mask), scene, SAMPLES)
    for found in (numbers, numbers["maps"]):
        assert found["mask_iou"] == 1
        for key in ("depth_l1_raw", "depth_l1_shift", "depth_l1_icp", "depth_l1_icp_similarity", "nmze", "nmze_1_99"):
            assert found[key] < 1e-5, key  # float32 files
        assert found["normal_mae_deg"] < 0.01
    assert min(numbers["fscore"], numbers["hidden_recall"]) > 0.999  # a sliver in 10000 samples may be missed
    assert numbers["chamfer"] < 5e-3  # about half the distance between samples
    depth = np.where(mask, depth - 0.03, depth)
    numbers = evaluate(save_result(tmp_path, ball(), depth, normals, mask), scene, SAMPLES)["maps"]
    assert numbers["depth_l1_raw"] == pytest.approx(0.03, abs=1e-5)
    assert numbers["depth_l1_shift"] < 1e-5
    assert numbers["depth_l1_icp"] < 0.003


def test_a_mesh_without_its_back_loses_what_the_camera_cannot_see(scene, tmp_path):
    mesh = ball()
    mesh.update_faces(~hidden_from(mesh, POSE.inverse().matrix(), mesh.triangles_center, mesh.face_normals))
    numbers = evaluate(save_result(tmp_path, mesh), scene, SAMPLES)
    assert numbers["visible_recall"] > 0.97
    assert numbers["hidden_recall"] < 0.3
    assert numbers["depth_l1_raw"] < 1e-3


def test_one_wild_pixel_rules_the_plain_nmze_and_not_the_trimmed_one():
    truth = np.linspace(1, 2, 1000)
    wild = truth.copy()
    wild[500] = 3.0
    assert nmze(truth, truth) == 0
    assert nmze(3 * truth + 1, truth) == pytest.approx(0, abs=1e-12)
    assert nmze(wild, truth) == pytest.approx(0.25, abs=0.01)
    assert nmze(wild, truth, trim=1.0) < 0.01


@pytest.mark.parametrize("scale", [1.0, 1.1])
def test_the_icp_finds_a_known_motion(scale):
    rng = np.random.default_rng(0)
    points, faces = trimesh.sample.sample_surface(trimesh.creation.box([1.0, 0.7, 0.5]), 4000, seed=0)
    normals = trimesh.creation.box([1.0, 0.7, 0.5]).face_normals[faces]
    turn = Rotation.from_rotvec([0.05, -0.03, 0.04]).as_matrix()
    moved = (np.asarray(points) - [0.02, 0.01, -0.03]) @ turn / scale
    motion = register(moved[rng.permutation(len(moved))], np.asarray(points), normals, with_scale=scale != 1)
    assert np.abs(motion.apply(moved) - points).max() < 2e-3
    assert motion.scale == pytest.approx(scale, abs=2e-3)


def write_capture(folder: Path, world_from_board: Pose) -> tuple[Path, Path]:
    """A reference in the layout of the captures and a perfect result whose world lies elsewhere than the board's."""
    reference, result = folder / "capture", folder / "result"
    truth = reference / "gt"
    truth.mkdir(parents=True)
    result.mkdir()
    camera = Camera(SIDE, SIDE, FOCAL, FOCAL, 40.0, 39.0, (0.05, -0.02, 0.0, 0.0, 0.0))
    board_from_camera = Pose(POSE.rotation, 100 * EYE)
    mesh = ball(50, (0, 0, 20))
    depth, normals, mask = maps_of(mesh, -0.2, camera, board_from_camera)
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
    for key in ("ground_normal_deg", "ground_depth_pct", "light_median_pct", "depth_mae_mm", "depth_icp_mm"):
        assert abs(numbers[key]) < 1e-3, key
    assert numbers["normal_mae_deg"] < 0.05  # the truth is in float16
    assert (numbers["mask_iou"], numbers["focal_error_pct"], numbers["fscore_2pct"]) == (1, 0, 1)
    assert (numbers["bad_photos_used"], numbers["good_photos_dropped"]) == (["p3.jpg"], ["p0.jpg"])
    assert numbers["photos_scored"] == 2


def test_missing_and_foreign_files_are_named(scene, tmp_path):
    with pytest.raises(ReconstructionError, match="no truth was found"):
        evaluate(tmp_path, tmp_path)
    with pytest.raises(ReconstructionError, match=r"mesh\.ply is missing"):
        evaluate(tmp_path, scene, SAMPLES)
    small = np.ones((4, 4), np.float32)
    save_result(tmp_path, ball(), small, np.ones((4, 4, 3)), small)
    with pytest.raises(ReconstructionError, match=r"\(4, 4\).*\(80, 80\) were needed"):
        evaluate(tmp_path, scene, SAMPLES)
