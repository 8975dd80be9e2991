"""Scenes with known camera and lights, written to disk in the ShadowNeuS layout and read back."""

import json
import shutil

import numpy as np
import pytest
from dataset_folders import calibrated, write_shadowneus
from synthetic import BALL, Look, render

from calibration.scenes.shadowneus import IMPORTER, load_known_scene
from capture.errors import CalibrationError, CaptureError, UserError
from reconstruct.source.photos import read_photos
from reconstruct.source.source import RunOptions, open_source


def write_scene(folder, look=None, light_type=None, pictures="both", shapes=(BALL,)):
    """A synthetic scene on disk; returns its truth."""
    _, truth = render(shapes, look or Look(width=60, height=44, n_lights=6))
    write_shadowneus(folder, truth, light_type, pictures)
    return truth


def edit(path, change):
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def test_camera_ground_and_point_lights_come_back_as_written(tmp_path):
    truth = write_scene(tmp_path, light_type="point")
    known = load_known_scene(tmp_path)
    camera, expected = known.calibration.camera, truth.calibration.camera
    assert IMPORTER.recognises(tmp_path) and known.calibration.unit == "scene"
    assert (camera.cx, camera.cy) == (29.5, 21.5)  # the centre of the picture, where the first pixel centre is (0, 0)
    assert camera.fx == pytest.approx(expected.fx)
    assert np.allclose(known.calibration.world_from_camera.matrix(), truth.calibration.world_from_camera.matrix())
    for light, true in zip(known.calibration.lights, truth.calibration.lights, strict=True):
        assert np.allclose(light.position, true.position)
    assert known.mask_path is not None and len(known.rgb_paths or ()) == len(known.shadow_paths or ()) == 6


@pytest.mark.parametrize("kind", ["point", "directional"])
def test_the_shading_tells_point_lights_from_directional_ones(tmp_path, kind):
    write_scene(tmp_path, Look(width=60, height=44, n_lights=6, kind=kind))
    assert {light.kind for light in load_known_scene(tmp_path).calibration.lights} == {kind}


@pytest.mark.parametrize(
    ("wanted", "colour", "shadow"), [("auto", 1, 0), ("rgb", 1, 0), ("shadow", 0, 1), ("both", 1, 1)]
)
def test_the_pictures_that_were_asked_for_are_read(tmp_path, wanted, colour, shadow):
    truth = write_scene(tmp_path, light_type="point")
    options = RunOptions(input=wanted)
    pictures = read_photos(open_source(tmp_path, options), options)[0]
    assert (pictures.stack is not None, pictures.shadow is not None) == (colour, shadow)
    if pictures.shadow is not None:
        assert np.array_equal(pictures.shadow, truth.visibility)


def test_both_kinds_of_pictures_are_refused_by_the_name_of_the_one_that_is_missing(tmp_path):
    write_scene(tmp_path, light_type="point", pictures="shadow")
    with pytest.raises(CaptureError, match="no colour photos, which --input both needs"):
        open_source(tmp_path, RunOptions(input="both"))


TRAIN, FLOOR = "transforms_train.json", "transforms_floor.json"


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        (TRAIN, lambda c: c.pop("camera_angle_x"), "camera_angle_x"),
        (TRAIN, lambda c: c["frames"][2].pop("transform_matrix_sun"), r"frames\[2\].*transform_matrix_sun"),
        (TRAIN, lambda c: c["frames"][3].update(file_path="train/none"), "frame 3.*does not exist"),
        (TRAIN, lambda c: c["frames"][0].update(file_path="../outside"), r"frame 0.*file_path.*leaves the folder"),
        (TRAIN, lambda c: c["frames"][4]["transform_matrix"][0].__setitem__(3, 7.0), "frame 4 differs"),
        (TRAIN, lambda c: c.update(light_type="laser"), "light_type.*laser"),
        (FLOOR, lambda c: c.update(frames=[]), "transform_ground"),
        (FLOOR, lambda c: c["frames"][0]["transform_ground"][2].__setitem__(3, 9e3), "below the ground"),
    ],
)
def test_what_is_missing_or_impossible_is_named_with_its_file(tmp_path, file, change, message):
    write_scene(tmp_path / "scene")
    shutil.copy(tmp_path / "scene" / "train" / "r_000.png", tmp_path / "outside.png")
    edit(tmp_path / "scene" / file, change)
    with pytest.raises(UserError, match=message) as caught:
        load_known_scene(tmp_path / "scene")
    assert "transforms_" in str(caught.value) or "scene.json" in str(caught.value)


def test_a_split_that_is_not_there_names_those_that_are(tmp_path):
    write_scene(tmp_path)
    with pytest.raises(CalibrationError, match=r"transforms_test.json does not exist.*transforms_train.json"):
        load_known_scene(tmp_path, "test")


def test_a_stated_light_error_makes_known_lights_uncertain(tmp_path):
    write_scene(tmp_path / "scene", light_type="point")
    for light in calibrated(tmp_path / "scene", light_error=0.03)[2].lights:
        assert light.position is not None
        distance = np.linalg.norm(light.position)  # the camera looks at the ground 15 mm beside the origin
        assert np.linalg.norm(light.sigma) == pytest.approx(0.03 * distance, rel=0.05)
    with pytest.raises(CaptureError, match="--light-error 3"):
        open_source(tmp_path / "scene", RunOptions(light_error=3.0))
