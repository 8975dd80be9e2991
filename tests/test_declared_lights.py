"""Lights from the shadows of pegs and cubes: photos by the formula, shadows by ray tests of their own."""

from dataclasses import replace

import numpy as np
import pytest
from flashlight_photos import CAMERA, POSED_CAMERA, WORLD_FROM_CAMERA, Recipe, Truth, handheld_lights, photograph

from calibration.flashlight.light_estimate import LightFit
from calibration.flashlight.solids import fuse_shadow_lights, locate_sun
from calibration.light import Light
from calibration.lights.fusion import fuse
from capture.errors import CalibrationError, CaptureError
from capture.session.declared_objects import Solid
from capture.session.session import load_settings

PEGS = tuple(Solid(x, y, 70.0, 10.0) for x, y in ((-110.0, -60.0), (150.0, -70.0), (-90.0, 130.0), (140.0, 140.0)))
CUBE = Solid(-110.0, -20.0, 50.0, 50.0, 0.4, is_round=False)
LEFT = 0.05  # of the light in a shadow


def hidden(points: np.ndarray, solid: Solid, place: np.ndarray) -> np.ndarray:
    """Whether the solid stands between ground points (x, y) and a homogeneous place, by its plan seen from above."""
    turn = np.array([[np.cos(solid.turn), -np.sin(solid.turn)], [np.sin(solid.turn), np.cos(solid.turn)]])
    start = (points - [solid.x, solid.y]) @ turn
    run = (place[:2] - place[3] * points) @ turn * (solid.height / place[2])  # until the ray is above the solid
    if solid.is_round:
        t = np.clip(-(start * run).sum(1) / np.maximum((run**2).sum(1), 1e-12), 0, 1)
        return np.linalg.norm(start + t[:, None] * run, axis=1) < solid.width / 2
    a, b = ((sign * solid.width / 2 - start) / np.where(run == 0, 1e-12, run) for sign in (-1, 1))
    return np.maximum(np.minimum(a, b).max(1), 0) < np.minimum(np.maximum(a, b).min(1), 1)


def around(points: np.ndarray, solid: Solid, place: np.ndarray) -> np.ndarray:
    """Indices of the ground points in the rectangle around a solid and its shadow: all others see the place."""
    foot = np.array([solid.x, solid.y])
    tip = foot + (place[3] * foot - place[:2]) * solid.height / (place[2] - place[3] * solid.height)
    low, high = np.minimum(foot, tip) - 2 * solid.width, np.maximum(foot, tip) + 2 * solid.width
    return np.flatnonzero(((points > low) & (points < high)).all(1))


def with_solids(truth: Truth, solids: tuple[Solid, ...]) -> Truth:
    """The photos with solids in them; a pixel is the mean of nine rays."""
    rgb = truth.stack.rgb.copy()
    height, width = rgb.shape[1:3]
    camera, eye = CAMERA.resized(width, height), WORLD_FROM_CAMERA.translation
    lit = np.ones((len(rgb), height * width))
    seen = np.zeros(height * width, bool)
    for du in (-1 / 3, 0, 1 / 3):
        for dv in (-1 / 3, 0, 1 / 3):
            pixels = camera.pixel_grid().reshape(-1, 2) + np.array([du, dv])
            rays = WORLD_FROM_CAMERA.rotate(camera.unproject(pixels))
            points = (eye - eye[2] / np.minimum(rays[:, 2:], -1e-3) * rays)[:, :2]
            for solid in solids:
                near = around(points, solid, np.append(eye, 1.0))
                seen[near] |= hidden(points[near], solid, np.append(eye, 1.0))
            for k, light in enumerate(truth.lights):
                dark = np.zeros(len(points), bool)
                for solid in solids:
                    near = around(points, solid, light.homogeneous())
                    dark[near] |= hidden(points[near], solid, light.homogeneous())
                lit[k] -= (1 - LEFT) * dark / 9
    rgb *= lit.reshape(len(rgb), height, width, 1).astype(np.float32)
    rgb[:, seen.reshape(height, width)] = 0.2
    return Truth(replace(truth.stack, rgb=np.maximum(rgb, 1e-4)), truth.lights)


def misplaced(truth: Truth, relative: float) -> LightFit:
    """What shading might have found: every light off in a random direction, and its sigma says so."""
    rng = np.random.default_rng(4)
    lights = []
    for light in truth.lights:
        assert light.position is not None
        size = relative * float(np.linalg.norm(light.position))
        by = size / np.sqrt(3) * rng.normal(size=3)
        lights.append(replace(light, position=light.position + by, sigma=np.full(3, size / np.sqrt(3))))
    return LightFit(tuple(lights), (2.2, 0.8, -0.4, 0.9), np.full(3, 0.012))


@pytest.fixture(scope="module")
def pegs() -> Truth:
    lights = handheld_lights(5, np.random.default_rng(1))
    return with_solids(photograph(Recipe(lights=lights, width=480)), PEGS)


