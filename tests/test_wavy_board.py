"""Boards printed on sheets that do not lie flat: the waves are found with the camera, and sigmas cover what is left."""

import numpy as np
import pytest
from board_photos import corners_of, look_at, slanted

from calibration.board.board import parse_board
from calibration.board.corners import Corners
from calibration.board.intrinsics import fit_camera
from calibration.board.sheet import USUAL_SIZE, sheet_of, weigh_waves
from calibration.camera import Camera

BOARDS = [parse_board(text) for text in ("charuco:5x7:30:22:DICT_4X4_50", "checkerboard:9x6:24.25")]
SIZE = (1000, 750)
CAMERA = Camera(*SIZE, 1000.0, 1000.0, 503.0, 371.0)


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
