"""Truth: normals of planes and balls under known lights, without and with cast shadows."""

import numpy as np
import pytest
import torch

from reconstruct.shading.normal_fit import normals_of_lit

RAY = torch.tensor([0.0, 0.6, -0.8])


def lights(count: int, lowest: float = 15, highest: float = 75) -> torch.Tensor:
    """Directions over the sky, degrees high."""
    share = (torch.arange(count) + 0.5) / count
    sine = np.sin(np.radians(lowest)) * (1 - share) + np.sin(np.radians(highest)) * share
    azimuth, level = torch.arange(count) * 2.4, (1 - sine**2).sqrt()
    return torch.stack([level * azimuth.cos(), level * azimuth.sin(), sine], -1)


def seen_normals(count: int) -> torch.Tensor:
    """Normals of a ball that the camera sees and that face up."""
    drawn = torch.randn(20 * count, 3, generator=torch.Generator().manual_seed(0))
    drawn = torch.nn.functional.normalize(drawn, dim=-1)
    return drawn[(drawn @ RAY < -0.2) & (drawn[:, 2] > 0.2)][:count]


def read(true: torch.Tensor, towards: torch.Tensor, lit: torch.Tensor, free: torch.Tensor):
    n = len(true)
    everywhere = towards[:, None].expand(-1, n, 3)
    return normals_of_lit(lit, torch.ones(lit.shape), everywhere, free, RAY.expand(n, 3))


def angles(a: torch.Tensor, b: torch.Tensor) -> np.ndarray:
    return np.degrees(np.arccos((a * b).sum(-1).clamp(-1, 1).numpy()))


@pytest.mark.parametrize(("count", "error"), [(20, 10), (40, 7)])
def test_normals_of_a_ball_without_cast_shadows(count, error):
    true, towards = seen_normals(300), lights(count)
    lit = (towards @ true.T > 0).float()
    normal, confidence = read(true, towards, lit, torch.ones(lit.shape))
    sure = confidence > 0.5
    assert sure.float().mean() > 0.3
    assert angles(normal, true)[sure.numpy()].mean() < error


def test_a_cast_shadow_behind_known_matter_turns_no_normal():
    true, towards = torch.tensor([[0.0, 0, 1]]), lights(40)
    lit = torch.ones(40, 1)
    lit[towards[:, 0] > 0.5] = 0  # something stands on that side
    turned, _ = read(true, towards, lit, torch.ones(40, 1))
    kept, _ = read(true, towards, lit, lit)
    assert angles(kept, true)[0] < 16 < 24 < angles(turned, true)[0]


def test_few_lights_on_one_side_leave_the_normal_open():
    towards = lights(4, 40, 50)
    _, confidence = read(torch.tensor([[0.0, 0, 1]]), towards, torch.ones(4, 1), torch.ones(4, 1))
    assert confidence[0] < 0.1
