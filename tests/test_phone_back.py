"""The LED beside the lens, from a photo of the phone's back: rendered photos, of which every millimetre is known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from phone_backs import BOARD, BackOfPhone, back_photo, save_back

from calibration.flashlight.led_photo import BackView, LensReading, choose, in_lens_frame, read_phone_back
from capture.errors import CalibrationError, CaptureError
from capture.session.declared_objects import PhoneBack
from capture.session.session import load_session, load_settings

THREE = BackOfPhone(lenses=((-22.0, 60.0, 6.5), (-22.0, 44.0, 6.5), (-8.0, 40.0, 5.5)))
OFFSETS = np.array([[10.0, -8.0], [10.0, 8.0], [-4.0, 12.0]])  # from each lens to the LED, x and y of the back


def read(tmp_path: Path, phone: BackOfPhone, given: PhoneBack | None = None) -> BackView:
    path = save_back(tmp_path / "phone_back.png", back_photo(phone))
    return read_phone_back(path, BOARD, given or PhoneBack())


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


def test_two_lenses_that_fit_alike_are_refused_with_their_pixels():
    lenses = (LensReading((100.0, 200.0), (10.0, 8.0), 1.5), LensReading((140.0, 200.0), (4.0, 8.0), 1.5))
    choice = choose(BackView("phone_back.jpg", (1.0, 2.0), lenses), in_lens_frame((7.0, 8.0), 0), 2.0)
    assert choice.offset_mm is None
    assert "[100, 200]" in choice.why and "[140, 200]" in choice.why and "lens_px" in choice.why


def test_a_photo_that_contradicts_the_shading_is_not_believed():
    lenses = (LensReading((100.0, 200.0), (10.0, 8.0), 1.5),)
    choice = choose(BackView("phone_back.jpg", (1.0, 2.0), lenses), np.array([40.0, 20.0, 0.0]), 2.0)
    assert choice.offset_mm is None and "puts the LED at 40, 20 mm" in choice.why


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


def test_a_photo_without_the_board_is_refused(tmp_path):
    path = save_back(tmp_path / "phone_back.png", np.full((300, 400), 90, np.uint8))
    with pytest.raises(CalibrationError, match="the board was not found in phone_back"):
        read_phone_back(path, BOARD, PhoneBack())


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
