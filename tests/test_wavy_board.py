"""Boards printed on sheets that do not lie flat: the waves are found with the camera, and sigmas cover what is left."""

from dataclasses import dataclass

import numpy as np
import pytest
from board_photos import corners_of, look_at, slanted

from calibration.board.board import parse_board
from calibration.board.board_pose import GroundFit, fit_ground
from calibration.board.corners import Corners
from calibration.board.intrinsics import CameraFit, fit_camera
from calibration.board.sheet import USUAL_SIZE, sheet_of, weigh_waves
from calibration.camera import Camera
from calibration.pose import Pose
from capture.decode.exif import FULL_FRAME_DIAGONAL

BOARDS = [parse_board(text) for text in ("charuco:5x7:30:22:DICT_4X4_50", "checkerboard:9x6:24.25")]
SIZE = (1000, 750)
LENSES = (
    (780.0, (-0.12, 0.05, 0.0, 0.0, 0.0)),
    (1000.0, (0.06, -0.08, 0.0, 0.0, 0.0)),
    (1350.0, (0.0, 0.0, 0.0, 0.0, 0.0)),
)
CAMERA = Camera(*SIZE, 1000.0, 1000.0, 503.0, 371.0)


@dataclass(frozen=True)
class Outcome:
    """A fit and the truth."""

    fit: CameraFit
    ground: GroundFit
    camera: Camera
    world_from_camera: Pose  # of the first photo; the table is z = 0

    def pulls(self) -> list[float]:
        """Errors over sigma: focal length, centre, normal and height."""
        found, sigmas = self.fit.camera, self.fit.camera.sigmas
        pose, truth = self.ground.world_from_camera, self.world_from_camera
        tilt = np.arccos(np.clip(pose.rotation[2] @ truth.rotation[2], -1, 1))
        height = pose.translation[2] - truth.translation[2]
        centre = [(getattr(found, k) - getattr(self.camera, k)) / sigmas[k] for k in ("fx", "cx", "cy")]
        return [*centre, tilt / self.ground.normal_sigma_rad, height / self.ground.height_sigma_mm]

    def focal_error(self) -> float:
        """Relative."""
        return self.fit.camera.fx / self.camera.fx - 1


def sheet_heights(rng, points, size_mm):
    """Heights above the table of a sheet that lies on it: four waves of 60 to 500 mm, as large as size_mm says."""
    margin = 30.0
    low, high = points.min(0)[:2] - margin, points.max(0)[:2] + margin
    over = np.stack(np.meshgrid(*np.linspace(low, high, 25).T), -1).reshape(-1, 2)
    places = np.concatenate([over, points[:, :2]])
    heights = np.zeros(len(places))
    for _ in range(4):
        length, azimuth, phase = np.exp(rng.uniform(*np.log([60, 500]))), *rng.uniform(0, 2 * np.pi, 2)
        along = places @ [np.cos(azimuth), np.sin(azimuth)]
        heights += rng.normal() * np.cos(2 * np.pi * along / length + phase)
    return (heights[len(over) :] - heights[: len(over)].min()) * size_mm / np.sqrt(2)


def outcome(seed, size_mm):
    """Three to eight photos of a sheet with waves of this size (standard deviation) and the fit to them."""
    rng = np.random.default_rng(seed)
    board, (focal, bends) = BOARDS[seed % 2], LENSES[seed % 3]
    focal *= np.exp(rng.normal(0, 0.02))
    centre = (np.array(SIZE) - 1) / 2 + rng.normal(0, 6, 2)
    camera = Camera(*SIZE, focal, focal, float(centre[0]), float(centre[1]), bends)
    points = board.points()
    lifted = points + np.outer(sheet_heights(rng, points, size_mm), [0.0, 0.0, 1.0])
    noise, photos, poses = rng.uniform(0.04, 0.08), [], []
    for index in range(rng.integers(3, 9)):
        aim = points.mean(0) + np.append(rng.uniform(-30, 30, 2), 0)
        tilt, distance = rng.uniform(0.5 if index == 0 else 0.2, 1.0), focal * rng.uniform(0.42, 0.65)
        poses.append(slanted(rng, tilt, distance, aim))
        pixels = camera.project(poses[-1].inverse().apply(lifted)) + rng.normal(0, noise, (len(points), 2))
        inside = ((pixels > 0) & (pixels < SIZE)).all(1)
        photos.append(Corners(pixels[inside], points[inside], board))
    exif = focal * np.exp(rng.normal(0, 0.02)) * FULL_FRAME_DIAGONAL / np.hypot(*SIZE)
    fit = fit_camera(photos, SIZE, exif)
    ground = fit_ground(fit.on_sheet(photos[0]), fit.camera, fit.pose_spread(0))
    return Outcome(fit, ground, camera, poses[0])


@pytest.mark.slow
@pytest.mark.parametrize("size_mm", [0.0, 0.05, 0.3])
def test_errors_lie_within_their_sigmas_however_wavy_the_sheet_is(size_mm):
    found = [outcome(seed, size_mm) for seed in range(20)]
    pulls = np.abs([one.pulls() for one in found])
    assert ((pulls < 2).mean(0) >= 0.9).all()
    assert (np.sqrt((pulls**2).mean(0)) > 0.4).all()  # nor are they much too wide
    assert (
        np.sqrt(np.mean([one.focal_error() ** 2 for one in found])) < 0.0035
    )  # 0.006 and more where it counts as flat
    if size_mm == 0:
        assert all(one.fit.waves_mm() == 0 for one in found)


def test_the_heights_of_a_sheet_are_found_and_stand_on_the_table():
    rng = np.random.default_rng(3)
    board = BOARDS[0]
    heights = sheet_heights(rng, board.points(), 0.3)
    lifted = board.points() + np.outer(heights, [0.0, 0.0, 1.0])
    photos = []
    for tilt in (0.9, 0.7, 0.8, 0.6):
        pixels = CAMERA.project(slanted(rng, tilt, 520).inverse().apply(lifted)) + rng.normal(0, 0.05, (24, 2))
        photos.append(Corners(pixels, board.points(), board))
    fit = fit_camera(photos, SIZE, None)
    found = fit.on_sheet(photos[0]).points[:, 2]
    plane = np.column_stack([np.ones(24), board.points()[:, :2]])
    bends = [z - plane @ np.linalg.lstsq(plane, z, rcond=None)[0] for z in (heights, found)]
    assert np.abs(bends[1] - bends[0]).max() < 0.2 * np.ptp(bends[0])
    assert -0.1 < found.min() < 0.02
    assert any("wavy" in note for note in fit.notes)


def test_waves_that_no_photo_tells_of_are_as_large_as_those_of_sheets_usually_are():
    sheet = sheet_of([corners_of(BOARDS[0], CAMERA, look_at((75.0, -105.0, 500.0)))])
    assert sheet is not None
    k = sheet.basis.shape[1]
    unknown = weigh_waves(sheet, np.zeros(k), np.zeros((k, k)), 48.0, 48.0, 0.05)
    assert unknown.size == 0 and unknown.possible == pytest.approx(USUAL_SIZE, rel=0.05)
