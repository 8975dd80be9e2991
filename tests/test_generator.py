"""Generated captures: the renderer, the truth beside it and the formulas agree."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh

from calibration.board.board import parse_board
from calibration.board.corners import find_board
from calibration.camera import Camera
from calibration.pose import Pose
from capture.decode.exif import read_header
from capture.photos.photo import read_photo
from examples.generator.lens import lens_of
from examples.generator.options import Exposure, Flashlight, Further, Phone, Pipeline, Setup, Table, Thing
from examples.generator.photo_file import DARK_ISO, SHUTTER_S, PhotoFile, developed, write_photo
from examples.generator.pipeline import Shutter
from examples.generator.shapes import build

BOARD = "checkerboard:5x4:36"


@pytest.fixture(scope="module")
def capture(renderer, tmp_path_factory):
    """A small capture without noise, room light and bounces."""
    from examples.generator.capturing import make_capture

    mesh = tmp_path_factory.mktemp("mesh") / "ball.ply"
    trimesh.creation.icosphere(subdivisions=3, radius=40).export(mesh)
    setup = Setup(
        Thing(mesh=mesh, albedo=(0.5, 0.5, 0.5)),
        Table(BOARD, table="plain"),
        Phone(width=320),
        Flashlight(photos=3, radius=0.0),
        Exposure(ambient=0.0, indirect=False, noise=0.0, lens_blur=0.0, jpeg=98, samples=16),
        further=Further(board_photos=1),
    )
    out = tmp_path_factory.mktemp("captures") / "ball"
    make_capture(out, setup, lambda text: None)
    return out


def truth(capture, name):
    return json.loads((capture / "gt" / f"{name}.json").read_text())


def seen_points(capture):
    """What each stored pixel sees, in the board's frame (the camera's place: nothing), and the maps by their names."""
    stored = truth(capture, "camera")["stored"]
    with np.load(capture / "gt" / "maps.npz") as file:
        maps = dict(file)
    depth, k = maps["depth_mm"].astype(float), np.array(stored["K"])
    size = depth.shape[::-1]
    lens = Camera(*size, k[0, 0], k[1, 1], k[0, 2], k[1, 2], tuple(stored["dist_k1_k2_p1_p2_k3"]))
    pose = Pose.from_matrix(np.array(stored["T_cam_from_board"])).inverse()
    return pose.apply(lens.unproject(lens.pixel_grid()) * np.where(np.isfinite(depth), depth, 0)[..., None]), maps


def test_a_lens_puts_a_point_where_the_camera_projects_it():
    camera = Camera(160, 120, 170.0, 170.0, 81.0, 58.5, (-0.1, 0.05, 0.0, 0.0, 0.0))
    lens = lens_of(camera, 2)
    point = np.array([[0.31, -0.22, 1.0]])
    u, v = lens.pinhole.project(point)[0]
    rows, columns = np.mgrid[: lens.pinhole.height, : lens.pinhole.width]
    spot = np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / 18).astype(np.float32)
    photo = lens.photo(np.repeat(spot[..., None], 3, 2))[..., 0]
    centre = (photo.ravel() @ camera.pixel_grid().reshape(-1, 2)) / photo.sum()
    assert np.allclose(centre, camera.project(point)[0], atol=0.03)  # px; a wrong half pixel would be 0.25 or more


@pytest.mark.slow
def test_lit_ground_has_the_brightness_of_the_formula(capture):
    lights, (points, maps) = truth(capture, "lights"), seen_points(capture)
    table = maps["table"]
    assert np.allclose(points[table][:, 2], -0.15, atol=1e-3)
    emitter, albedo, everywhere = lights["emitter"], [], table
    for entry in lights["photos"]:
        photo = read_photo(capture / "photos" / entry["file"]).rgb
        away = points - np.array(entry["position_mm"])
        distance = np.linalg.norm(away, axis=-1)
        angle = np.degrees(np.arccos((away / distance[..., None]) @ np.array(entry["axis"])))
        light = np.exp2(-((angle / emitter["half_angle_deg"]) ** 2)) * -away[..., 2] / distance**3 / np.pi
        light = light[..., None] * emitter["exposure_times_I0"] * np.array(emitter["color"])
        lit = cv2.imread(str(capture / "gt/shadow" / f"{entry['file'][:-4]}.png"), cv2.IMREAD_GRAYSCALE) == 255
        inner = cv2.erode((table & lit).astype(np.uint8), np.ones((5, 5))) > 0
        everywhere = everywhere & inner
        albedo.append(photo / light)
        dark = cv2.erode((table & ~lit).astype(np.uint8), np.ones((5, 5))) > 0
        assert dark.sum() > 20 and photo[dark].max() < 0.02
    seen = np.array(albedo)[:, everywhere]
    assert seen.shape[1] > 1000
    assert np.median(seen.std(0) / seen.mean(0)) < 0.02  # one albedo explains all; 8-bit steps are 1 to 2 %


@pytest.mark.parametrize("spec", ["paper:A4", "card"])
@pytest.mark.slow
def test_the_edges_of_a_blank_board_are_rendered_where_the_truth_says(renderer, spec):
    from examples.generator import poses
    from examples.generator.rendering import room, stage

    board = parse_board(spec)
    setup = Setup(Thing(size=60.0), Table(spec, board_stays=True, on_board=True), Phone(width=400))
    thing = poses.stand(build("disc", cells=20), setup, board)
    assert abs(thing.bounds[0, 2]) < 1e-6  # on the sheet, not on the table below it
    view = poses.tripod(setup, board, thing)
    ready = stage(setup, board, thing, view.camera, np.random.default_rng(0))
    picture = room(ready, view, has_thing=False, has_board=True, seed=0).mean(-1)
    grey = np.round(255 * np.clip(picture / picture.max(), 0, 1) ** (1 / 2.2)).astype(np.uint8)
    found = find_board(grey, board)
    assert found is not None and found.across is not None
    truth = view.camera.project(view.world_from_camera.inverse().apply(found.points))
    assert np.abs(((truth - found.pixels) * found.across).sum(1)).mean() < 0.15


# --- the phone's picture pipeline ------------------------------------------------------------------------------------


USUAL = Shutter(SHUTTER_S, DARK_ISO)
CLEAN = Pipeline(pipeline=True, vignetting=0, lift=0, s_curve=0, denoise=0, sharpen=0, pipeline_jpeg=98)
GREY = np.full((120, 160, 3), 0.1, np.float32)


def pipelined(pipeline: Pipeline, seed: int = 0, noise: float = 0.0) -> Setup:
    return Setup(pipeline=pipeline, exposure=Exposure(noise=noise, lens_blur=0.0), seed=seed)


def shot(linear: np.ndarray, setup: Setup, name: str = "IMG_0101"):
    return developed(linear, setup, np.random.default_rng(setup.seed), DARK_ISO, name)


@pytest.mark.parametrize("level", [0.01, 0.1, 0.5])
def test_the_file_tells_the_exposure_that_the_picture_has(tmp_path, level):
    setup = pipelined(replace(CLEAN, white_balance=0.0))
    photo = shot(np.full((90, 120, 3), level, np.float32), setup)
    path = tmp_path / "IMG_0101.jpg"
    write_photo(PhotoFile(path, 31), photo, setup)
    told = read_header(path).exposure
    assert told.iso is not None and told.time_s is not None
    gain = told.iso * told.time_s / (USUAL.iso * USUAL.seconds)
    assert gain == pytest.approx(photo.gain, rel=1e-4)  # EXIF keeps seconds as a fraction
    seen = read_photo(path).rgb.mean()
    assert seen == pytest.approx(min(gain * level, 1), rel=0.02)


def test_white_balance_drift_can_be_read_off_a_grey_sheet():
    setup = pipelined(replace(CLEAN, metering=0.0, white_balance=0.05))
    drifts = []
    for i in range(8):
        photo = shot(GREY, setup, f"IMG_{i:04d}")
        linear = ((photo.pixels / 255 + 0.055) / 1.055) ** 2.4
        assert linear.mean((0, 1)) / 0.1 == pytest.approx(photo.white_balance, rel=0.02)  # 8-bit steps are 1 to 2 %
        drifts.append(photo.white_balance)
    assert np.ptp(np.array(drifts), axis=0)[[0, 2]].min() > 0.03 and np.ptp(np.array(drifts)[:, 1]) == 0
