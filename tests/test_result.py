import json
from typing import Annotated, Any, Literal

import numpy as np
import pytest
from msgspec import Meta, Struct
from scipy.spatial.transform import Rotation

from calibration.calibration import Calibration, load_calibration, save_calibration
from calibration.camera import Camera
from calibration.light import Light
from calibration.pose import Pose
from capture.errors import CalibrationError, CaptureError
from capture.files.schema import Count, Number, Vector, as_type, check_numbers


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


# --- values of another type in a stranger's file ---------------------------------------------------------------------


class Lamp(Struct):
    power: Number
    at: Annotated[Vector, Meta(description="x, y and z in mm")] = (0.0, 0.0, 0.0)
    kind: Literal["point", "sun"] = "point"

    def __post_init__(self) -> None:
        if self.kind == "sun" and self.at[2] < 0:
            raise ValueError("the sun is below the ground; needed: a sun above it")


class File(Struct):
    lights: Annotated[list[Lamp], Meta(max_length=2)]
    sizes: dict[str, Count] = {}


@pytest.mark.parametrize(
    ("value", "sentence"),
    [
        ([], r"the file is \[\]; needed: a table of names and values"),
        ({}, "lights is missing"),
        ({"lights": 3}, "lights is 3; needed: a list"),
        ({"lights": [{"power": 1}] * 3}, "lights is .*; needed: a list of at most 2"),
        ({"lights": [{"power": 1}, {"power": "x"}]}, r"lights\[1\].power is 'x'; needed: a number"),
        ({"lights": [{"power": float("nan")}]}, r"lights\[0\].power is nan; needed: a finite number"),
        ({"lights": [{"power": 10**400}]}, r"lights\[0\].power is 1000*\.\.\.; needed: a finite number"),
        ({"lights": [{"power": 1, "at": [1, 2]}]}, r"lights\[0\].at is \[1, 2\]; needed: x, y and z in mm"),
        ({"lights": [{"power": 1, "at": [1, 2, True]}]}, r"lights\[0\].at\[2\] is True; needed: x, y and z in mm"),
        ({"lights": [{"power": 1, "kind": "sun", "at": [0, 0, -1]}]}, r"lights\[0\]: the sun is below the ground; .*"),
        ({"lights": [], "sizes": {"a": -1}}, r"sizes is {'a': -1}; needed: a whole number of at least 0 in each entry"),
    ],
)
def test_a_wrong_value_is_named_with_what_is_needed_there(value: Any, sentence: str):
    with pytest.raises(CaptureError, match=rf"^x\.json: {sentence}\. Mend it\.$"):
        as_type(value, File, "x.json", "Mend it.", CaptureError)


def test_a_right_value_becomes_what_it_is():
    found = as_type({"lights": [{"power": 1, "at": [1, 2, 3]}], "more": "is not read"}, File, "x.json")
    assert found == File([Lamp(1.0, (1.0, 2.0, 3.0))])


@pytest.mark.parametrize(
    ("value", "place"),
    [(float("inf"), "the file"), ({"a": [1, {"b": float("nan")}]}, r"a\[1\].b"), ([[10**400]], r"\[0\]\[0\]")],
)
def test_a_number_that_no_float_holds_is_found_at_any_depth(value: Any, place: str):
    with pytest.raises(CalibrationError, match=f"^x: {place} is .*; needed: a finite number"):
        check_numbers(value, "x")
