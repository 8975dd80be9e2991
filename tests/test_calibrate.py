"""The glue from board and photos to a calibration; the board itself is tested elsewhere and taken as found."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from flashlight_photos import CAMERA, WORLD_FROM_CAMERA, Recipe, photograph

import calibration.calibrate as glue
from calibration.calibrate import calibrate
from calibration.phone import PhoneViews
from calibration.result import load_calibration, save_calibration
from capture.checks import Finding
from capture.errors import CalibrationError
from capture.session import Session, SessionSettings


@pytest.fixture
def truth(monkeypatch):
    found = (CAMERA, WORLD_FROM_CAMERA, {"board": "checkerboard:9x6:20", "notes": []})
    monkeypatch.setattr(glue, "calibrate_board", lambda session, spec: found)
    return photograph(Recipe(n_photos=8))


def session_of(truth) -> Session:
    return Session(Path("capture"), (), truth.stack.paths, (), (), SessionSettings())


def test_a_dropped_photo_keeps_its_place_and_says_why(truth, tmp_path):
    bad = truth.stack.paths[2]
    findings = [
        Finding(bad, "blurred", "the contrast is 0.1 of the others'", 0.1, 0.3, True),
        Finding(truth.stack.paths[5], "over-exposed", "7% of the pixels are saturated", 0.07, 0.05, False),
    ]
    result = calibrate(session_of(truth), truth.stack, findings=findings)
    assert [light.photo for light in result.lights] == [path.name for path in truth.stack.paths]
    assert [light.photo for light in result.lights if not light.used] == [bad.name]
    assert result.lights[2].reason == "blurred: the contrast is 0.1 of the others'"
    assert np.delete(truth.errors(result.lights), 2).max() < 0.02
    save_calibration(result, tmp_path / "calibration.json")
    assert load_calibration(tmp_path / "calibration.json") == result


def test_photos_of_another_size_than_the_board_photo_are_refused(truth):
    with pytest.raises(CalibrationError, match=r"is 640x480 px, .* are 480x640"):
        calibrate(session_of(truth), replace(truth.stack, full_width=480, full_height=640))


def test_lights_by_phone_need_photos_by_that_phone(truth):
    with pytest.raises(CalibrationError, match="no photos by the flashlight's phone in capture"):
        calibrate(session_of(truth), truth.stack, lights="phone")


def test_an_unknown_way_to_find_lights_is_the_callers_mistake(truth):
    with pytest.raises(ValueError, match="auto, shading, phone"):
        calibrate(session_of(truth), truth.stack, lights="guess")


def test_a_photo_of_the_phones_back_that_tells_nothing_is_named_and_does_not_stop_the_calibration(truth, monkeypatch):
    fitted = glue.locate_lights(truth.stack, CAMERA, WORLD_FROM_CAMERA, np.ones(8, bool))
    with_phone = replace(fitted, residuals=fitted.residuals | {"phone_photos": {}})
    told = []

    def by_phone(stack, camera, pose, usable, views):
        told.append(views.back)
        return with_phone

    def unreadable(path, board, given):
        raise CalibrationError("no lit LED was found in phone_back.jpg")

    monkeypatch.setattr(glue, "locate_lights", lambda *_: fitted)
    monkeypatch.setattr(glue, "locate_lights_from_phone", by_phone)
    monkeypatch.setattr(glue, "read_views", lambda session, board: PhoneViews((), (), (640, 480)))
    monkeypatch.setattr(glue, "read_phone_back", unreadable)
    session = replace(session_of(truth), phone_back=Path("phone_back.jpg"))
    alone = calibrate(session, truth.stack)
    assert "phone_back.jpg was not used: it helps photos in light/ only" in alone.residuals["notes"]
    beside = calibrate(replace(session, light=(Path("light/a.jpg"),)), truth.stack)
    assert told == [None] and "no lit LED was found in phone_back.jpg" in beside.residuals["notes"][-1]
