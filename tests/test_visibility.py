"""Differentiable visibility against finite differences and the solver's kernels."""

import pytest
import torch
from torch import Tensor

from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.rays import visibility
from reconstruct.torch_sdf.autograd import transmittance

NODES, SPACING = 36, 0.25
ORIGIN = torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64)
CENTRE, RADIUS = ORIGIN + 0.5 * (NODES - 1) * SPACING, 2.4
SHARPNESS = 2.0 / SPACING
pytestmark = pytest.mark.usefixtures("one_thread")


def ball(radius: float | Tensor = RADIUS, real: torch.dtype = torch.float64) -> SdfGrid:
    axis = torch.arange(NODES, dtype=torch.float64) * SPACING
    nodes = torch.cartesian_prod(axis, axis, axis).reshape(NODES, NODES, NODES, 3) + ORIGIN
    values = torch.linalg.vector_norm(nodes - CENTRE, dim=-1) - radius
    return SdfGrid(values.to(real), ORIGIN.to(real), SPACING)


def grey_rays(count: int, kind: str) -> tuple[Tensor, Tensor]:
    """Points outside a ball and lights that it half hides from them."""
    generator = torch.Generator().manual_seed(4)
    starts, ends = CENTRE + 8 * (torch.rand(2, 40 * count, 3, generator=generator, dtype=torch.float64) - 0.5)
    outside = (starts - CENTRE).norm(dim=-1) > RADIUS + 2 * SPACING
    starts, ends = starts[outside], ends[outside]
    lights = torch.cat([ends, torch.ones(len(ends), 1, dtype=torch.float64)], 1)
    if kind == "directional":
        lights = torch.cat([1.7 * (ends - starts), torch.zeros(len(ends), 1, dtype=torch.float64)], 1)
    seen = transmittance(ball(), starts, lights, SHARPNESS)
    grey = ((seen > 0.1) & (seen < 0.9)).nonzero()[:count, 0]
    assert len(grey) == count
    return starts[grey], lights[grey]


def test_visibility_is_the_kernels_value():
    starts, lights = grey_rays(60, "point")
    grid = ball(real=torch.float32)
    expected = visibility(grid, starts.float(), lights.float(), SHARPNESS)
    found = transmittance(grid, starts.float(), lights.float(), SHARPNESS)
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=0)


@pytest.mark.parametrize("kind", ["point", "directional"])
@pytest.mark.parametrize("wanted", ["radius", "points", "lights", "sharpness"])
def test_gradients_are_the_finite_differences(kind, wanted):
    starts, lights = grey_rays(200, kind)
    weights = torch.rand(len(starts), dtype=torch.float64, generator=torch.Generator().manual_seed(0)) + 0.5
    along = torch.nn.functional.normalize(lights[:, :3] - lights[:, 3:] * starts, dim=-1)
    offsets = starts - CENTRE - ((starts - CENTRE) * along).sum(-1, keepdim=True) * along  # away from the ball
    zero = torch.zeros(len(starts), 1, dtype=torch.float64)

    def total(step: Tensor) -> Tensor:
        grid = ball(RADIUS + (step if wanted == "radius" else 0.0))
        points = starts + (step * offsets if wanted == "points" else 0.0)
        ends = lights + (step * torch.cat([offsets, zero], 1) if wanted == "lights" else 0.0)
        sharpness = SHARPNESS + (step if wanted == "sharpness" else torch.zeros_like(step))
        return (weights * transmittance(grid, points, ends, sharpness)).sum()

    step = torch.zeros((), dtype=torch.float64, requires_grad=True)
    total(step).backward()
    h = torch.tensor(2e-3, dtype=torch.float64)
    expected = ((total(h) - total(-h)) / (2 * h)).item()
    # A minimum between trilinear kinks is not quite stationary: about 1 % on average over rays.
    assert step.grad is not None and step.grad.item() == pytest.approx(expected, rel=0.03)
