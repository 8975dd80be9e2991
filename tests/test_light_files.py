"""Lights from files of other programs: each layout written from known lights and read back into the world frame."""

import json
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from dataset_folders import write_s3nerf, write_shadowneus, write_shadowneus_real
from flashlight_photos import (
    AMBIENT,
    CAMERA,
    LOBE,
    POSED_CAMERA,
    WORLD_FROM_CAMERA,
    Recipe,
    handheld_lights,
    photograph,
)
from synthetic import Look, render

from calibration.calibration import Calibration, save_calibration
from calibration.lights.files import read_lights, read_opinions
from calibration.lights.layouts import BLENDER
from calibration.lights.power import SHADING_MISFIT, on_albedo_scale, with_power_per_photo
from calibration.lights_of_file import with_opinions
from calibration.pose import Pose
from calibration.posed_camera import PosedCamera
from capture.errors import CalibrationError

LIGHTS = handheld_lights(4, np.random.default_rng(0))
PHOTOS = [light.photo for light in LIGHTS]
PLACES = np.array([light.position for light in LIGHTS], float)


def directions() -> np.ndarray:
    """Towards the lights from where the middle of the photo shows the ground, in the picture's axes."""
    return WORLD_FROM_CAMERA.inverse().rotate(PLACES - POSED_CAMERA.looked_at()) @ BLENDER


def places(given) -> np.ndarray:
    assert [light.photo for light in given.lights] == PHOTOS
    return np.array([light.position for light in given.lights], float)


def assert_towards_the_lights(given):
    assert [light.photo for light in given.lights] == PHOTOS
    expected = PLACES - POSED_CAMERA.looked_at()
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(np.array([light.direction for light in given.lights]), expected, atol=2e-4)


def assert_lights(given, kind):
    if kind == "directional":
        assert_towards_the_lights(given)
    else:
        np.testing.assert_allclose(places(given), PLACES, atol=1e-6)


def test_an_lp_file_gives_directions_however_long_its_vectors_are(tmp_path):
    rows = [f"{name} {x:.5f} {y:.5f} {z:.5f}" for name, (x, y, z) in zip(PHOTOS, directions(), strict=True)]
    (tmp_path / "dome.lp").write_text("\n".join(rows))
    assert_towards_the_lights(read_lights(tmp_path / "dome.lp", PHOTOS, POSED_CAMERA))


def test_a_dome_gives_places_whatever_its_unit(tmp_path):
    width = np.linalg.norm(POSED_CAMERA.looked_at() - WORLD_FROM_CAMERA.translation) * CAMERA.width / CAMERA.fx
    file = tmp_path / "ours.dome"
    rows = [dict(zip("xyz", row / width * 30.0, strict=True)) for row in directions().tolist() and directions()]
    file.write_text(json.dumps({"imageWidth": 30.0, "lightConfiguration": "lights3d", "positions3d": rows}))
    np.testing.assert_allclose(places(read_lights(file, PHOTOS, POSED_CAMERA)), PLACES, atol=1e-6)


@pytest.mark.parametrize(
    ("kind", "write", "file", "scale"),
    [
        ("point", write_shadowneus_real, "params.npz", 3.0),
        ("point", lambda folder, truth: write_s3nerf(folder, truth, unit=1.0), "params.json", 1.0),  # names no floor
        ("point", write_shadowneus, "transforms_train.json", 3.0),
        ("directional", lambda *scene: write_shadowneus(*scene, "directional"), "transforms_train.json", 3.0),
    ],
)
def test_lights_of_a_scene_are_placed_by_its_camera_and_floor(tmp_path, kind, write, file, scale):
    """Our world is turned and shifted against theirs, and of another unit."""
    _, truth = render((), Look(width=32, height=24, n_lights=4, kind=kind))
    write(tmp_path, truth)
    theirs, turn = truth.calibration.world_from_camera, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    ours = Pose(turn @ theirs.rotation, 3 * turn @ theirs.translation + np.array([3.0, -2.0, 7.0]))
    photos = sorted({one.name for one in tmp_path.rglob("*[0-9].png")})
    given = read_lights(tmp_path / file, photos, PosedCamera(truth.calibration.camera, ours, 7.0))
    for found, true in zip(given.lights, truth.calibration.lights, strict=True):
        if kind == "directional":
            expected = turn @ np.array(true.direction)
        else:
            expected = ours.apply(scale * theirs.inverse().apply(np.array(true.position)))
        np.testing.assert_allclose(found.homogeneous()[:3], expected, atol=1e-6)


