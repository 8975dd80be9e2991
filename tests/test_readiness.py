"""The verdict on a capture, from lights and shadows that are known because they were rendered."""

import json
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from synthetic import HEAP, Look, Sphere, Truth, render

import reconstruct.source.source as calibration_source
import shadowgraph
from calibration.calibrated_views import CalibratedViews
from capture.checks.alignment import BOARD_OFF
from capture.errors import CalibrationError, ReconstructionError
from capture.photos.finding import Finding
from reconstruct.check import verdict as readiness
from reconstruct.check.light_coverage import from_the_camera, shadow_cover, side_in_words
from reconstruct.check.readiness import judge, refuse_hopeless
from reconstruct.check.verdict import CaptureCheck
from reconstruct.source.photos import Photos
from reconstruct.source.source import RunOptions, Source
from viewer.report.check_page import PAGE, check_lines, shadow_picture, write_check


@pytest.fixture(scope="module")
def rendered():
    return render(HEAP, Look(width=120, height=90, n_lights=26))


@pytest.fixture(scope="module")
def truth(rendered) -> Truth:
    return rendered[1]


@pytest.fixture(scope="module")
def cover(rendered):
    return shadow_cover(rendered[0])


def with_used(truth, keep):
    """The calibration with only those lights used for which keep(place, azimuth) holds."""
    azimuths = [np.arctan2(light.position[1], light.position[0]) for light in truth.calibration.lights]
    lights = [replace(light, used=bool(keep(k, azimuths[k]))) for k, light in enumerate(truth.calibration.lights)]
    return replace(truth.calibration, lights=tuple(lights))


def test_many_photos_from_all_around_are_good(truth, cover):
    found = judge(truth.calibration, (), cover)
    assert found.grade == "good" and found.reasons == () and found.advice == ()
    assert found.sentence().startswith("Good: 26 of 26 photos can be used, and light came from all sides.")
    refuse_hopeless(found)


def test_an_object_that_the_picture_cuts_is_named():
    scene, truth = render((Sphere((95.0, 0.0, 40.0), 40.0),), Look(width=120, height=90, n_lights=26))
    found = judge(truth.calibration, (), shadow_cover(scene))
    assert found.facts["object_cut"]
    assert any("beyond the picture's border" in reason for reason in found.reasons)


def test_a_side_without_light_is_named_as_seen_by_the_camera(truth, cover):
    eye = truth.calibration.world_from_camera.translation
    to_camera = np.arctan2(eye[1], eye[0])
    right = truth.calibration.world_from_camera.rotation[:, 0]
    assert side_in_words(to_camera, truth.calibration, np.zeros(3)) == "from the camera's side"
    assert side_in_words(to_camera + np.pi, truth.calibration, np.zeros(3)) == "from behind the object"
    assert side_in_words(np.arctan2(right[1], right[0]), truth.calibration, np.zeros(3)) == "from the right"
    camera = truth.calibration.posed_camera
    seen_right = with_used(
        truth, lambda _, azimuth: abs(from_the_camera(azimuth, camera, np.zeros(3)) - np.pi / 2) < np.pi / 2
    )
    found = judge(seen_right, (), cover)
    assert found.grade in ("fair", "poor")
    assert any("with the flashlight from the left" in advice for advice in found.advice)


def test_too_few_photos_are_poor_and_three_are_hopeless(truth, cover):
    assert judge(with_used(truth, lambda k, _: k < 8), (), cover).grade == "poor"
    found = judge(with_used(truth, lambda k, _: k < 3), (), cover)
    assert found.grade == "hopeless"
    with pytest.raises(ReconstructionError, match=r"3 of 26 photos can be used, 4 are needed at least\. Take more"):
        refuse_hopeless(found)


def with_powers(calibration, powers):
    lights = [replace(light, power=p * light.power) for light, p in zip(calibration.lights, powers, strict=True)]
    return replace(calibration, lights=tuple(lights))


def test_the_larger_group_has_the_right_exposure_wherever_it_stands(truth):
    """11 of 26 photos a stop darker, their powers as uncertain as fitted ones: those are named, first or last."""
    paths, spread = truth.stack.paths, np.exp(np.random.default_rng(0).normal(0, 0.015, 26))
    for places in (range(11), range(15, 26)):
        powers = spread * [0.5 if k in places else 1.0 for k in range(26)]
        found = readiness.with_power_changes((), with_powers(truth.calibration, powers), truth.stack)
        assert [finding.photo for finding in found] == [paths[k] for k in places]
        assert all(finding.value == pytest.approx(0.5, rel=0.06) for finding in found)


def test_a_tripod_that_moved_is_a_reason_and_the_advice_is_to_photograph_the_board_again(truth, cover):
    names = [light.photo for light in truth.calibration.lights]
    left_out = [Finding(Path(name), BOARD_OFF, "", 9.4, 0.6, True) for name in names[7:]]
    found = judge(with_used(truth, lambda k, _: k < 7), left_out, cover)
    moved = (
        f"the tripod moved: 19 photos, {names[7]} to {names[-1]}, lie up to 9 px off the photo of the board "
        "(at most 0.6 px is fine) and are left out, 7 photos with the board's view are used"
    )
    assert found.grade == "poor" and moved in found.reasons
    assert any(advice.startswith("Photograph the board again as the tripod stands now") for advice in found.advice)
    kept = [replace(finding, drop=False) for finding in left_out]
    told = judge(truth.calibration, kept, cover)
    assert told.grade == "poor" and told.reasons[0].endswith("so camera and ground are somewhat off")


