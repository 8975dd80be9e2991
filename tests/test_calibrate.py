"""The glue from board and photos to a calibration; the board itself is tested elsewhere and taken as found."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from flashlight_photos import POSED_CAMERA, Recipe, photograph

import calibration.calibrate as glue
from calibration.calibrate import calibrate
from calibration.calibration import load_calibration, save_calibration
from calibration.flashlight.light_estimate import LightFit
from calibration.flashlight.phone import PhoneViews
from calibration.light import Light
from calibration.outlines.metric_cues import MetricCues
from calibration.side_photos.side_views import SideResult
from calibration.side_view import SideView
from capture.errors import CalibrationError
from capture.files.names import frame_path
from capture.photos.finding import Finding
from capture.session.session import Session, SessionSettings

pytestmark = pytest.mark.usefixtures("few_starts")
FLAT_SHEET = SimpleNamespace(on_sheet=lambda corners: corners)


@pytest.fixture(scope="module")
def photographed():
    return photograph(Recipe(n_photos=8))


@pytest.fixture
def truth(monkeypatch, photographed):
    residuals = {"board": "checkerboard:9x6:20", "notes": [], "pose_covariance": np.zeros((6, 6)).tolist()}
    monkeypatch.setattr(glue, "fit_board", lambda session, spec: (POSED_CAMERA, FLAT_SHEET, residuals))
    return photographed


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


@pytest.mark.parametrize("named", [False, True])
def test_where_nearly_all_photos_are_left_out_the_refusal_says_why(truth, tmp_path, named):
    (tmp_path / "lights.lp").write_text("\n".join(f"{path.name} 0 0 1" for path in truth.stack.paths))
    text = "40% of the pixels are saturated, 30% may be: expose less"
    findings = [Finding(path, "over-exposed", text, 0.4, 0.3, True) for path in truth.stack.paths[3:]]
    with pytest.raises(
        CalibrationError, match=r"^3 of 8 photos .*\. IMG_0003\.jpg, .*: over-exposed, 40% .*expose less"
    ):
        calibrate(session_of(truth), truth.stack, None, tmp_path / "lights.lp" if named else "auto", findings)


@pytest.mark.parametrize(
    ("factor", "more", "said"),
    [
        ([1, 1, -1], {}, "the light of IMG_0000\\.jpg below the ground"),
        ([1, 1, -1], {"sigma": [5, 5, 5]}, "the light of IMG_0000\\.jpg below the ground"),
        ([1e-3] * 3, {}, r"the lights .* mm \(median\) from the ground point .* in millimetres"),
    ],
)
def test_a_list_of_lights_below_the_ground_or_in_metres_is_refused_by_its_own_name(truth, tmp_path, factor, more, said):
    rows = [{"photo": x.photo, "position": (np.array(x.position) * factor).tolist()} | more for x in truth.lights]
    (tmp_path / "lights.json").write_text(json.dumps({"lights": rows}))
    with pytest.raises(CalibrationError, match=rf"lights\.json puts {said}"):
        calibrate(session_of(truth), truth.stack, lights=tmp_path / "lights.json")


def test_photos_from_the_side_count_with_lights_from_a_file_too(truth, tmp_path, monkeypatch):
    view = SideView("a.jpg", POSED_CAMERA, (0, 0, 8, 6), np.eye(6, 8) > 0, np.ones((6, 8), bool), 0.5)
    found = [SideResult("a.jpg", view, ""), SideResult("b.jpg", None, "the board was not found in it")]
    monkeypatch.setattr(glue, "metric_cues", lambda *_: (MetricCues((view,)), found))
    rows = [{"photo": light.photo, "position": np.array(light.position).tolist()} for light in truth.lights]
    (tmp_path / "lights.json").write_text(json.dumps({"lights": rows}))
    result = calibrate(session_of(truth), truth.stack, lights=tmp_path / "lights.json")
    assert [one.photo for one in result.side_views] == ["a.jpg"]
    assert "side/b.jpg was not used: the board was not found in it" in result.residuals["notes"]
    assert truth.errors(result.lights).max() == 0


def test_photos_of_another_size_than_the_board_photo_are_refused(truth):
    turned = replace(truth.stack, full_width=480, full_height=640)
    with pytest.raises(CalibrationError, match=r"is 640x480 px, .* are 480x640.*orientation\.$"):
        calibrate(session_of(truth), turned)
    filmed = replace(turned, paths=tuple(frame_path(Path("a.mov"), float(k)) for k in range(len(turned.paths))))
    with pytest.raises(CalibrationError, match="Film the board, too"):
        calibrate(session_of(truth), filmed)


def test_lights_by_phone_need_photos_by_that_phone_and_an_unknown_way_is_the_callers_mistake(truth):
    with pytest.raises(CalibrationError, match="no photos by the flashlight's phone in capture"):
        calibrate(session_of(truth), truth.stack, lights="phone")
    with pytest.raises(ValueError, match="auto, shading, phone"):
        calibrate(session_of(truth), truth.stack, lights="guess")


def test_a_photo_of_the_phones_back_that_tells_nothing_is_named_and_does_not_stop_the_calibration(truth, monkeypatch):
    fitted = LightFit(truth.lights, (), np.zeros(3), {"cue": ""})
    led = {"led_offset_mm": [12.0, -5.0, 0.0], "led_offset_sigma_mm": 2.0}
    with_phone = replace(fitted, residuals=fitted.residuals | {"phone_photos": {}} | led)
    told = []

    def by_phone(stack, posed_camera, usable, views):
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
    assert "phone_back.jpg was not used: it helps only photos in light/" in alone.residuals["notes"]
    beside = calibrate(replace(session, light=(Path("light/a.jpg"),)), truth.stack)
    assert told == [None] and "no lit LED was found in phone_back.jpg" in beside.residuals["notes"][-1]


def test_the_error_of_the_cameras_pose_is_part_of_each_lights_uncertainty():
    rng = np.random.default_rng(2)
    root = rng.normal(size=(6, 6)) * np.r_[[1e-3] * 3, [1.0] * 3][:, None]
    light = Light("a.jpg", "point", position=np.array([250.0, -300.0, 600.0]), sigma=np.array([3.0, 4.0, 5.0]))
    (found,) = glue.with_camera_error([light], POSED_CAMERA, root @ root.T)
    draws = rng.normal(size=(20_000, 6)) @ root.T
    moved = np.cross(draws[:, :3], light.position - POSED_CAMERA.centre) + draws[:, 3:]
    np.testing.assert_allclose(found.sigma**2, light.sigma**2 + moved.var(axis=0), rtol=0.05)
