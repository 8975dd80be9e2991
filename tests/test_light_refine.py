"""Lights that move with the surface: the gradient they follow, the motion no shadow shows, and where they end."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from dataset_folders import calibrated
from synthetic import BALL, HEAP, Look, grid_of, render
from test_known import write_scene

from capture.errors import CaptureError
from reconstruct.config import FitConfig, Level
from reconstruct.labels.held_out import HeldOut, draw_blocks, hold_out
from reconstruct.labels.observer import Observer
from reconstruct.labels.supervision import supervise
from reconstruct.solve.level import LevelFit
from reconstruct.solve.light_refine import FIRST_ITERATION, LightShift, MovingLights, lit_from, no_shift, unseen_motion
from reconstruct.solve.trials import judge, try_lights
from reconstruct.source.source import RunOptions, open_source

RICH = FitConfig(levels=(Level(32, 40, (0.5, 0.4), 3, 5e-4), Level(48, 30, (0.4, 0.1), 2)), votes=1)


def misplaced(scene, relative: float, seed: int = 5):
    """The scene with every light off by `relative` of its distance (or radians) in a random direction, and told so."""
    rng = np.random.default_rng(seed)
    lights = scene.lights.double().numpy()
    by = rng.standard_normal((len(lights), 3))
    is_point = lights[:, 3:] > 0
    by -= ~is_point * (by * lights[:, :3]).sum(1, keepdims=True) * lights[:, :3]
    distance = np.linalg.norm(lights[:, :3], axis=1, keepdims=True)
    moved = lights[:, :3] + relative * distance * by / np.linalg.norm(by, axis=1, keepdims=True)
    moved = np.where(is_point, moved, moved / np.linalg.norm(moved, axis=1, keepdims=True))
    sigma = np.broadcast_to(relative * distance / np.sqrt(3), moved.shape)
    tensors = {"lights": np.concatenate([moved, lights[:, 3:]], 1), "light_sigma": sigma}
    return replace(scene, **{name: torch.from_numpy(np.array(value)).float() for name, value in tensors.items()})


def test_a_homology_about_the_eye_keeps_what_is_in_line():
    scene, _ = render((BALL,), Look(n_lights=6))
    scene = replace(scene, light_sigma=torch.ones(6, 3))
    eye, lights = scene.eye.double().numpy(), scene.lights.double().numpy()[:, :3]
    small = 1e-9  # moves the lights by some 1e-4 mm
    moved = lights + small * unseen_motion(scene)
    for light, light_moved in zip(lights, moved, strict=True):
        foot = np.array([30.0, -20.0, 0.0])
        blocker = foot + 0.2 * (light - foot)
        blocker_moved = blocker + small * blocker[2] * (eye - blocker)
        away = np.cross(blocker_moved - foot, light_moved - foot)
        alone = np.cross(blocker - foot, light_moved - foot)
        assert np.linalg.norm(away) < 1e-3 * np.linalg.norm(alone)  # of second order


def test_a_known_light_never_moves_and_an_uncertain_one_against_its_gradient_as_long_as_that_pulls():
    scene, _ = render((BALL,), Look(n_lights=16))
    sigma = torch.full((16, 3), 5.0)
    sigma[0], sigma[2, 2] = 0.0, 0.0
    scene = replace(scene, light_sigma=sigma)
    lights = MovingLights(scene, no_shift(scene))
    gradient = np.zeros((16, 4))
    gradient[[0, 2, 3]] = [1.0, 0.0, 1.0, 2.0]
    lights.follow(gradient, 0.5, FIRST_ITERATION - 1)
    assert not lights.shift.shift.any()
    for i in range(20):
        lights.follow(gradient, 0.5, FIRST_ITERATION + i)
    shift = (lit_from(scene, lights.shift).lights - scene.lights)[:, :3].numpy()
    assert not shift[0].any() and shift[2, 2] == 0
    assert shift[2, 0] < 0 and shift[3, 0] < 0 and shift[3, 2] < 0
    assert np.abs(shift.mean(0)).max() < 0.1 * np.abs(shift).max()  # all together they stay
    astray = np.linalg.norm(lights.shift.shift, axis=1).max()
    assert 1 < astray <= 3.0 + 1e-9
    for i in range(150):
        lights.follow(np.zeros((16, 4)), 0.5, FIRST_ITERATION + 20 + i)
    assert np.linalg.norm(lights.shift.shift, axis=1).max() < 0.1 * astray  # back to where they were calibrated


def test_a_direction_stays_a_unit_vector():
    scene, _ = render((BALL,), Look(n_lights=4, kind="directional"))
    scene = replace(scene, light_sigma=torch.full((4, 3), 0.02))
    turned = lit_from(scene, LightShift(np.ones((4, 3)), np.zeros((4, 3))))
    torch.testing.assert_close(turned.lights.norm(dim=1), torch.ones(4))
    assert (turned.lights != scene.lights).any(1).all()


def tried(scene, surface, shift):
    """The verdict on lights moved from those of a scene, whose own labels are read on the given surface."""
    level = Level(48, 24, (0.4, 0.3), 1)
    rays = supervise(scene, Observer(scene).labels(surface, scene))
    rays, held_out = hold_out(rays, draw_blocks(rays.pixels, scene.camera.width, len(scene.lights), 0))
    sides = (LightShift(shift, np.zeros_like(shift)), no_shift(scene))
    return try_lights(LevelFit(scene, rays, held_out, level, RICH), surface, *sides, None)


def test_a_wrong_refinement_is_rejected_and_a_right_one_accepted():
    scene = replace(render(HEAP, Look(with_shadow=True, with_mask=True, n_lights=24))[0], rgb=None)
    wrong = misplaced(scene, 0.06)
    by = ((wrong.lights - scene.lights)[:, :3] / wrong.light_sigma).double().numpy()
    surface = grid_of(HEAP, 3.0)
    astray, kept = tried(replace(scene, light_sigma=wrong.light_sigma), surface, by)
    assert astray.refined > astray.calibrated and not astray.is_accepted and "are not kept" in astray.sentence()
    back, left = tried(wrong, surface, -by)
    assert back.refined < back.calibrated and back.is_accepted and "are kept" in back.sentence()
    tenth = 0.1 * kept.spacing  # rounding decides whether a ray at the limit of its margin is cast
    torch.testing.assert_close(kept.values, left.values, rtol=0, atol=tenth)  # both settled under the true lights


def test_what_chance_may_do_is_not_accepted():
    photo, ones = np.repeat(np.arange(10), 50), np.ones(500)
    held_out = HeldOut(photo, np.zeros(500, int), ones, ones, torch.zeros(1, 3), torch.zeros(1))
    before, by_photo = np.full(500, 0.1), np.repeat(np.random.default_rng(0).standard_normal(10), 50)
    assert not judge(held_out, before, before, 10).is_accepted
    noisy = judge(held_out, before, before - 0.001 + 0.01 * by_photo, 10)
    assert noisy.refined < noisy.calibrated and not noisy.is_accepted
    assert noisy.noise == pytest.approx(0.01 / np.sqrt(10), rel=0.5)
    assert judge(held_out, before, before - 0.02 + 0.01 * by_photo, 10).is_accepted
    alone = replace(held_out, photo=np.zeros(500, int))
    assert not judge(alone, before, before - 0.05, 10).is_accepted  # of one photo nobody knows the noise


def test_a_stated_light_error_makes_known_lights_uncertain(tmp_path):
    write_scene(tmp_path / "scene", light_type="point")
    for light in calibrated(tmp_path / "scene", light_error=0.03)[2].lights:
        assert light.position is not None
        distance = np.linalg.norm(light.position)  # the camera looks at the ground 15 mm beside the origin
        assert np.linalg.norm(light.sigma) == pytest.approx(0.03 * distance, rel=0.05)
    with pytest.raises(CaptureError, match="--light-error 3"):
        open_source(tmp_path / "scene", RunOptions(light_error=3.0))
