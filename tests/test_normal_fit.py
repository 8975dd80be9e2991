"""One pixel's normal from few photos."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from reconstruct.shading.noise import Noise
from reconstruct.shading.normal_fit import Pixels, Prior, fit_normals, misfit

ALBEDO = 0.4
LIGHTS = torch.nn.functional.normalize(
    torch.tensor([[0.7, -0.6, 0.6], [-0.6, -0.6, 0.6], [0.1, 0.8, 0.6], [-0.9, 0.1, 0.5], [0.5, -0.1, 0.9]]), dim=-1
)


@pytest.fixture
def normals():
    """Normals that face the first two lights."""
    rng = np.random.default_rng(0)
    around = np.array([0.05, -0.8, 0.6]) + rng.normal(scale=0.25, size=(200, 3))
    return torch.nn.functional.normalize(torch.from_numpy(around).float(), dim=-1)


def seen(normals, lit):
    """What the lights numbered in `lit` show of the normals; the others' light is blocked."""
    n = len(normals)
    value = ALBEDO * (normals @ LIGHTS.T).clamp(min=0)
    value[:, [k for k in range(len(LIGHTS)) if k not in lit]] = 0
    usable = torch.ones(n, len(LIGHTS), dtype=torch.bool)
    towards = LIGHTS.expand(n, -1, -1).contiguous()
    return Pixels(value, usable, towards, torch.ones(n, len(LIGHTS)), torch.zeros(len(LIGHTS)), 0.0, Noise(1e-3, 0.01))


def tilted(normals, degrees):
    """The same, off by so much in some direction."""
    torch.manual_seed(1)
    aside = torch.linalg.cross(normals, torch.randn_like(normals))
    aside = torch.nn.functional.normalize(aside, dim=-1)
    angle = np.radians(degrees)
    return np.cos(angle) * normals + np.sin(angle) * aside


def error(solved, normals):
    """Degrees between albedo * normal and the truth."""
    found = torch.nn.functional.normalize(solved, dim=-1)
    return torch.rad2deg((found * normals).sum(-1).clamp(-1, 1).acos())


def test_two_photos_and_the_neighbours_albedo_give_a_normal(normals):
    prior = Prior(torch.full((len(normals),), ALBEDO), tilted(normals, 20))
    solved, _ = fit_normals(seen(normals, (0, 1)), prior)
    assert error(solved, normals).median() < 9


def test_without_an_albedo_two_photos_do_not(normals):
    solved, _ = fit_normals(seen(normals, (0, 1)))
    assert error(solved, normals).median() > 15


def test_one_photo_leaves_the_normal_near_the_surface(normals):
    prior = Prior(torch.full((len(normals),), ALBEDO), tilted(normals, 10))
    solved, _ = fit_normals(seen(normals, (0,)), prior)
    assert error(solved, normals).median() < 10


def test_many_lit_photos_overrule_albedo_and_surface(normals):
    up = torch.nn.functional.normalize(normals + 2 * LIGHTS.mean(0), dim=-1)
    prior = Prior(torch.full((len(normals),), 0.7 * ALBEDO), tilted(up, 30))
    solved, _ = fit_normals(seen(up, (0, 1, 2, 3, 4)), prior)
    facing = (up @ LIGHTS.T > 0.1).all(1)
    assert facing.sum() > 50
    assert error(solved, up)[facing].median() < 1.5


def test_shadows_are_no_misfit_and_two_surfaces_in_one_pixel_are(normals):
    up = torch.nn.functional.normalize(normals + 2 * LIGHTS.mean(0), dim=-1)
    up = up[(up @ LIGHTS.T > 0.15).all(1)]
    assert misfit(seen(up, range(5)), ALBEDO * up).max() < 0.01
    assert misfit(seen(up, (0, 1, 4)), ALBEDO * up).max() < 0.01
    mixed = seen(up, range(5))
    mixed.value[:, [0, 1]] += torch.tensor([-0.12, 0.3])  # half dark, and lit by something else
    assert misfit(mixed, ALBEDO * up).min() > 3


