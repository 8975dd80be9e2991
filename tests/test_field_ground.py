"""Labels, outline and powers from the ground's field of light, where no model of the light explains the photos."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from synthetic import HEAP, Box, Look, Sphere, render

from calibration.ground.shadow_reach import most_height, shadow_reach
from reconstruct.labels import ground_test as ground_module
from reconstruct.labels.field_ground_test import label_ground
from reconstruct.labels.ground_test import test_ground as by_the_lights
from reconstruct.labels.level_tops import heights_from_fall_off, slopes
from reconstruct.scene import Scene, ground_points, irradiance

LOOK = Look(width=160, height=120, n_lights=20, texture=0.2, ambient=0.05)


def spotted(scene: Scene, seed: int = 0) -> tuple[Scene, np.ndarray]:
    """Give every photo a hot spot in another place and a power of its own; return their gain.

    Nothing is saturated, and a tone curve lifts the shadows.
    """
    assert scene.rgb is not None
    rng = np.random.default_rng(seed)
    height, width = scene.directions.shape[:2]
    v, u = np.meshgrid(np.linspace(-0.75, 0.75, height), np.linspace(-1, 1, width), indexing="ij")
    at, power = rng.uniform(-0.4, 0.4, (len(scene.rgb), 2, 1, 1)), np.exp(rng.normal(0, 0.3, (len(scene.rgb), 1, 1)))
    away = (u - at[:, 0]) ** 2 + (v - at[:, 1]) ** 2
    gain = power * (0.25 + np.exp(-away / (2 * 0.5**2)))
    rgb = 0.6 * (scene.rgb * torch.from_numpy(gain / gain.max()).float()[..., None]).clamp(min=0) ** 0.9
    return replace(scene, rgb=rgb), gain


@pytest.fixture(scope="module")
def heap():
    scene, truth = render(HEAP, LOOK)
    return spotted(scene)[0], truth


def test_the_field_labels_what_the_lights_model_cannot(heap):
    scene, truth = heap
    assert by_the_lights(scene).explained < 0.5
    found = label_ground(scene)
    assert truth.overlap(found.mask) > 0.9
    assert truth.wrong(found) < 0.02
    dark = (truth.visibility == 0) & ~truth.mask
    assert (found.confidence.numpy()[dark] > 0.25).mean() > 0.5
    assert found.albedo.isfinite().all()


def test_shadows_lie_where_they_can_reach():
    scene, truth = render(HEAP, LOOK)
    points = ground_points(scene).double().numpy()
    eye, lights = scene.eye.double().numpy(), scene.lights.double().numpy()
    outline = points[truth.mask]
    reached = shadow_reach(eye, outline, lights, points)
    dark = (truth.visibility == 0) & ~truth.mask
    assert reached[dark].mean() > 0.999
    assert reached[~dark].mean() < 0.9
    assert most_height(eye, outline) >= 70  # of the heap
    assert not shadow_reach(eye, outline, lights, np.full((2, 3), np.nan)).any()


def before_a_wall(scene: Scene) -> Scene:
    """Let another surface, lit in each photo in its own way, fill the upper part; and change the photos' powers."""
    assert scene.rgb is not None
    rng = np.random.default_rng(0)
    light, power = rng.normal(0, 0.6, len(scene.rgb)), np.exp(rng.normal(0, 0.12, len(scene.rgb)))
    rgb = scene.rgb.clone()
    wall = round(0.42 * scene.directions.shape[0])
    rgb[:, :wall] = torch.from_numpy(0.2 * np.exp(light)).float()[:, None, None, None]
    return replace(scene, rgb=rgb * torch.from_numpy(power).float()[:, None, None, None])


def test_an_object_nearly_black_is_no_ground_in_shadow():
    """The lights' model finds an albedo and a shadow for each of its pixels."""
    ball = Sphere((0.0, -50.0, 20.0), 20.0, (0.02, 0.02, 0.02))
    scene, truth = render((ball,), replace(LOOK, noise=0.01))
    scene = before_a_wall(scene)
    assert truth.overlap(by_the_lights(scene).mask) < 0.5
    found = label_ground(scene)
    assert truth.overlap(found.mask) > 0.95
    assert (found.confidence.numpy() * truth.mask)[:, found.mask.numpy() > 0.5].max() < 0.05  # no shadows on it


