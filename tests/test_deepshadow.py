"""Scenes in the layout of DeepShadow, written to disk and read back; the ground that the user gives."""

import numpy as np
import pytest
from dataset_folders import calibrated, write_deepshadow, write_grey
from synthetic import Look, render

from calibration.scenes.deepshadow import load_deepshadow
from capture.errors import CalibrationError, UserError
from reconstruct.source.photos import read_photos
from reconstruct.source.source import RunOptions, open_source


@pytest.fixture
def folder(tmp_path):
    """A camera one above the ground, three shadow pictures of even grey, and a silhouette that is half object."""
    write_deepshadow(tmp_path, render((), Look(width=32, height=32, n_lights=3))[1], 1.0)
    for i in range(3):
        write_grey(tmp_path / "0" / f"cup_0_{i}_shadow1.png", np.full((32, 32), 0.2 * (i + 1)))
    write_grey(tmp_path / "0" / "cup_silhouette.png", np.repeat([[0.0, 1.0]], 16, 1).repeat(32, 0))
    return tmp_path


def test_shadow_pictures_stay_grey_and_the_silhouette_is_the_mask_unless_left_out_or_without_background(folder):
    pictures = read_photos(open_source(folder, RunOptions(input="shadow")), RunOptions(input="shadow"))[0]
    assert pictures.stack is None and pictures.shadow is not None and pictures.mask is not None
    assert pictures.shadow[:, 0, 0] == pytest.approx(np.array([0.2, 0.4, 0.6]))
    assert pictures.mask.mean() == 0.5
    without = RunOptions(mask="none")
    assert read_photos(open_source(folder, without), without)[0].mask is None
    write_grey(folder / "0" / "cup_silhouette.png", np.ones((32, 32)))
    assert load_deepshadow(folder).mask_path is None


def test_an_unknown_ground_is_an_assumption_that_the_result_names(folder):
    source, _, calibration = calibrated(folder)
    assert not source.ground_is_known(RunOptions())
    assert "ground is unknown" in calibration.residuals["warnings"][-1]
    assert "assumed" in calibration.residuals["warnings"][-1]


@pytest.mark.parametrize(("ground", "words"), [("deep", "is no height"), ("nan", "is no height"), ("3", "above")])
def test_an_impossible_ground_is_refused_by_name(folder, ground, words):
    with pytest.raises(CalibrationError, match=words):
        calibrated(folder, ground=ground)


@pytest.mark.parametrize(
    ("file", "text", "words"),
    [
        ("all_object_lights.txt", "cup_0_0 1 2\n", "line 1"),
        ("all_object_lights.txt", "\n", "lists no light"),
        ("all_object_lights.txt", "saucer_0_0 1 2 3\n", "saucer_0_0_shadow1.png"),
        ("params.json", "{", "cannot be read as JSON"),
        ("params.json", '{"focal_length": -1}', "focal_length"),
        ("params.json", '{"focal_length": 44}', "cam_location_x is missing"),
    ],
)
def test_what_is_wrong_is_refused_by_its_name(folder, file, text, words):
    (folder / file).write_text(text)
    with pytest.raises(UserError, match=words):
        load_deepshadow(folder)
