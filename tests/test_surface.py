"""The level set stays a distance function, moves no further than it may, and bends no more than it must."""

import numpy as np
import pytest
import torch

from reconstruct.sdf import kernels
from reconstruct.sdf.blocks import Blocks, overlapping, pack
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.level_set import BAND, LevelSet, resampled
from reconstruct.sdf.rays import first_surfaces
from reconstruct.sdf.settled import Tiles, Views, unsettled_rays, wide_field
from reconstruct.sdf.settled_kernels import WIDE

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
def test_the_gradient_by_the_kernel_is_that_of_the_differentiable_sdf_inside_and_beside_the_box(step):
    grid = SdfGrid(torch.from_numpy(ball(15)) * 2, torch.tensor([-30.0, 5.0, 0.0]), 2.0)
    points = torch.rand(2000, 3, generator=torch.Generator().manual_seed(0)) * 140 - torch.tensor([60.0, 25.0, 30.0])
    expected = grid.gradient(points.clone().requires_grad_(), step).detach()
    # For the kernel the box ends a thousandth of a voxel before its last node.
    torch.testing.assert_close(grid.gradient(points, step), expected, atol=2e-3, rtol=0)


# --- a grid kept on the blocks near its surface ----------------------------------------------------------------------


SHAPE = (101, 67, 86)  # no side is a whole number of blocks
CENTRE = np.array([50.0, 33.0, 40.0])


def nodes() -> np.ndarray:
    return np.stack(np.meshgrid(*[np.arange(n) for n in SHAPE], indexing="ij"), -1)


def two_balls() -> np.ndarray:
    """A ball, and another one that the box cuts."""
    away = np.minimum(
        np.linalg.norm(nodes() - CENTRE, axis=-1) - 17.3, np.linalg.norm(nodes() - [88, 60, 70], axis=-1) - 12
    )
    return away.astype(np.float32)


def test_a_grid_without_any_surface_has_no_blocks_and_can_still_be_moved():
    surface = LevelSet(np.full((20, 30, 25), 4.0, np.float32), np.zeros(3), 1.0)
    assert len(surface.field.pool) == 0
    assert (surface.phi == BAND).all()
    surface.step(1, 0.5, 0.0, 0.0, 1, 0.1)
    surface.redistance()
    assert (surface.grid().values > 0).all()


def whole(phi: np.ndarray) -> Blocks:
    """Every block stored, so that rays leap over none."""
    return pack(phi, np.inf)


@pytest.mark.parametrize("sharpness", [4.0, 25.0])
def test_rays_that_leap_find_what_rays_through_every_node_find(sharpness):
    field = LevelSet(two_balls(), np.zeros(3), 1.0).field
    assert (field.layout < 0).mean() > 0.3
    rng, n = np.random.default_rng(1), 4000
    ends = rng.uniform(0, SHAPE, (2, n, 3))
    starts = CENTRE + 200 * (ends[0] - CENTRE) / np.linalg.norm(ends[0] - CENTRE, axis=1, keepdims=True)
    along = (ends[1] - starts) / np.linalg.norm(ends[1] - starts, axis=1, keepdims=True)
    lights = np.concatenate([ends[1], np.ones((n, 1))], 1)
    found, expected = np.empty((2, n)), np.empty((2, n))
    for out, blocks in ((found, field), (expected, whole(field.dense()))):
        phi = overlapping(blocks)
        out[0], _, _ = first_surfaces(phi, starts, along, np.full(n, 1e8))
        kernels.transmittances(phi, starts, lights, sharpness, out[1], 0, n)
    assert 0.2 < (expected[0] < kernels.FAR).mean() < 0.9 and 0.2 < expected[1].mean() < 0.9
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


# --- rays that are left out because they agree with their label ------------------------------------------------------


AT, RADIUS = np.array([24.0, 24.0, 16.0]), 11.0
EYE, WIDTH, HEIGHT, SHARPNESS = np.array([24.0, -110.0, 110.0]), 120, 90, 8.0
LIGHTS = np.array([[x, y, 90.0, 1.0] for x in (-40.0, 90.0) for y in (-40.0, 90.0)] + [[0.3, 0.2, 0.93, 0.0]])


def blocks_of(radius: float) -> Blocks:
    """The SDF of a blocks_of above the ground z = 0, voxels, cut off as a level set is."""
    axis = np.arange(NODES)
    nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    values = np.clip(np.linalg.norm(nodes - AT, axis=-1) - radius, -6, 6)
    return overlapping(pack(values.astype(np.float32)))