# --- level tops ------------------------------------------------------------------------------------------------------


NOISY = Look(width=240, height=180, n_lights=24, texture=0.15, noise=0.005)
LIKE_GROUND = (0.6, 0.6, 0.6)
WHOLE = (slice(None), slice(None))


def slab(height: float, albedo: tuple[float, float, float] = LIKE_GROUND) -> Box:
    return Box((-40.0, -30.0, 0.0), (40.0, 30.0, height), albedo)


def shares(found, truth) -> tuple[float, float]:
    """Of the level top: the share found as object, and the share that is called sure ground."""
    top = truth.mask & (truth.normals[..., 2] > 0.99)
    ground = (found.mask < 0.5) & (found.mask_confidence > 0)
    return float((found.mask.numpy() > 0.5)[top].mean()), float(ground.numpy()[top].mean())


@pytest.mark.parametrize("height", [3.5, 30.0])
def test_the_level_top_of_a_box_coloured_like_the_ground_is_object_under_near_lights(height):
    scene, truth = render((slab(height),), NOISY)
    found = ground_module.test_ground(scene)
    assert shares(found, truth)[0] > 0.97 and truth.overlap(found.mask) > 0.97


def test_textured_ground_stays_ground_around_and_between_objects():
    shapes = (Sphere((-30.0, 0.0, 30.0), 30.0), Box((25.0, -20.0, 0.0), (60.0, 20.0, 90.0)))
    scene, truth = render(shapes, replace(NOISY, texture=0.4, ambient=0.05))
    found = ground_module.test_ground(scene)
    bare = ~truth.mask & (found.mask.numpy() < 0.5)
    assert truth.overlap(found.mask) > 0.97
    assert (found.mask_confidence.numpy() > 0)[bare].mean() > 0.995


@pytest.mark.parametrize("kind", ["point", "directional"])
def test_a_sheet_of_another_colour_under_the_object_is_ground(kind):
    ball, sheet = Sphere((0.0, 0.0, 32.0), 30.0), Box((-50.0, -45.0, 0.0), (50.0, 45.0, 0.1), (0.8, 0.6, 0.3))
    scene, truth = render((ball, sheet), replace(NOISY, kind=kind))
    _, ground = shares(ground_module.test_ground(scene), truth)
    assert ground > 0.97


def test_a_level_top_of_another_colour_among_object_pixels_carves_nothing_where_light_does_not_fall_off():
    red = (0.6, 0.3, 0.2)
    plinth, walls = slab(15.0, red), (Box((-40, 10, 15), (40, 30, 60)), Box((-40, -30, 15), (-25, 10, 60)))
    scene, truth = render((plinth, *walls), replace(NOISY, kind="directional"))
    found = ground_module.test_ground(scene)
    top = truth.mask & (np.abs(truth.points[..., 2] - 15) < 0.1) & (truth.normals[..., 2] > 0.99)
    ground = ((found.mask < 0.5) & (found.mask_confidence > 0)).numpy()
    assert ground[top].mean() < 0.1


def test_heights_are_read_off_the_fall_off_in_any_unit():
    scene, truth = render((slab(20.0),), replace(NOISY, texture=0.0))
    assert scene.rgb is not None
    towards, strength = irradiance(scene, ground_points(scene).reshape(-1, 3))
    expected = (strength.mean(-1) * towards[..., 2]).reshape(scene.rgb.shape[:3])
    top = truth.mask & (truth.normals[..., 2] > 0.99)
    relative = scene.rgb.mean(-1) / (0.6 * expected)
    seen = torch.tensor(truth.visibility > 0)
    found = heights_from_fall_off(relative, seen, slopes(scene, WHOLE), torch.tensor(top), 2)
    height = found.height.numpy()[top] * 368
    assert abs(np.median(height) - 20) < 2  # the slope is that at the ground, and the true curve bends
    scatter, stated = height.std(), np.median(found.sigma.numpy()[top]) * 368
    assert 0.5 * scatter < stated < 2 * scatter
