"""Differentiable visibility against finite differences, dense sampling by autograd, and the solver's kernels."""

from unittest.mock import Mock

import numpy as np
import pytest
import torch
from torch import Tensor

from reconstruct.config import FitConfig
from reconstruct.labels.supervision import Supervision
from reconstruct.scene import Scene
from reconstruct.sdf import kernels
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.level_set import LevelSet
from reconstruct.sdf.rays import visibility
from reconstruct.solve.ray_operators import DrawnRays, RayOperators
from reconstruct.torch_sdf import equations as render
from reconstruct.torch_sdf.autograd import ShadowRenderer, first_intersections, transmittance

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


def camera(count: int = 1500) -> tuple[Tensor, Tensor, Tensor]:
    """An eye, rays about the ball, and the distance to a ground below it."""
    eye = CENTRE + torch.tensor([0.0, -9.0, 9.0], dtype=torch.float64)
    aim = CENTRE + 7 * (torch.rand(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2)) - 0.5)
    directions = torch.nn.functional.normalize(aim - eye, dim=-1)
    t = (CENTRE[2] - RADIUS - eye[2]) / directions[:, 2]
    return eye, directions, torch.where(t > 0, t, torch.inf)


def test_a_boundary_pixel_is_covered_by_as_much_of_the_ball_as_it_should_be():
    eye, directions, ground_t = camera(6000)
    angle = 0.05
    found = first_intersections(ball(), eye.expand_as(directions), directions, ground_t, angle)
    edge = found.is_edge & ~found.is_hit
    assert edge.sum() > 100
    along = ((CENTRE - eye) * directions).sum(-1)
    beside = (CENTRE - eye - along[:, None] * directions).norm(dim=-1) - RADIUS
    expected = (0.5 - beside / (angle * along)).clamp(0, 1)
    torch.testing.assert_close(found.edge_ratio[edge], expected[edge], atol=0.02, rtol=0)
    assert not found.edge_ratio[~found.is_edge].any()


def test_the_renderer_is_the_solvers_shadow_pass_in_value_and_gradient():
    eye, directions, ground_t = camera()
    n, angle, s = len(directions), 0.02, SHARPNESS
    light = torch.cat([CENTRE + torch.tensor([7.0, 3.0, 8.0], dtype=torch.float64), torch.ones(1, dtype=torch.float64)])
    grid = ball(real=torch.float32)
    values = grid.values.double().requires_grad_()
    seen = ShadowRenderer(angle, s)(SdfGrid(values, ORIGIN, SPACING), eye, directions, ground_t, light.expand(n, 4))
    # Rays whose loss is well conditioned, and whose start the kernels neither bound nor leave out.
    facing = -(seen.normals * directions).sum(-1)
    kept = seen.is_seen & (seen.visibility > 0.1) & (seen.visibility < 0.9) & (~seen.is_hit | (facing > 0.3))
    assert kept.sum() > 30
    # A rather lit label: of a dark one the solver asks nothing where the surface faces away from the light.
    label = torch.full((n,), 0.6, dtype=torch.float64)
    loss = render.shadow_loss(seen.visibility, label)[kept].sum() / (s * SPACING)
    (of_values,) = torch.autograd.grad(loss, values)

    nothing, none = np.zeros(n, np.float32), np.zeros((n, 3), np.float32)
    rays = Supervision(
        np.arange(n), directions.numpy(), ground_t.numpy(), np.full((1, n), 0.6, np.float32), nothing[None] + 1,
        np.full(n, kernels.EDGE, np.uint8), nothing, nothing, none, nothing, np.zeros((1, n), np.uint8),
    )  # fmt: skip
    surface = LevelSet(grid.in_voxels(), ORIGIN.numpy(), SPACING, is_distance=True)
    scene = Mock(spec=Scene, eye=eye, lights=light[None], pixel_angle=angle)
    operators = RayOperators(surface, scene, rays, FitConfig())
    operators.find_surface()
    drawn = DrawnRays(np.stack([np.zeros(n, np.int64), np.arange(n)], 1), kept.double().numpy(), np.zeros(n))
    operators.shadow(drawn, 0, s * SPACING)
    misses = drawn.misses
    found = seen.visibility.detach()[kept]
    # The kernels take a random share of the first step, so minima are refined from other samples.
    np.testing.assert_allclose((found - 0.6).abs().numpy(), misses[kept.numpy()], atol=0.02)
    mine = of_values.numpy() * SPACING
    theirs = surface.sums()[0]
    cosine = (mine * theirs).sum() / np.linalg.norm(mine) / np.linalg.norm(theirs)
    assert cosine > 0.97, cosine
