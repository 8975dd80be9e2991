"""One pixel's normal from few photos."""

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
