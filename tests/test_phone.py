"""Lights from the flashlight phone's own photos of the board: poses and photos made by the formula."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from flashlight_photos import POSED_CAMERA, Recipe, handheld_lights, looking_at, photograph
from phone_backs import BOARD as BESIDE
from phone_backs import BackOfPhone, back_photo, save_back

from calibration.board.board import Board
from calibration.board.corners import Corners
from calibration.camera import Camera
from calibration.flashlight.led_photo import BackView, LensReading, choose, in_lens_frame, read_phone_back
from calibration.flashlight.model import Flashlights
from calibration.flashlight.phone import PhoneViews, locate_lights_from_phone, pair_in_order, pair_in_step
from calibration.pose import Pose
from capture.errors import CalibrationError, CaptureError
from capture.session.declared_objects import PhoneBack
from capture.session.session import load_session, load_settings

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


@pytest.mark.slow  # 30 s; the photo itself is read below
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


# --- the LED beside the lens, from a photo of the phone's back -------------------------------------------------------


THREE = BackOfPhone(lenses=((-22.0, 60.0, 6.5), (-22.0, 44.0, 6.5), (-8.0, 40.0, 5.5)))
OFFSETS = np.array([[10.0, -8.0], [10.0, 8.0], [-4.0, 12.0]])  # from each lens to the LED, x and y of the back


def read(tmp_path: Path, phone: BackOfPhone | np.ndarray, given: PhoneBack | None = None) -> BackView:
    path = save_back(tmp_path / "phone_back.png", back_photo(phone) if isinstance(phone, BackOfPhone) else phone)
    return read_phone_back(path, BESIDE, given or PhoneBack())


def offsets(view: BackView) -> np.ndarray:
    return np.array([lens.offset_mm for lens in view.lenses])


def nearest(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    return np.linalg.norm(found[:, None] - true[None], axis=2).min(0)


@pytest.mark.parametrize("shade", [35.0, 215.0])
def test_led_and_lens_are_found_on_dark_and_bright_backs(tmp_path, shade):
    view = read(tmp_path, BackOfPhone(shade=shade))
    assert len(view.lenses) == 1
    assert nearest(offsets(view), OFFSETS[:1])[0] < 0.5
    assert 0.5 < view.lenses[0].sigma_mm < 1.2


@pytest.mark.slow
def test_the_shading_tells_the_main_lens_of_three(tmp_path):
    true = in_lens_frame((10.0, 8.0), 0)  # the second lens of a phone that points to the board's top
    fitted = true + np.array([1.5, -2.0, 4.0])  # as well as the shading tells
    choice = choose(read(tmp_path, THREE), fitted, 2.0)
    assert choice.offset_mm is not None, choice.why
    np.testing.assert_allclose(choice.offset_mm[:2], true[:2], atol=0.7)
    assert 0 < choice.offset_mm[2] < 2  # of the 4 mm that the shading says


def test_lenses_that_fit_alike_and_those_that_contradict_the_shading_are_refused():
    lenses = (LensReading((100.0, 200.0), (10.0, 8.0), 1.5), LensReading((140.0, 200.0), (4.0, 8.0), 1.5))
    alike = choose(BackView("phone_back.jpg", (1.0, 2.0), lenses), in_lens_frame((7.0, 8.0), 0), 2.0)
    assert alike.offset_mm is None
    assert "[100, 200]" in alike.why and "[140, 200]" in alike.why and "lens_px" in alike.why
    far = choose(BackView("phone_back.jpg", (1.0, 2.0), lenses[:1]), np.array([40.0, 20.0, 0.0]), 2.0)
    assert far.offset_mm is None and "puts the LED at 40, 20 mm" in far.why


def test_without_a_top_of_the_board_the_turn_is_told_by_the_shading_alone():
    lenses = (LensReading((100.0, 200.0), (3.0, 0.0), 1.5),)
    view = BackView("phone_back.jpg", (1.0, 2.0), lenses)
    near_the_lens = np.array([0.5, 1.0, 0.0])
    assert choose(view, near_the_lens, 2.0).offset_mm == pytest.approx((0.0, 3.0, 0.0), abs=0.2)
    assert choose(replace(view, has_top=False), near_the_lens, 2.0).offset_mm is None


@pytest.mark.parametrize(
    ("phone", "said"),
    [
        (BackOfPhone(spots=((10.0, 10.0),)), r"2 saturated spots .* led_px = \["),
        (BackOfPhone(is_lit=False), "no lit LED was found"),
        (BackOfPhone(lenses=()), "no lens was found .* name the main lens"),
        (np.full((300, 400), 90, np.uint8), "the board was not found in phone_back"),
    ],
)
def test_what_cannot_be_told_is_refused_with_what_to_do(tmp_path, phone, said):
    with pytest.raises(CalibrationError, match=said):
        read(tmp_path, phone)


@pytest.mark.slow
def test_what_session_toml_names_is_not_searched(tmp_path):
    found = read(tmp_path, BackOfPhone())
    unlit = BackOfPhone(is_lit=False, lenses=())
    named = read(tmp_path, unlit, PhoneBack(found.led_px, found.lenses[0].lens_px))
    np.testing.assert_allclose(offsets(named), offsets(found), atol=0.3)
    with pytest.raises(CalibrationError, match=r"led_px .* is 9000, 10; phone_back.png is 1600 x 1200 px"):
        read(tmp_path, unlit, PhoneBack((9000.0, 10.0), (1.0, 1.0)))


def test_the_photo_beside_session_toml_is_none_of_the_captures_photos(tmp_path):
    rng = np.random.default_rng(0)
    for name in ["board/a.png", *[f"photos/{k}.png" for k in range(4)], "phone_back.png"]:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        save_back(tmp_path / name, rng.integers(0, 255, (60, 80)).astype(np.uint8))
    session = load_session(tmp_path)
    assert session.phone_back == tmp_path / "phone_back.png"
    assert all(path.stem != "phone_back" for path in (*session.board, *session.lit, *session.light))
    save_back(tmp_path / "phone_back.jpg", np.full((60, 80), 90, np.uint8))
    with pytest.raises(CaptureError, match=r"phone_back\.jpg and phone_back\.png"):
        load_session(tmp_path)


def test_the_settings_are_read_or_refused_by_name(tmp_path):
    path = tmp_path / "session.toml"
    path.write_text("phone_back = { led_px = [1131, 563.5], thickness_mm = 9 }\n")
    assert load_settings(tmp_path).phone_back == PhoneBack((1131.0, 563.5), None, 9.0)
    for wrong, said in [
        ("[3]", "phone_back is .*a table of names and values"),
        ("{ led = 1 }", "phone_back has the unknown entry 'led'; led_px, lens_px, thickness_mm are known"),
        ("{ lens_px = [1] }", "phone_back.lens_px is .*two numbers in pixels"),
        ("{ thickness_mm = -1 }", "phone_back.thickness_mm is -1; needed: a length in millimetres"),
    ]:
        path.write_text(f"phone_back = {wrong}\n")
        with pytest.raises(CaptureError, match=said):
            load_settings(tmp_path)
