import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibration.calibration import Calibration, load_calibration, save_calibration
from calibration.camera import Camera
from calibration.light import Light
from calibration.pose import Pose
from capture.errors import CalibrationError


def example() -> Calibration:
    rotation = Rotation.from_rotvec([2.5, 0.1, 0.03]).as_matrix()
    camera = Camera(640, 480, 511.25, 510.5, 320.1, 239.9, (0.1, -0.2, 1e-3, 0.0, 0.05), {"fx": 1.5, "cx": 2.0})
    return Calibration(
        camera=camera,
        world_from_camera=Pose(rotation, np.array([10.0, -20.0, 1 / 3 * 1000])),
        ground_height=-0.15,
        lights=(
            Light("a.jpg", "point", np.array([1.0, 2.0, 300.1]), axis=np.array([0.0, 0.0, -1.0]), sigma=np.ones(3)),
            Light("b.jpg", "directional", direction=np.array([0.6, 0.0, 0.8]), used=False, reason="flash off"),
        ),
        beam=(1.5, -0.1),
        ambient=np.array([0.01, 0.02, 0.03]),
        residuals={"reprojection_rms_px": np.float64(0.1), "pair": (1, 2)},
    )


def test_a_saved_calibration_comes_back_equal(tmp_path):
    save_calibration(example(), tmp_path / "calibration.json")
    assert load_calibration(tmp_path / "calibration.json") == example()
    assert [path.name for path in tmp_path.iterdir()] == ["calibration.json"]


def test_the_file_keeps_the_contract(tmp_path):
    save_calibration(example(), tmp_path / "c.json")
    document = json.loads((tmp_path / "c.json").read_text())
    assert document["format"] == 1 and document["units"] == "mm"
    assert set(document["camera"]) == {
        *("width", "height", "fx", "fy", "cx", "cy", "distortion", "world_from_camera", "sigmas", "lens")
    }
    assert document["ground"] == {"normal": [0, 0, 1], "offset": -0.15}
    assert set(document["lights"][0]) == {"photo", "kind", "position", "sigma", "power", "used", "reason", "axis"}
    assert document["lights"][1]["direction"] == [0.6, 0, 0.8]


@pytest.mark.parametrize(
    ("path", "value", "named"),
    [
        (("format",), 2, "format"),
        (("units",), "inch", "units"),
        (("camera", "fx"), -3, "camera.fx"),
        (("camera", "fx"), 1e12, "camera.fx"),
        (("camera", "sigmas", "fx"), -1, r"camera.sigmas is .*in each entry"),
        (("camera", "world_from_camera", 0, 0), 3.0, "camera.world_from_camera"),
        (("camera", "world_from_camera", 2, 3), -50.0, "camera.world_from_camera"),
        (("camera", "world_from_camera", 3), [0, 0, 1, 1], "camera.world_from_camera"),
        (("ground", "normal"), [0, 1, 0], "ground.normal"),
        (("lights", 0, "position", 2), -10.0, r"lights\[0\].position"),
        (("lights", 0, "kind"), "ring", r"lights\[0\].kind"),
        (("lights", 0, "power", 1), -1.0, r"lights\[0\].power"),
        (("lights", 1, "direction"), [1, 1, 1], r"lights\[1\].direction"),
        (("residuals", "camera_height_sigma_mm"), "x", "camera_height_sigma_mm is 'x'"),
        (("lights", 0, "photo"), "../../secret", r"lights\[0\]\.photo is .*the name of a file"),
    ],
)
def test_a_wrong_field_is_refused_by_name(tmp_path, path, value, named):
    save_calibration(example(), tmp_path / "c.json")
    document = json.loads((tmp_path / "c.json").read_text())
    place = document
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    (tmp_path / "c.json").write_text(json.dumps(document))
    with pytest.raises(CalibrationError, match=named):
        load_calibration(tmp_path / "c.json")


@pytest.mark.parametrize("text", ["", "{", "[]", "3", "\x00"])
def test_a_file_that_is_no_calibration_is_refused(tmp_path, text):
    (tmp_path / "c.json").write_text(text)
    with pytest.raises(CalibrationError):
        load_calibration(tmp_path / "c.json")


def test_nothing_is_written_when_a_number_is_not_finite(tmp_path):
    bad = Calibration(example().camera, example().world_from_camera, float("nan"), ())
    with pytest.raises(CalibrationError, match=r"ground\.offset"):
        save_calibration(bad, tmp_path / "c.json")
    assert not list(tmp_path.iterdir())


def test_a_light_is_a_point_or_a_direction_and_nothing_else():
    with pytest.raises(ValueError, match="point with a position"):
        Light("a", "point", direction=np.array([0.0, 0.0, 1.0]))


@pytest.mark.parametrize("matrix", [np.diag([1.0, 1, -1]), 1.01 * np.eye(3), np.full((3, 3), np.nan)])
def test_a_mirror_a_scaling_and_nan_are_no_rotations(matrix):
    with pytest.raises(ValueError):
        Pose(matrix, np.zeros(3))
