"""One pixel's normal from few photos."""

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from reconstruct.shading.noise import Noise
from reconstruct.shading.normal_fit import Pixels, Prior, fit_normals, normals_of_lit

ALBEDO = 0.4
LIGHTS = normalize(
    torch.tensor([[0.7, -0.6, 0.6], [-0.6, -0.6, 0.6], [0.1, 0.8, 0.6], [-0.9, 0.1, 0.5], [0.5, -0.1, 0.9]]), dim=-1
)


@pytest.fixture
def normals():
    rng = np.random.default_rng(0)
    around = np.array([0.05, -0.8, 0.6]) + rng.normal(scale=0.25, size=(200, 3))
    return normalize(torch.from_numpy(around).float(), dim=-1)


def seen(normals, lit):
    """What the lights numbered in `lit` show of the normals; the others' light is blocked."""
    n = len(normals)
    value = ALBEDO * (normals @ LIGHTS.T).clamp(min=0)
    value[:, [k for k in range(len(LIGHTS)) if k not in lit]] = 0
    usable = torch.ones(n, len(LIGHTS), dtype=torch.bool)
    towards = LIGHTS.expand(n, -1, -1).contiguous()
    return Pixels(value, usable, towards, torch.ones(n, len(LIGHTS)), torch.zeros(len(LIGHTS)), 0.0, Noise(1e-3, 0.01))


def tilted(normals, degrees):
    torch.manual_seed(1)
    aside = torch.linalg.cross(normals, torch.randn_like(normals))
    aside = normalize(aside, dim=-1)
    angle = np.radians(degrees)
    return np.cos(angle) * normals + np.sin(angle) * aside


def degrees(found, true):
    """Angles between vectors, of which the true ones have length 1."""
    return torch.rad2deg((normalize(found, dim=-1) * true).sum(-1).clamp(-1, 1).acos())


def test_two_photos_and_the_neighbours_albedo_give_a_normal(normals):
    prior = Prior(torch.full((len(normals),), ALBEDO), tilted(normals, 20))
    solved, _ = fit_normals(seen(normals, (0, 1)), prior)
    assert degrees(solved, normals).median() < 9


def test_a_dark_photo_is_a_surface_turned_away_rather_than_the_shadow_of_something_else():
    rng = np.random.default_rng(1)
    around = torch.from_numpy(np.array([0.0, -0.2, 0.8]) + rng.normal(scale=0.9, size=(3000, 3))).float()
    normals = normalize(around, dim=-1)
    lit_by = (normals @ LIGHTS.T > 0.05).sum(1)  # of five lights; from the others the surface is turned away
    turned = normals[(lit_by == 2) & (normals[:, 2] > 0.05)]
    assert len(turned) > 150
    prior = Prior(torch.full((len(turned),), 0.7 * ALBEDO), None)
    solved, _ = fit_normals(seen(turned, range(5)), prior)  # nothing blocks any light
    assert (degrees(solved, turned) > 20).float().mean() < 0.1


# --- from light and shadow alone -------------------------------------------------------------------------------------


RAY = torch.tensor([0.0, 0.6, -0.8])


def sky(count: int, lowest: float = 15, highest: float = 75) -> torch.Tensor:
    """Directions over the sky, degrees high."""
    share = (torch.arange(count) + 0.5) / count
    sine = np.sin(np.radians(lowest)) * (1 - share) + np.sin(np.radians(highest)) * share
    azimuth, level = torch.arange(count) * 2.4, (1 - sine**2).sqrt()
    return torch.stack([level * azimuth.cos(), level * azimuth.sin(), sine], -1)


def seen_normals(count: int) -> torch.Tensor:
    """Normals of a ball that the camera sees and that face up."""
    drawn = torch.randn(20 * count, 3, generator=torch.Generator().manual_seed(0))
    drawn = normalize(drawn, dim=-1)
    return drawn[(drawn @ RAY < -0.2) & (drawn[:, 2] > 0.2)][:count]


def read(true: torch.Tensor, towards: torch.Tensor, lit: torch.Tensor, free: torch.Tensor):
    n = len(true)
    everywhere = towards[:, None].expand(-1, n, 3)
    return normals_of_lit(lit, torch.ones(lit.shape), everywhere, free, RAY.expand(n, 3))


@pytest.mark.parametrize(("count", "error"), [(20, 10), (40, 7)])
def test_normals_of_a_ball_without_cast_shadows(count, error):
    true, towards = seen_normals(300), sky(count)
    lit = (towards @ true.T > 0).float()
    normal, confidence = read(true, towards, lit, torch.ones(lit.shape))
    sure = confidence > 0.5
    assert sure.float().mean() > 0.3
    assert degrees(normal, true)[sure].mean() < error


def test_a_cast_shadow_behind_known_matter_turns_no_normal_and_few_lights_leave_it_open():
    true, towards = torch.tensor([[0.0, 0, 1]]), sky(40)
    lit = torch.ones(40, 1)
    lit[towards[:, 0] > 0.5] = 0  # something stands on that side
    turned, _ = read(true, towards, lit, torch.ones(40, 1))
    kept, _ = read(true, towards, lit, lit)
    assert degrees(kept, true)[0] < 16 < 24 < degrees(turned, true)[0]
    towards = sky(4, 40, 50)
    _, confidence = read(torch.tensor([[0.0, 0, 1]]), towards, torch.ones(4, 1), torch.ones(4, 1))
    assert confidence[0] < 0.1