@pytest.mark.parametrize(("share", "grade"), [(0.01, "good"), (0.05, "fair"), (0.07, "poor"), (0.4, "poor")])
@pytest.mark.parametrize("used", [26, 11])
def test_lights_of_large_uncertainty_decide_the_grade_and_are_named_first(truth, cover, share, grade, used):
    lights = [
        replace(x, used=k < used, sigma=np.full(3, share * np.linalg.norm(x.position - cover.centre) / np.sqrt(3)))
        for k, x in enumerate(truth.calibration.lights)
    ]
    found = judge(replace(truth.calibration, lights=tuple(lights)), [], cover)
    if used == len(lights):
        assert found.grade == grade, found.reasons
    named = f"the lights' places are uncertain by {share:.1%} of their distance (at most 6% is fine)"
    assert (named in found.reasons) == (grade != "good")
    assert (found.reasons[:1] == (named,)) == (grade == found.grade != "good")


def test_doubts_and_dropped_photos_are_reasons(truth, cover):
    names = [light.photo for light in truth.calibration.lights]
    findings = [Finding(Path(name), "blurred", "shaken", 0.4, 0.8, True) for name in names[:9]]
    found = judge(with_used(truth, lambda k, _: k >= 9), findings, cover, ("the tone curve is doubtful",))
    assert "17 of 26 photos can be used (blurred: 9)" in found.reasons
    assert "the tone curve is doubtful" in found.reasons


def test_the_page_and_the_terminal_say_it_all(truth, cover, tmp_path):
    half = with_used(truth, lambda _, azimuth: azimuth > 0)
    finding = Finding(Path(half.lights[0].photo), "over-exposed", "7% of the pixels <are> saturated", 0.07, 0.05, False)
    checked = CaptureCheck("heap & co", judge(half, (finding,), cover), half, (finding,), cover, ("a note",))
    page = write_check(checked, tmp_path).read_text()
    assert [path.name for path in tmp_path.iterdir()] == [PAGE]
    told = ("heap &amp; co", "What to shoot next", "&lt;are&gt; saturated", "a note", "not used")
    for words in (*told, *checked.readiness.advice):
        assert words.replace("'", "&#x27;") in page
    assert page.count("<circle") >= len(half.lights) and "http" not in page.replace("http-equiv", "")
    lines = check_lines(checked)
    assert lines[0] == checked.readiness.sentence() and any(line.startswith("Shoot next: ") for line in lines)
    assert shadow_picture(cover).shape == (*cover.mask.shape, 3)


@pytest.mark.parametrize("n_used", [26, 2])
def test_the_command_leaves_page_and_json_and_refuses_the_hopeless(truth, cover, tmp_path, monkeypatch, capsys, n_used):
    calibration = with_used(truth, lambda k, _: k < n_used)
    checked = CaptureCheck("heap", judge(calibration, (), cover), calibration, (), cover)
    monkeypatch.setattr(calibration_source, "open_source", lambda folder, options: Source(folder))
    monkeypatch.setattr(Source, "photos", lambda self: truth.stack.paths)
    monkeypatch.setattr(readiness, "read_and_check", lambda source, options: checked)
    code = shadowgraph.main(["check", str(tmp_path / "heap"), "--out", str(tmp_path / "out")])
    said = capsys.readouterr()
    verdict = json.loads((tmp_path / "out" / "check.json").read_text())["verdict"]
    assert (tmp_path / "out" / PAGE).is_file() and checked.readiness.sentence() in said.out
    assert (code, verdict) == ((0, "good") if n_used == 26 else (2, "hopeless"))
    assert ("4 are needed at least" in said.err) is (n_used == 2)


def test_photos_without_any_usable_light_and_a_failed_calibration_say_what_is_wrong_with_the_photos(truth, monkeypatch):
    unused = tuple(replace(x, used=False, reason="camera moved: 9 px") for x in truth.calibration.lights)
    blurred = Finding(Path("IMG_3.jpg"), "blurred", "shaken", 0.4, 0.8, True)
    views = CalibratedViews.of(replace(truth.calibration, lights=unused))
    for findings, result, said in (
        ((), [views], r"0 of 26 photos in heap have a usable light, .*: camera moved: 9 px"),
        ((blurred,), CalibrationError("no board found."), r"no board found\. Besides: IMG_3\.jpg: blurred\."),
    ):
        monkeypatch.setattr(readiness, "read_photos", lambda *_, found=findings: (Photos(truth.stack, found),))
        monkeypatch.setattr(readiness, "calibrate_source", Mock(side_effect=result))
        with pytest.raises(CalibrationError, match=said):
            readiness.read_and_check(Source(Path("heap")), RunOptions())
