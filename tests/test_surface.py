"""The level set stays a distance function, moves no further than it may, and bends no more than it must."""

import numpy as np
import pytest
import torch

from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.level_set import BAND, LevelSet, resampled
from reconstruct.torch_sdf.march import central_differences

NODES = 48
MIDDLE = np.full(3, (NODES - 1) / 2)


def ball(radius: float) -> np.ndarray:
    nodes = np.stack(np.meshgrid(*[np.arange(NODES)] * 3, indexing="ij"), -1)
    return (np.linalg.norm(nodes - MIDDLE, axis=-1) - radius).astype(np.float32)


def level_set(phi: np.ndarray) -> LevelSet:
    return LevelSet(np.ascontiguousarray(phi), np.zeros(3), 1.0)


def test_redistancing_restores_a_distance_function_from_a_distorted_one():
    true = ball(15)
    found = level_set(true * (1 + 0.5 * np.sin(true)) * 1.7).phi
    near = np.abs(true) < 4
    # First-order fast sweeping on unit cells: a few hundredths of a voxel beside the surface, more further out.
    assert np.abs(found - true)[near].mean() < 0.1
    assert np.abs(found - true)[near].max() < 0.5


def test_shrinking_pulls_matter_in_where_nothing_speaks_for_it():
    surface = level_set(ball(15))
    inside = (surface.phi < 0).sum()
    for _ in range(20):
        surface.step(passes=1, rate=0.5, shrink=5e-4, curvature=0.0, stiffness=0, smoothing=0.0)
    assert (surface.phi < 0).sum() < inside


def test_the_surface_is_stiff_against_a_spike_but_not_against_a_ball():
    spike = ball(15)
    nodes = np.stack(np.meshgrid(*[np.arange(NODES)] * 3, indexing="ij"), -1)
    spike = np.minimum(spike, np.linalg.norm(nodes - MIDDLE - [16.0, 0, 0], axis=-1) - 2.0).astype(np.float32)
    surface = level_set(spike)
    for _ in range(60):
        surface.step(passes=1, rate=0.5, shrink=0.0, curvature=0.0, stiffness=4, smoothing=0.0)
    tip = tuple(np.rint(MIDDLE + np.array([17.0, 0, 0])).astype(int))
    assert spike[tip] < 0 < surface.phi[tip]
    side = np.abs(nodes[..., 0] - MIDDLE[0]) < 4  # far from the spike the ball must not have moved
    assert np.abs(surface.phi - ball(15))[side & (np.abs(ball(15)) < 1)].max() < 0.3


def test_the_box_never_shrinks_however_often_its_grid_is_resampled():
    # A flat box in millimetres far from the origin, whose sides are whole voxels only but for float32's rounding.
    origin, spacing = torch.tensor([55.1283, 44.6948, -8.8368]), 2.945173
    nodes = torch.stack(torch.meshgrid(*(torch.arange(float(n)) for n in (37, 48, 44)), indexing="ij"), -1)
    first = SdfGrid(spacing * ((nodes - 20).norm(dim=-1) - 10), origin, spacing)
    grid = first
    for nodes in (48, 48, 48, 48, 48, 96, 160, 240):
        grid = resampled(grid, nodes).grid()
        assert (grid.upper() > first.upper() - 0.01 * grid.spacing).all()
    assert (grid.upper() < first.upper() + spacing).all()


@pytest.mark.parametrize("step", [0.5, 1.0])
def test_the_gradient_is_that_of_the_sdf_inside_and_beside_the_box(step):
    grid = SdfGrid(torch.from_numpy(ball(15)) * 2, torch.tensor([-30.0, 5.0, 0.0]), 2.0)
    points = torch.rand(2000, 3, generator=torch.Generator().manual_seed(0)) * 140 - torch.tensor([60.0, 25.0, 30.0])
    expected = central_differences(grid.sdf, points, 2.0 * step)
    # For the kernel the box ends a thousandth of a voxel before its last node.
    torch.testing.assert_close(grid.gradient(points, step), expected, atol=2e-3, rtol=0)


# --- a grid kept on the blocks near its surface ----------------------------------------------------------------------


def test_a_grid_without_any_surface_has_no_blocks_and_can_still_be_moved():
    surface = LevelSet(np.full((20, 30, 25), 4.0, np.float32), np.zeros(3), 1.0)
    assert len(surface.field.pool) == 0
    assert (surface.phi == BAND).all()
    surface.step(1, 0.5, 0.0, 0.0, 1, 0.1)
    surface.redistance()
    assert (surface.grid().values > 0).all()
