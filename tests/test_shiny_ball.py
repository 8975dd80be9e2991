"""A shiny ball in the picture gives the directions of the lights; it is found by itself or named, and is no object."""

import numpy as np
import pytest
import torch
from dataset_folders import calibrated, from_above, towards_lights, write_photo
from synthetic import Box, Look, Sphere, grid_of, render

from calibration.camera import Camera
from calibration.lights.shiny_ball import Circle
from calibration.pose import Pose
from calibration.posed_camera import PosedCamera
from capture.errors import CalibrationError, CaptureError
from reconstruct.fields import SolvedScene
from reconstruct.run.pipeline import without_ball
from reconstruct.source.source import RunOptions, open_source

SIDE, BALL = 240, Circle(178.0, 62.0, 22.0)
LUMP = Sphere((-20.0, -25.0, 30.0), 30.0)


def mirrored(truth, roughness=0.12):
    """The photos with a dark ball painted in, whose lobe about the mirrored light is a Gaussian of `roughness` rad."""
    photos = truth.stack.rgb.copy()
    v, u = np.mgrid[:SIDE, :SIDE]
    across = np.stack([(u - BALL.x) / BALL.radius, -(v - BALL.y) / BALL.radius], -1)
    square = (across**2).sum(-1)
    normal = np.dstack([across, np.sqrt(np.maximum(1 - square, 0))])
    back = 2 * normal[..., 2:] * normal - [0, 0, 1.0]
    for photo, towards in zip(photos, towards_lights(truth), strict=True):
        angle = np.arccos(np.clip(back @ towards, -1, 1))
        shine = 0.015 + 0.9 * np.exp(-0.5 * (angle / roughness) ** 2)
        photo[square <= 1] = shine[square <= 1, None]
    return photos


@pytest.fixture(scope="module")
def photographed():
    look = Look(width=SIDE, height=SIDE, n_lights=8, kind="directional")
    return render((LUMP,), look, from_above(SIDE))[1]


def write_capture(folder, truth, photos):
    for i, rgb in enumerate(photos):
        write_photo(folder / f"shot_{i + 1:02d}.png", rgb)


@pytest.mark.parametrize("is_named", [False, True])
def test_photos_with_a_ball_need_neither_board_nor_list(tmp_path, photographed, is_named):
    write_capture(tmp_path, photographed, mirrored(photographed))
    if is_named:
        (tmp_path / "session.toml").write_text(f"ball = [{BALL.x}, {BALL.y}, {BALL.radius}]\n")
    _, photos, calibration = calibrated(tmp_path)
    found = np.array([light.direction for light in calibration.lights])
    off = np.arccos(np.clip((found * towards_lights(photographed)).sum(-1), -1, 1))
    sigma = np.array([light.sigma[0] for light in calibration.lights])
    assert all(light.used for light in calibration.lights) and (off < 2 * np.sqrt(2) * sigma).all()
    assert np.degrees(off).max() < 5  # half a pixel on a ball of 22 px is 2.6 degrees
    assert any("shiny ball" in note for note in calibration.residuals["notes"])
    mask = photos[0].mask
    assert mask is not None and mask[int(BALL.y), int(BALL.x)] == 0 and mask[150, 100] == 1


def test_without_ball_board_and_list_it_is_said_what_would_do(tmp_path, photographed):
    write_capture(tmp_path, photographed, photographed.stack.rgb)
    with pytest.raises(CaptureError, match=r"Without a board, .*shiny ball in the picture.*give a file of lights"):
        open_source(tmp_path, RunOptions())


def test_a_named_ball_without_highlights_is_refused(tmp_path, photographed):
    write_capture(tmp_path, photographed, mirrored(photographed))
    (tmp_path / "session.toml").write_text("ball = [40, 200, 15]\n")
    with pytest.raises(CalibrationError, match=r"highlight in 0 of 8 photos, 4 were needed"):
        open_source(tmp_path, RunOptions())
    (tmp_path / "session.toml").write_text('ball = "left"\n')
    with pytest.raises(CaptureError, match=r"ball is 'left'; needed: \[x, y, radius\]"):
        open_source(tmp_path, RunOptions())


def test_on_a_known_ground_the_ball_is_cut_from_the_surface():
    """A ball of radius 5 at (10, 0), seen from 1000 above where a pixel is 1 wide on the ground; a cube stays."""
    camera = Camera(100, 100, 1000.0, 1000.0, 49.5, 49.5)
    posed = PosedCamera(camera, Pose(np.diag([1.0, -1.0, -1.0]), np.array([0, 0, 1000.0])), 0.0)
    grid = grid_of((Sphere((10.0, 0.0, 5.0), 5.0), Box((-14.0, -4.0, 0.0), (-6.0, 4.0, 8.0))), 1.0)
    fields = SolvedScene(grid, torch.zeros(100, 100, 3), camera, posed.world_from_camera, 0.0, "scene")
    left = without_ball(fields, (59.5, 49.5, 1.1 * 5), posed).grid
    assert float(left.sdf(torch.tensor([[10.0, 0, 5]]))) > 4 and float(left.sdf(torch.tensor([[10.0, 0, 9.5]]))) > 0
    assert float(left.sdf(torch.tensor([[-10.0, 0, 4]]))) < -3