def test_a_highlight_is_left_out(normals):
    up = torch.nn.functional.normalize(normals + 2 * LIGHTS.mean(0), dim=-1)
    facing = (up @ LIGHTS.T > 0.15).all(1)
    pixels = seen(up[facing], (0, 1, 2, 3, 4))
    pixels.value[:, 4] += 0.5
    prior = Prior(torch.full((int(facing.sum()),), ALBEDO), tilted(up[facing], 20))
    solved, weight = fit_normals(pixels, prior)
    assert error(solved, up[facing]).median() < 4
    assert weight[:, 4].median() < 0.3


def test_a_dark_photo_is_a_surface_turned_away_rather_than_the_shadow_of_something_else():
    rng = np.random.default_rng(1)
    around = torch.from_numpy(np.array([0.0, -0.2, 0.8]) + rng.normal(scale=0.9, size=(3000, 3))).float()
    normals = torch.nn.functional.normalize(around, dim=-1)
    lit_by = (normals @ LIGHTS.T > 0.05).sum(1)  # of five lights; from the others the surface is turned away
    turned = normals[(lit_by == 2) & (normals[:, 2] > 0.05)]
    assert len(turned) > 150
    prior = Prior(torch.full((len(turned),), 0.7 * ALBEDO), None)
    solved, _ = fit_normals(seen(turned, range(5)), prior)  # nothing blocks any light
    assert (error(solved, turned) > 20).float().mean() < 0.1


def test_light_from_the_ground_that_is_weaker_than_was_thought_does_not_turn_the_normals():
    rng = np.random.default_rng(1)
    around = torch.from_numpy(np.array([0.0, -0.3, 0.3]) + rng.normal(scale=0.3, size=(400, 3))).float()
    normals = torch.nn.functional.normalize(around, dim=-1)  # steep: much of what they see is ground
    pixels = seen(normals, (0, 1, 2))
    bounced = 0.4 * ALBEDO * 0.3 * (1 - normals[:, 2:]) / 2  # in every photo; the estimate of 0.3 is too high
    pixels = replace(pixels, value=pixels.value + bounced, bounce=torch.full((len(LIGHTS),), 0.3))
    solved, _ = fit_normals(pixels, Prior(torch.full((len(normals),), ALBEDO), None))
    assert error(solved, normals).median() < 25


def rings_of_lights(count):
    """So many directions around, 45 degrees up."""
    turn = torch.arange(count) * (2 * torch.pi / count) + 0.3
    return torch.nn.functional.normalize(torch.stack([turn.cos(), turn.sin(), torch.full((count,), 0.7)], -1), dim=-1)


def of_eight_lights():
    """400 normals about up that face eight lights, and what those show of them with a little noise."""
    draw, lights = np.random.default_rng(3), rings_of_lights(8)
    around = torch.from_numpy(np.array([0.0, -0.1, 0.9]) + draw.normal(scale=0.35, size=(400, 3))).float()
    normals = torch.nn.functional.normalize(around, dim=-1)
    normals = normals[(normals @ lights.T > 0.1).all(1)]
    value = ALBEDO * normals @ lights.T
    value = value + 1e-3 * torch.randn(value.shape, generator=torch.Generator().manual_seed(0))
    every = torch.ones_like(value)
    towards = lights.expand(len(normals), -1, -1).contiguous()
    return normals, Pixels(value, every.bool(), towards, every, torch.zeros(8), 0.0, Noise(1e-3, 0.01))


def test_shadows_that_are_not_black_are_told_from_lit_samples():
    normals, pixels = of_eight_lights()
    shaded = pixels.value.clone()
    shaded[:, :3] *= 0.3
    prior = Prior(torch.full((len(normals),), 0.8 * ALBEDO), tilted(normals, 20))
    solved, _ = fit_normals(replace(pixels, value=shaded), prior)
    assert error(solved, normals).median() < 11  # degrees; 16 if what is brighter than expected were as unlikely


def test_a_few_bright_highlights_among_many_photos_move_hardly_any_normal():
    normals, pixels = of_eight_lights()
    shiny = pixels.value.clone()
    shiny[:, :1] += 0.2
    prior = Prior(torch.full((len(normals),), 0.8 * ALBEDO), tilted(normals, 20))
    solved, _ = fit_normals(replace(pixels, value=shiny), prior)
    assert error(solved, normals).median() < 1  # degree; 12 if nothing were too bright
