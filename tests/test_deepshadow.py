"""Scenes in the layout of DeepShadow, written to disk and read back; the ground that the user gives."""

import json

import cv2
import numpy as np
import pytest
from dataset_folders import calibrated

from calibration.scenes.deepshadow import load_deepshadow
from capture.errors import CalibrationError, UserError
from reconstruct.source.photos import read_photos
from reconstruct.source.source import RunOptions, open_source

SIZE = 32
LIGHTS = [("cup_0_0", (8.0, 0.5, 2.0)), ("cup_0_1", (-3.0, 7.0, 4.0)), ("cup_0_2", (-6.0, -4.0, 3.0))]


def write_scene(folder):
    """Three grey shadow pictures and their lights."""
    (folder / "0").mkdir()
    lines = [f"{name} {x} {y} {z}" for name, (x, y, z) in LIGHTS]
    (folder / "all_object_lights.txt").write_text("\n".join(lines) + "\n")
    given = {"focal_length": 44.0, "cam_location_x": 0.0, "cam_location_y": 0.0, "cam_location_z": 1.0}
    (folder / "params.json").write_text(json.dumps(given))
    for i, (name, _) in enumerate(LIGHTS):
        cv2.imwrite(str(folder / "0" / f"{name}_shadow1.png"), np.full((SIZE, SIZE), 40 * (i + 1), np.uint8))
    silhouette = np.full((SIZE, SIZE), 255, np.uint8)
    silhouette[:, : SIZE // 2] = 0
    cv2.imwrite(str(folder / "0" / "cup_silhouette.png"), silhouette)


def test_shadow_pictures_stay_grey_and_the_silhouette_is_the_mask_unless_left_out_or_without_background(tmp_path):
    write_scene(tmp_path)
    pictures = read_photos(open_source(tmp_path, RunOptions(input="shadow")), RunOptions(input="shadow"))[0]
    assert pictures.stack is None and pictures.shadow is not None and pictures.mask is not None
    assert pictures.shadow[:, 0, 0] == pytest.approx(np.array([40, 80, 120]) / 255)
    assert pictures.mask.mean() == 0.5
    without = RunOptions(mask="none")
    assert read_photos(open_source(tmp_path, without), without)[0].mask is None
    cv2.imwrite(str(tmp_path / "0" / "cup_silhouette.png"), np.full((SIZE, SIZE), 255, np.uint8))
    assert load_deepshadow(tmp_path).mask_path is None


def test_an_unknown_ground_is_an_assumption_that_the_result_names(tmp_path):
    write_scene(tmp_path)
    source, _, calibration = calibrated(tmp_path)
    assert not source.ground_is_known(RunOptions())
    assert "ground is unknown" in calibration.residuals["warnings"][-1]
    assert "assumed" in calibration.residuals["warnings"][-1]


@pytest.mark.parametrize(("ground", "words"), [("deep", "is no height"), ("nan", "is no height"), ("3", "above")])
def test_an_impossible_ground_is_refused_by_name(tmp_path, ground, words):
    write_scene(tmp_path)
    with pytest.raises(CalibrationError, match=words):
        calibrated(tmp_path, ground=ground)


@pytest.mark.parametrize(
    ("file", "text", "words"),
    [
        ("all_object_lights.txt", "cup_0_0 1 2\n", "line 1"),
        ("all_object_lights.txt", "\n", "lists no light"),
        ("all_object_lights.txt", "saucer_0_0 1 2 3\n", "saucer_0_0_shadow1.png"),
        ("params.json", "{", "not JSON"),
        ("params.json", '{"focal_length": -1}', "focal_length"),
        ("params.json", '{"focal_length": 44}', "cam_location_x is missing"),
    ],
)
def test_what_is_wrong_is_refused_by_its_name(tmp_path, file, text, words):
    write_scene(tmp_path)
    (tmp_path / file).write_text(text)
    with pytest.raises(UserError, match=words):
        load_deepshadow(tmp_path)
