"""Lights from the flashlight phone's own photos of the board: poses and photos made by the formula."""

from dataclasses import replace

import numpy as np
import pytest
from flashlight_photos import POSED_CAMERA, Recipe, handheld_lights, looking_at, photograph

from calibration.board.board import Board
from calibration.board.corners import Corners
from calibration.camera import Camera
from calibration.flashlight.led_photo import BackView, LensReading
from calibration.flashlight.model import Flashlights
from calibration.flashlight.phone import PhoneViews, locate_lights_from_phone, pair_in_order, pair_in_step
from calibration.pose import Pose
from capture.errors import CalibrationError

LENS = Camera(1000, 750, 740.0, 740.0, 507.0, 381.0, (-0.04, 0.03, 0.0, 0.0, 0.0))
OFFSET = np.array([13.0, -6.0, 1.0])  # from the lens to the LED, in the lens's camera frame
TILT = np.array([0.02, -0.015, 1.0])  # the beam in that frame: a degree beside the optical axis
BOARD = Board("checkerboard", 9, 6, 20.0)


def carried(board: Board, n_lights: int, rng: np.random.Generator):
    """Lights at OFFSET from phones that look at the object, and what those phones see of the board."""
    lights, detections = [], []
    for light in handheld_lights(n_lights, rng):
        phone = looking_at(light.position, light.position + 500 * light.axis)
        axis = phone.rotate(TILT / np.linalg.norm(TILT))
        lights.append(replace(light, position=phone.apply(OFFSET), axis=axis))
        pixels = LENS.project(phone.inverse().apply(board.points()))
        detections.append(Corners(pixels + 0.1 * rng.normal(size=pixels.shape), board.points(), board))
    return tuple(lights), detections


@pytest.fixture(scope="module")
def scene():
    lights, detections = carried(BOARD, 10, np.random.default_rng(2))
    return photograph(Recipe(lights=lights)), detections


def locate(truth, detections, **known):
    names = tuple(f"IMG_{200 + i:04d}.jpg" for i in range(len(detections)))
    views = PhoneViews(names, tuple(detections), (LENS.width, LENS.height), 26.0, **known)
    return locate_lights_from_phone(truth.stack, POSED_CAMERA, np.ones(len(truth.lights), bool), views)


def test_the_offset_of_the_led_and_the_positions_are_found(scene):
    truth, detections = scene
    found = locate(truth, detections)
    np.testing.assert_allclose(found.residuals["led_offset_mm"], OFFSET, atol=3)
    assert np.median(truth.errors(found.lights)) < 0.004
    off = np.stack([f.position - t.position for f, t in zip(found.lights, truth.lights, strict=True)])
    assert (np.abs(off) < 2 * np.stack([light.sigma for light in found.lights])).mean() > 0.8


@pytest.mark.slow  # 65 s, for one wrong photo among ten
def test_photos_without_a_board_or_with_wrong_corners_are_filled_by_shading(scene):
    truth, detections = scene
    rng = np.random.default_rng(4)
    patchy = list(detections)
    patchy[2] = None
    wrong = rng.permutation(len(BOARD.points()))
    patchy[6] = replace(detections[6], pixels=detections[6].pixels[wrong])
    found = locate(truth, patchy)
    assert truth.errors(found.lights)[[2, 6]].max() < 0.015
    assert np.median(truth.errors(found.lights)) < 0.005
    assert {"IMG_0002.jpg", "IMG_0006.jpg"}.isdisjoint(found.residuals["phone_photos"])


@pytest.mark.slow  # 30 s; test_phone_back.py has the photo itself
def test_a_photo_of_the_back_tells_the_offset_better_than_toned_pictures_do(scene):
    truth, detections = scene
    toned = photograph(Recipe(lights=truth.lights, tone=0.95))
    lenses = tuple(
        LensReading((100.0 * k, 50.0), (float(OFFSET[1]) + 14.0 * k, -float(OFFSET[0])), 1.5) for k in range(2)
    )
    fitted = locate(toned, detections)
    found = locate(toned, detections, back=BackView("phone_back.jpg", (90.0, 40.0), lenses))
    assert found.residuals["phone_back"]["lens_px"] == (0.0, 50.0)
    by_photo, by_fit = (np.abs(one.residuals["led_offset_mm"][:2] - OFFSET[:2]).max() for one in (found, fitted))
    assert by_photo < 0.2 < by_fit < 1.5
    assert max(np.median(toned.errors(one.lights)) for one in (found, fitted)) < 0.006
    for light, true in zip(found.lights, toned.lights, strict=True):
        assert np.linalg.norm(light.position - true.position) < 3 * np.linalg.norm(light.sigma)


@pytest.mark.parametrize(("rows", "quarters"), [(6, 2), pytest.param(8, 1, marks=pytest.mark.slow)])
def test_a_board_that_looks_alike_from_several_sides_is_turned_to_where_the_shading_says(rows, quarters):
    board = Board("checkerboard", 8, rows, 20.0)
    lights, detections = carried(board, 7, np.random.default_rng(6))
    truth = photograph(Recipe(lights=lights))
    order = np.rot90(np.arange(8 * rows).reshape(rows, 8), quarters).ravel()  # as the corners are then numbered
    turned = [replace(d, pixels=d.pixels[order]) if i % 2 else d for i, d in enumerate(detections)]
    found = locate(truth, turned, led_offset_mm=tuple(OFFSET))
    assert len(found.residuals["phone_photos"]) == 7 and truth.errors(found.lights).max() < 0.01


def test_three_views_of_the_board_are_too_few(scene):
    truth, detections = scene
    with pytest.raises(CalibrationError, match=r"found in 3 of 10 photos .* 4 needed"):
        locate(truth, [*detections[:3], *[None] * 7])


def _handheld(count: int) -> tuple[Flashlights, list[Pose | None]]:
    """Phones around a table, and flashlights where shading misplaces them by a third of their range and more."""
    rng = np.random.default_rng(0)
    angle = rng.permutation(count) * 2 * np.pi / count
    places = 600 * np.column_stack([0.8 * np.cos(angle), 0.8 * np.sin(angle), np.full(count, 0.6)])
    off = places + rng.normal(0, 150, places.shape)
    flashlights = Flashlights(off, np.zeros_like(off), np.zeros(count), np.ones(1), 0.0, np.zeros(3))
    return flashlights, [Pose(np.eye(3), place) for place in places]


def test_where_shading_is_far_off_phone_photos_are_paired_by_their_numbers():
    flashlights, poses = _handheld(20)
    photos, nothing = np.arange(20), np.full(20, -1)
    assert (pair_in_order(poses, flashlights, np.zeros(3), photos) >= 0).sum() < 13
    np.testing.assert_array_equal(pair_in_step(poses, flashlights, np.zeros(3), photos, nothing), photos)
    poses[3] = None
    assert pair_in_step(poses, flashlights, np.zeros(3), photos, nothing)[3] == -1