def views() -> Views:
    row, column = np.divmod(np.arange(WIDTH * HEIGHT), WIDTH)
    ground = np.stack([0.8 * column - 24, 0.9 * (HEIGHT - row) - 20, 0.0 * row], 1)
    length = np.linalg.norm(ground - EYE, axis=1)
    directions = (ground - EYE) / length[:, None]
    seen = _distance(np.broadcast_to(EYE, ground.shape), directions) < RADIUS
    return Views(EYE, directions, length, 0.0, np.where(seen, kernels.OBJECT, kernels.GROUND).astype(np.uint8))


def _distance(points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """How closely rays pass the blocks_of's centre."""
    offset = AT - points
    along = np.maximum((offset * directions).sum(-1), 0)
    return np.linalg.norm(offset - along[:, None] * directions, axis=-1)


def starts(seen: Views) -> np.ndarray:
    """Where the pixels' rays meet the blocks_of of RADIUS or the ground, in closed form."""
    along = ((AT - EYE) * seen.directions).sum(1)
    inside = RADIUS**2 - (np.linalg.norm(AT - EYE) ** 2 - along**2)
    t = np.where(seen.role == kernels.OBJECT, along - np.sqrt(np.maximum(inside, 0)), seen.ground_t)
    return EYE + t[:, None] * seen.directions


def towards(points: np.ndarray, light: np.ndarray) -> np.ndarray:
    direction = light[:3] - light[3] * points
    return direction / np.linalg.norm(direction, axis=1, keepdims=True)


def labels(seen: Views) -> np.ndarray:
    """Visibility by the blocks_of's equation, (lights, pixels)."""
    points, rows = starts(seen), []
    for light in LIGHTS:
        along = towards(points, light)
        on_ball = ((points - AT) * along).sum(1) > 0
        rows.append(np.where(seen.role == kernels.OBJECT, on_ball, _distance(points, along) >= RADIUS))
    return np.array(rows, np.float32)


def misses(field: Blocks, seen: Views, label: np.ndarray) -> np.ndarray:
    """|T - label| of all rays of ground pixels, by the kernels that march every ray; 0 for other pixels."""
    out = np.zeros_like(label)
    for k, light in enumerate(LIGHTS):
        found = np.empty(label.shape[1])
        kernels.transmittances(field, starts(seen), np.tile(light, (len(found), 1)), SHARPNESS, found, 0, len(found))
        out[k] = np.abs(found - label[k])
    out[:, seen.role == kernels.OBJECT] = 0
    return out


def chosen_rays(motion: float, label: np.ndarray, seen: Views, share: float = 1.0) -> np.ndarray:
    chosen = np.flatnonzero(np.random.default_rng(0).random(WIDTH * HEIGHT) < share)
    tiles, need = Tiles(np.arange(WIDTH * HEIGHT), WIDTH, chosen), 6.0 / SHARPNESS + motion
    found = unsettled_rays(blocks_of(RADIUS), tiles, seen, LIGHTS, label, np.ones_like(label), need)
    out = np.zeros(label.shape, np.bool_)
    out[tuple(found.T)] = True
    return out


@pytest.mark.parametrize("moved", [0.0, 0.9, -0.9])
def test_no_ray_is_left_out_that_differs_from_its_label_while_the_surface_moves_by_less_than_promised(moved):
    seen = views()
    label = labels(seen)
    chosen = chosen_rays(abs(moved), label, seen)
    off = misses(blocks_of(RADIUS + moved), seen, label) > 0.003
    assert off.sum() > 200
    assert not (off & ~chosen).any()
    assert chosen.mean() < 0.12 + 0.1 * abs(moved)  # the rest need no march of their own


def test_every_ray_that_contradicts_its_label_is_chosen():
    seen = views()
    label = labels(seen)
    spoilt = np.random.default_rng(1).random(label.shape) < 0.01
    label[spoilt] = 1 - label[spoilt]
    assert chosen_rays(0.0, label, seen)[spoilt].mean() > 0.97  # but dark labels where a surface faces away


@pytest.mark.parametrize("radius", [3.0, RADIUS, 20.0])
def test_beyond_the_band_the_wide_field_is_at_most_the_distance_and_grows_with_it(radius):
    nodes = np.stack(np.meshgrid(*[np.arange(0, WIDE)] * 3, indexing="ij"), -1)
    n = len(nodes)
    found, true = wide_field(blocks_of(radius))[:n, :n, :n], np.linalg.norm(nodes - AT, axis=-1) - radius
    assert (np.abs(found) <= np.abs(true) + 1e-4).all()
    assert ((found < 0) == (true < 0)).all()
    assert np.abs(found)[true > 14].min() > 9