def test_our_own_calibration_comes_back_with_beam_and_power(tmp_path):
    file = tmp_path / "calibration.json"
    save_calibration(Calibration(CAMERA, WORLD_FROM_CAMERA, 0.0, LIGHTS, beam=(2.0, 0.1)), file)
    given = read_lights(file, PHOTOS[1:], POSED_CAMERA)
    assert given.has_power and given.beam == (2.0, 0.1)
    np.testing.assert_array_equal(given.lights[0].axis, LIGHTS[1].axis)


def test_a_plain_list_may_give_several_lights_to_a_photo(tmp_path):
    file = tmp_path / "lights.json"
    rows = [{"photo": PHOTOS[0], "position": [0, 0, 500]}, {"photo": PHOTOS[0], "direction": [0, 3, 4]}]
    file.write_text(json.dumps({"lights": rows}))
    given = read_lights(file, PHOTOS[:1], POSED_CAMERA)
    assert [light.kind for light in given.lights] == ["point", "directional"]
    np.testing.assert_allclose(given.lights[1].direction, [0, 0.6, 0.8])


def test_a_list_with_sigmas_is_weighed_against_what_the_photos_say(tmp_path):
    file = tmp_path / "lights.json"
    shading = tuple(replace(light, sigma=np.full(3, 3.0)) for light in LIGHTS)
    found = Calibration(CAMERA, WORLD_FROM_CAMERA, 0.0, shading)
    rows = [
        {"photo": PHOTOS[0], "position": (PLACES[0] + [4.0, 0, 0]).tolist(), "sigma": [3.0, 3.0, 3.0]},
        {"photo": PHOTOS[1], "position": (PLACES[1] + [0, 400.0, 0]).tolist(), "sigma": [1.0, 1.0, 1.0]},
    ]
    file.write_text(json.dumps({"lights": rows}))
    opinions = read_opinions(file)
    assert opinions is not None
    mixed = with_opinions(found, opinions, file)
    np.testing.assert_allclose(mixed.lights[0].position, PLACES[0] + [2.0, 0, 0], atol=1e-3)
    np.testing.assert_allclose(mixed.lights[0].sigma, 3 / np.sqrt(2), rtol=1e-3)
    np.testing.assert_array_equal(mixed.lights[2].position, LIGHTS[2].position)  # not in the list
    assert f"contradict each other about {PHOTOS[1]}" in mixed.residuals["notes"][-1]
    assert mixed.lights[1].sigma.max() > 30  # neither is believed as it says
    with pytest.raises(CalibrationError, match="no photo is named other"):
        with_opinions(found, [replace(opinions[0], photo="other.jpg")], file)
    for exact in ({"sigma": [0, 0, 0]}, {"power": [1, 1, 1]}):
        file.write_text(json.dumps({"lights": [rows[0] | exact]}))
        assert read_opinions(file) is None


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.lp", "1\nIMG_0000.jpg 0 0", r"a\.lp, line 2 is 'IMG_0000.jpg 0 0'"),
        ("a.lp", "IMG_9.jpg 0 0 1\nIMG_8.jpg 0 1 1", "lists 2 lights for 4 photos"),
        ("a.json", '{"lights": [{"photo": "IMG_0000.jpg", "position": [1, 2]}]}', r"lights\[0\].position is \[1, 2\]"),
        ("a.json", '{"lights": [{"photo": "IMG_0000.jpg", "position": [1, 2, 3]}]}', "no light for 3 of 4 photos"),
        ("a.json", '{"suns": []}', "of no known kind"),
        ("a.json", "{", "cannot be read as JSON"),
        ("a.npz", "no archive", "cannot be read"),
        ("a.dome", '{"positions3d": [[0, 0, 1]], "directions": []}', "'imageWidth'"),
        ("params.json", json.dumps({"light_pos": [], "pose_c2w": np.eye(4).tolist()}), "one place for each photo"),
    ],
)
def test_a_wrong_file_is_refused_by_what_is_wrong(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(CalibrationError, match=message):
        read_lights(tmp_path / name, PHOTOS, POSED_CAMERA)


@pytest.mark.parametrize(
    ("kind", "sun", "message"),
    [
        ("point", np.eye(4), r"transforms_floor\.json: the floor, 0, lies above the camera"),
        ("directional", np.zeros((4, 4)), r"a\.json: a 'transform_matrix_sun' has no direction"),
    ],
)
def test_a_shadowneus_scene_that_places_nothing_is_refused(tmp_path, kind, sun, message):
    camera = np.eye(4).tolist()  # at the height of the floor
    frames = [{"file_path": p, "transform_matrix": camera, "transform_matrix_sun": sun.tolist()} for p in PHOTOS]
    (tmp_path / "transforms_floor.json").write_text(json.dumps({"frames": [{"transform_ground": camera}]}))
    (tmp_path / "a.json").write_text(json.dumps({"light_type": kind, "frames": frames}))
    with pytest.raises(CalibrationError, match=message):
        read_lights(tmp_path / "a.json", PHOTOS, POSED_CAMERA)


def test_the_power_of_given_lights_comes_from_the_ground_and_wrong_lights_are_noticed():
    truth = photograph(Recipe(n_photos=6))
    strength = np.array([1.0, 0.7, 1.0, 1.4, 1.0, 1.0])
    stack = replace(truth.stack, rgb=(truth.stack.rgb * strength[:, None, None, None] / 2).astype(np.float32))
    isotropic = [replace(light, axis=None, power=np.ones(3)) for light in truth.lights]
    right = with_power_per_photo(isotropic, stack, POSED_CAMERA, np.ones(6, bool))
    power = np.array([light.power[1] for light in right.lights])
    np.testing.assert_allclose(power / np.median(power), strength, rtol=0.25)  # the beams are taken as isotropic
    shuffled = [replace(light, photo=other.photo) for light, other in zip(isotropic, isotropic[::-1], strict=True)]
    wrong = with_power_per_photo(shuffled, stack, POSED_CAMERA, np.ones(6, bool))
    assert right.warning() == "" and right.misfit < SHADING_MISFIT < wrong.misfit
    assert "photos' order" in wrong.warning()


# --- tables and arrays -----------------------------------------------------------------------------------------------


def unit_directions() -> np.ndarray:
    return directions() / np.linalg.norm(directions(), axis=1, keepdims=True)


def angles(vectors):
    return np.arctan2(vectors[:, 1], vectors[:, 0]), np.arcsin(vectors[:, 2])


def angles_of(around: str, second: str) -> dict[str, np.ndarray]:
    """In degrees, one column and one row, the second from the axis of view where it is called theta."""
    azimuth, up = np.degrees(angles(unit_directions()))
    return {around: azimuth[:, None], second: (90 - up if second == "theta" else up)[None]}


@pytest.mark.parametrize(
    ("head", "columns", "kind", "note"),
    [
        ("photo,azimuth,elevation", lambda a, e: np.degrees([a, e]), "directional", "angles in"),
        ("photo,az_rad,el_rad", lambda a, e: [a, e], "directional", "angles in"),
        (
            "image,phi [deg],theta [deg],gain",
            lambda a, e: [np.degrees(a), 90 - np.degrees(e), 0 * a],
            "directional",
            "angles in",
        ),
        ("name,Elevation (deg),Azimuth (deg)", lambda a, e: np.degrees([e, a]), "directional", "angles in"),
        ("photo,x,y,z", lambda *_: directions().T, "point", "as places"),
        ("photo,x_mm,y_mm,z_mm", lambda *_: directions().T, "point", "as places"),
        ("photo,pos_x [cm],pos_y [cm],pos_z [cm]", lambda *_: directions().T / 10, "point", "as places"),
        ("photo,dx,dy,dz", lambda *_: directions().T, "directional", ""),
    ],
)
def test_a_table_is_read_by_its_head(tmp_path, head, columns, kind, note):
    rows = np.transpose(columns(*angles(unit_directions())))
    lines = [f"{photo},{','.join(f'{x:.9f}' for x in row)}" for photo, row in zip(PHOTOS, rows, strict=True)]
    (tmp_path / "a.csv").write_text("\n".join([head, *reversed(lines)]))
    given = read_lights(tmp_path / "a.csv", PHOTOS, POSED_CAMERA)
    assert_lights(given, kind)
    assert not note or any(note in text for text in given.notes)


@pytest.mark.parametrize(
    ("content", "kind"),
    [
        (lambda: {"L": unit_directions(), "mask": np.ones((3, 5)), "note": "by hand"}, "directional"),
        (lambda: {"light_directions": unit_directions().T, "albedo": np.ones((4, 3))}, "directional"),
        (lambda: {"S": directions(), "Dir": unit_directions(), "Phi": np.ones((4, 3))}, "point"),
        (
            lambda: {"light_vectors": unit_directions(), "K": np.eye(3), "light_intensities": np.ones((4, 3))},
            "directional",
        ),
        (lambda: {"LightMatrix": unit_directions().T, "K": np.eye(3)}, "directional"),
        (lambda: {"dirLight": unit_directions(), "R": np.eye(3), "t": np.ones((3, 1))}, "directional"),
        (lambda: {"LED_pos": directions(), "led_power": np.ones((4, 3))}, "point"),
        (lambda: angles_of("azimuth", "elevation") | {"K": np.eye(3)}, "directional"),
        (lambda: angles_of("phi", "theta"), "directional"),
        (lambda: {"anything": np.round(unit_directions(), 4).astype(np.float32)}, "directional"),
    ],
)
def test_arrays_of_matlab_are_read_by_their_usual_names(tmp_path, content, kind):
    for how in ({"do_compression": True}, {"do_compression": False}, {"format": "4"}):
        scipy.io.savemat(tmp_path / "light.mat", content(), **how)
        assert_lights(read_lights(tmp_path / "light.mat", PHOTOS, POSED_CAMERA), kind)


def test_an_array_of_numpy_is_read(tmp_path):
    np.save(tmp_path / "lights.npy", unit_directions())
    assert_towards_the_lights(read_lights(tmp_path / "lights.npy", PHOTOS, POSED_CAMERA))


def bomb(path: Path) -> None:
    """A part of 200 MB in 200 kB."""
    scipy.io.savemat(path, {"L": unit_directions()})
    packed = zlib.compress(bytes(200 << 20))
    path.write_bytes(path.read_bytes()[:128] + (15).to_bytes(4, "little") + len(packed).to_bytes(4, "little") + packed)


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (
            lambda path: scipy.io.savemat(path, {"a": np.ones((2, 2)), "b": np.ones(4)}),
            r"holds a 2 x 2, b 1 x 4; an array",
        ),
        (lambda path: scipy.io.savemat(path, {"L": np.array([{"a": 1}], dtype=object)}), "no array of numbers"),
        (lambda path: scipy.io.savemat(path, {"L": np.full((4, 3), np.nan)}), "L is 4 x 3; three finite numbers"),
        (lambda path: path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\0\2IM\x89HDF"), "version 7.3"),
        (lambda path: path.write_bytes(b"\x89PNG" * 100), "cannot be read as MATLAB's file"),
        (bomb, "unpacks to more than 64 MB"),
    ],
)
def test_a_wrong_matlab_file_is_refused_by_what_is_wrong(tmp_path, write, message):
    write(tmp_path / "light.mat")
    with pytest.raises(CalibrationError, match=message) as refused:
        read_lights(tmp_path / "light.mat", PHOTOS, POSED_CAMERA)
    assert "light.mat" in str(refused.value) and "Lights are read from .lp" in str(refused.value)


def test_ground_that_most_beams_miss_does_not_set_the_scale_of_albedo():
    """There a photo shows the room's light alone, and next to nothing of the flashlight's to divide it by."""
    aside = tuple(replace(light, axis=np.array([0.98, 0.0, -0.2])) for light in LIGHTS)
    for lights in (LIGHTS, aside):
        truth = photograph(Recipe(shadows=False, noise=0.0, lights=lights))
        found = Calibration.of(POSED_CAMERA, lights, beam=LOBE, ambient=np.full(3, AMBIENT), residuals={})
        scaled = on_albedo_scale(found, truth.stack)
        brightest = 0.65 * np.mean([1.0, 0.9, 0.75]) / 0.9  # of the ground, in truth, over what it is set to
        assert scaled.lights[0].power.mean() == pytest.approx(brightest * LIGHTS[0].power.mean(), rel=0.05)