def test_four_pegs_halve_the_error_of_the_shading_and_the_result_says_how_well(pegs):
    rough = misplaced(pegs, 0.03)
    fine, notes = fuse_shadow_lights(rough, pegs.stack, POSED_CAMERA, PEGS)
    assert np.median(pegs.errors(fine.lights)) < 0.5 * np.median(pegs.errors(rough.lights))
    assert pegs.share_inside(fine.lights) > 0.85
    assert "5 of 5" in notes[0]


@pytest.mark.slow
def test_one_cube_gives_the_direction():
    truth = with_solids(photograph(Recipe(lights=handheld_lights(4, np.random.default_rng(3)), width=480)), (CUBE,))
    rough = misplaced(truth, 0.04)
    fine, _ = fuse_shadow_lights(rough, truth.stack, POSED_CAMERA, (CUBE,))
    foot = np.array([CUBE.x, CUBE.y, 0.0])
    true = np.array([light.position for light in truth.lights], float) - foot
    angle = []
    for fit in (rough, fine):
        found = np.array([light.position for light in fit.lights], float) - foot
        cosine = (found * true).sum(1) / np.linalg.norm(found, axis=1) / np.linalg.norm(true, axis=1)
        angle.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    assert np.median(angle[1]) < 0.5 < np.median(angle[0])


def test_opinions_count_by_their_covariance_and_contradictions_widen_the_result():
    near, far = np.zeros(3), np.array([0.0, 0.0, 30.0])
    sure, rough = np.diag([1.0, 1.0, 100.0]), np.diag([100.0, 100.0, 1.0])
    place, covariance, contradict = fuse([near, far], [sure, rough])
    np.testing.assert_allclose(place, [0.0, 0.0, 30.0 * 100 / 101], atol=1e-6)
    assert not contradict and covariance[0, 0] < 3
    _, wide, _ = fuse([near, far], [sure, np.eye(3)])
    assert fuse([near, far], [np.eye(3), np.eye(3)])[2]
    assert wide[2, 2] > np.linalg.inv(np.linalg.inv(sure) + np.eye(3))[2, 2]


def test_session_toml_declares_pegs_cubes_and_a_sun(tmp_path):
    text = """light = "sun"
[[pegs]]
at_mm = [10, -20]
height_mm = 50
diameter_mm = 5
[[cubes]]
at_mm = [100, 0]
side_mm = 60
turn_deg = 90
"""
    (tmp_path / "session.toml").write_text(text)
    declared = load_settings(tmp_path)
    assert declared.light == "sun"
    assert declared.solids[0] == Solid(10.0, -20.0, 50.0, 5.0)
    assert declared.solids[1].height == 60.0 and declared.solids[1].turn == pytest.approx(np.pi / 2)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('light = "lamp"', "light is 'lamp'; needed: flashlight or sun"),
        ("lights_at_once = 9", "lights_at_once is 9; needed: a whole number of at most 4"),
        ("[[pegs]]\nat_mm = [1, 2]\nheight_mm = 0\ndiameter_mm = 5", r"pegs\[0\].height_mm is 0; needed: a length"),
        ("[[pegs]]\nat_mm = [1]\nheight_mm = 5\ndiameter_mm = 5", "x and y on the board"),
        ("[[cubes]]\nat_mm = [1, 2]\nheight_mm = 5", "unknown entry 'height_mm'"),
    ],
)
def test_a_wrong_declaration_is_refused_by_its_name(tmp_path, text, message):
    (tmp_path / "session.toml").write_text(text)
    with pytest.raises(CaptureError, match=message):
        load_settings(tmp_path)


def suns(n: int) -> tuple[Light, ...]:
    """Directions all around, 25 to 60 degrees high."""
    rng = np.random.default_rng(5)
    out = []
    for k in range(n):
        azimuth, elevation = 2 * np.pi * k / n, np.radians(rng.uniform(25, 60))
        flat = np.cos(elevation) * np.array([np.cos(azimuth), np.sin(azimuth)])
        out.append(
            Light(f"S_{k}.jpg", "directional", direction=np.append(flat, np.sin(elevation)), power=np.full(3, 0.7))
        )
    return tuple(out)


@pytest.mark.slow  # 12 s
def test_a_sun_is_found_from_the_shadow_of_a_peg_alone():
    lights = suns(4)
    truth = with_solids(photograph(Recipe(lights=lights, shadows=False, width=480)), PEGS[:2])
    found = locate_sun(truth.stack, POSED_CAMERA, np.ones(4, bool), PEGS[:2])
    true = np.array([light.direction for light in lights], float)
    seen = np.array([light.direction for light in found.lights], float)
    angle = np.degrees(np.arccos(np.clip((seen * true).sum(1), -1, 1)))
    assert all(light.used for light in found.lights)
    assert np.median(angle) < 0.5 and angle.max() < 1.5
    sigma = np.degrees([np.linalg.norm(light.sigma) for light in found.lights])
    assert (angle < 2.5 * sigma).mean() > 0.8
    power = np.array([light.power for light in found.lights])
    np.testing.assert_allclose(power / power.mean(0), 1.0, atol=0.1)


def test_a_sun_without_a_declared_object_is_refused():
    truth = photograph(Recipe(lights=suns(4), shadows=False))
    with pytest.raises(CalibrationError, match="declares no object"):
        locate_sun(truth.stack, POSED_CAMERA, np.ones(4, bool), ())
