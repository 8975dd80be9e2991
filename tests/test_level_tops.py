"""Level tops and the ground beside them, under near and far lights; truth from geometry."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from synthetic import Box, Look, Sphere, render

from reconstruct.labels import ground_test as ground_module
from reconstruct.labels.level_tops import heights_from_fall_off, slopes
from reconstruct.scene import ground_points, irradiance

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


def iou(found, truth) -> float:
    mask = found.mask.numpy() > 0.5
    return (mask & truth.mask).sum() / (mask | truth.mask).sum()


@pytest.mark.parametrize("height", [3.5, 5.0, 30.0])
def test_the_level_top_of_a_box_coloured_like_the_ground_is_object_under_near_lights(height):
    scene, truth = render((slab(height),), NOISY)
    found = ground_module.test_ground(scene)
    assert shares(found, truth)[0] > 0.97 and iou(found, truth) > 0.97


def test_textured_ground_stays_ground_around_and_between_objects():
    shapes = (Sphere((-30.0, 0.0, 30.0), 30.0), Box((25.0, -20.0, 0.0), (60.0, 20.0, 90.0)))
    scene, truth = render(shapes, replace(NOISY, texture=0.4, ambient=0.05))
    found = ground_module.test_ground(scene)
    bare = ~truth.mask & (found.mask.numpy() < 0.5)
    assert iou(found, truth) > 0.97
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
