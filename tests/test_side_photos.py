"""Photos from the side: read, posed by the board, the object cut out; and the object's height from session.toml."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from flashlight_photos import looking_at
from test_session import names, save_capture

from calibration.board.board import Board
from calibration.board.corners import Corners
from calibration.calibration import Calibration, load_calibration, save_calibration
from calibration.camera import Camera
from calibration.ground.shadow_reach import most_height
from calibration.posed_camera import PosedCamera
from calibration.side_photos.ground_look import TripodView, stood_there
from calibration.side_photos.side_views import TripodObject, side_pose
from calibration.side_photos.silhouette import find_silhouette, possible_region, share_shown
from calibration.side_view import SideView
from capture.errors import CalibrationError, CaptureError
from capture.session.declared_objects import Height
from capture.session.session import load_session, load_settings

CAMERA = Camera(480, 360, 420.0, 420.0, 239.5, 179.5)
BALL, RADIUS = np.array([90.0, 60.0, 40.0]), 40.0
FOOT = BALL * [1, 1, 0]
EYE, SIDE = np.array([0.0, -420.0, 330.0]), np.array([460.0, -60.0, 240.0])


PALE, BLACK = np.array([0.42, 0.40, 0.38]), np.array([0.006, 0.005, 0.006])


def picture(eye, rng, ball=True, colour=PALE):
    """A table of coarse grain, a ball and its soft shadow, in room light; and where the ball is."""
    camera = PosedCamera(CAMERA, looking_at(eye, np.array([60.0, 40.0, 20.0])), 0.0)
    rays = camera.rays(CAMERA.pixel_grid())
    table = camera.on_ground(CAMERA.pixel_grid())
    grain = np.sin(table[..., 0] / 4 + 2 * np.sin(table[..., 1] / 31)) + np.sin(table[..., 1] / 9)
    rgb = np.array([0.30, 0.18, 0.10]) * np.exp(0.2 * grain)[..., None]
    along = (BALL - eye) @ np.moveaxis(rays, -1, 0).reshape(3, -1) / (rays**2).sum(-1).ravel()
    miss = np.linalg.norm(eye + along[:, None] * rays.reshape(-1, 3) - BALL, axis=1).reshape(rays.shape[:2])
    if ball:
        near = np.linalg.norm(table[..., :2] - BALL[:2], axis=-1)
        rgb *= (1 - 0.6 * np.exp(-((near / 30) ** 2)))[..., None]
        shade = np.sqrt(np.clip(1 - (miss / RADIUS) ** 2, 0, 1))
        rgb[miss < RADIUS] = (colour * (0.5 + 0.5 * shade)[..., None])[miss < RADIUS]
    noisy = rgb * np.exp(0.02 * rng.standard_normal(rgb.shape))
    return np.clip(noisy, 0, 1).astype(np.float32), camera, miss < RADIUS


def test_photos_in_side_and_the_height_are_read(tmp_path):
    folder, _, _ = save_capture(tmp_path, in_folders=True)
    (folder / "side").mkdir()
    for i in range(2):
        (folder / "side" / f"S{i}.jpg").write_bytes((folder / "board" / f"IMG_{8 + i}.jpg").read_bytes())
    (folder / "session.toml").write_text('height = "120 +- 2"\n')
    session = load_session(folder)
    assert names(session.side) == ["S0.jpg", "S1.jpg"]
    assert session.settings.height == Height(120.0, 2.0)


@pytest.mark.parametrize("text", ["0", "-3", "true", '"tall"', '"1 +- 0"', "[1, 2]", "nan"])
def test_a_height_that_is_none_is_refused(tmp_path, text):
    (tmp_path / "session.toml").write_text(f"height = {text}\n")
    with pytest.raises(CaptureError, match=r"height is .*millimetres above the table"):
        load_settings(tmp_path)


def test_the_pose_is_found_although_the_phone_has_refocused():
    board = Board("checkerboard", 9, 6, 24.0)
    points = board.points()
    pose = looking_at(np.array([330.0, -260.0, 250.0]), points.mean(0))
    refocused = replace(CAMERA, fx=CAMERA.fx * 1.015, fy=CAMERA.fy * 1.015)
    rng = np.random.default_rng(0)
    pixels = refocused.project(pose.inverse().apply(points)) + 0.1 * rng.standard_normal((len(points), 2))
    about = points + np.array([0.0, 90.0, 40.0])
    tripod = PosedCamera(CAMERA, pose, 0.0)
    found = side_pose(Corners(pixels, points, board), tripod, about)
    assert not isinstance(found, str)
    seen = found[0].project(about)
    off = np.linalg.norm(seen - refocused.project(pose.inverse().apply(about)), axis=1).mean()
    assert off < 3 * found[1] < 3.0
    blurred = replace(Corners(pixels, points, board), pixels=pixels + 8 * rng.standard_normal(pixels.shape))
    assert "that the photo is sharp" in str(side_pose(blurred, tripod, about))


@pytest.mark.parametrize(("stood", "colour"), [(False, PALE), (True, PALE), (True, BLACK)])
def test_the_object_is_cut_out_of_grain_and_shadow(stood, colour):
    rng = np.random.default_rng(1)
    table, tripod, mask = picture(EYE, rng, stood, colour)
    lit = np.log(picture(EYE, rng, colour=colour)[0].mean(-1))
    assert stood_there(table, lit, mask) == stood
    photo, camera, truth = picture(SIDE, rng, colour=colour)
    behind = tripod.on_ground(CAMERA.pixel_grid()[mask])
    region = possible_region(camera, behind, EYE, 2.5 * RADIUS)
    assert region[truth].mean() > 0.99
    found = find_silhouette(photo, camera, region, TripodView(tripod, table, mask & stood), FOOT)
    assert found is not None
    left, top, width, height = found.window
    part = truth[top : top + height, left : left + width].astype(np.uint8)
    true = cv2.resize(part, found.mask.shape[::-1], interpolation=cv2.INTER_AREA) > 0
    assert (found.mask & true).sum() > 0.93 * (found.mask | true).sum()
    assert (found.sure & (found.mask != true)).sum() < 0.05 * true.sum()
    assert found.sure_outline() > 0.25
    assert share_shown(found, camera, behind, EYE, 2.5 * RADIUS) > 0.95
    right = np.arange(found.mask.shape[1]) > np.quantile(np.nonzero(found.mask)[1], 0.8)
    assert share_shown(replace(found, mask=found.mask & right), camera, behind, EYE, 2.5 * RADIUS) < 0.8


def test_the_whole_object_is_looked_for_where_the_tripods_silhouette_lacks_its_top():
    rng = np.random.default_rng(1)
    table, tripod, mask = picture(EYE, rng, ball=False)
    _, camera, truth = picture(SIDE, rng)
    mask &= np.arange(len(mask))[:, None] > np.flatnonzero(mask.any(1)).mean()
    seen = TripodObject(tripod, Path("IMG_1.jpg"), mask, np.log(table.mean(-1)))
    outline, reach = seen.outline, seen.reach
    assert np.abs(reach[reach[:, 2] < 0.01, 2]).max() < 1e-6 and reach[:, 2].min() > -1e-6
    top = most_height(EYE, outline, reach)
    assert most_height(EYE, outline) < 2 * RADIUS < top
    assert possible_region(camera, outline, EYE, most_height(EYE, outline))[truth].mean() < 0.9
    assert possible_region(camera, reach, EYE, top)[truth].all()


def test_a_table_without_an_object_has_no_silhouette():
    rng = np.random.default_rng(2)
    table, tripod, mask = picture(EYE, rng, ball=False)
    photo, camera, _ = picture(SIDE, rng, ball=False)
    region = possible_region(camera, tripod.on_ground(CAMERA.pixel_grid()[mask]), EYE, 2.5 * RADIUS)
    assert find_silhouette(photo, camera, region, TripodView(tripod, table, np.zeros_like(mask)), FOOT) is None


def test_side_views_are_saved_with_the_calibration(tmp_path):
    mask = np.zeros((40, 50), bool)
    mask[10:30, 12:31] = True
    posed = PosedCamera(CAMERA, looking_at(SIDE, BALL), 0.0)
    view = SideView("IMG_5.jpg", posed, (20, 30, 100, 80), mask, ~mask, 0.4)
    saved = Calibration.of(PosedCamera(CAMERA, looking_at(EYE, BALL), 0.0), (), side_views=(view,))
    save_calibration(saved, tmp_path / "calibration.json")
    loaded = load_calibration(tmp_path / "calibration.json")
    assert loaded == saved
    assert np.array_equal(loaded.side_views[0].mask, mask)
    text = (tmp_path / "calibration.json").read_text()
    (tmp_path / "wrong.json").write_text(text.replace('"size": [', '"size": [9, '))
    with pytest.raises(CalibrationError, match=r"side_views\[0\].size is .*needed: width and height"):
        load_calibration(tmp_path / "wrong.json")
