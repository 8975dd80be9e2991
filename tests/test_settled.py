"""Rays that are left out because they agree with their label, and for how long they do."""

import numpy as np
import pytest

from reconstruct.sdf import kernels
from reconstruct.sdf.blocks import Blocks, overlapping, pack
from reconstruct.sdf.settled import Tiles, Views, unsettled_rays, wide_field
from reconstruct.sdf.settled_kernels import WIDE

NODES, CENTRE, RADIUS = 48, np.array([24.0, 24.0, 16.0]), 11.0
EYE, WIDTH, HEIGHT, SHARPNESS = np.array([24.0, -110.0, 110.0]), 120, 90, 8.0
LIGHTS = np.array([[x, y, 90.0, 1.0] for x in (-40.0, 90.0) for y in (-40.0, 90.0)] + [[0.3, 0.2, 0.93, 0.0]])


def ball(radius: float) -> Blocks:
    """The SDF of a ball above the ground z = 0, voxels, cut off as a level set is."""
    axis = np.arange(NODES)
    nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    values = np.clip(np.linalg.norm(nodes - CENTRE, axis=-1) - radius, -6, 6)
    return overlapping(pack(values.astype(np.float32)))


def views() -> Views:
    row, column = np.divmod(np.arange(WIDTH * HEIGHT), WIDTH)
    ground = np.stack([0.8 * column - 24, 0.9 * (HEIGHT - row) - 20, 0.0 * row], 1)
    length = np.linalg.norm(ground - EYE, axis=1)
    directions = (ground - EYE) / length[:, None]
    seen = _distance(np.broadcast_to(EYE, ground.shape), directions) < RADIUS
    return Views(EYE, directions, length, 0.0, np.where(seen, kernels.OBJECT, kernels.GROUND).astype(np.uint8))


def _distance(points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """How closely rays pass the ball's centre."""
    offset = CENTRE - points
    along = np.maximum((offset * directions).sum(-1), 0)
    return np.linalg.norm(offset - along[:, None] * directions, axis=-1)


def starts(seen: Views) -> np.ndarray:
    """Where the pixels' rays meet the ball of RADIUS or the ground, in closed form."""
    along = ((CENTRE - EYE) * seen.directions).sum(1)
    inside = RADIUS**2 - (np.linalg.norm(CENTRE - EYE) ** 2 - along**2)
    t = np.where(seen.role == kernels.OBJECT, along - np.sqrt(np.maximum(inside, 0)), seen.ground_t)
    return EYE + t[:, None] * seen.directions


def towards(points: np.ndarray, light: np.ndarray) -> np.ndarray:
    direction = light[:3] - light[3] * points
    return direction / np.linalg.norm(direction, axis=1, keepdims=True)


def labels(seen: Views) -> np.ndarray:
    """Visibility by the ball's equation, (lights, pixels)."""
    points, rows = starts(seen), []
    for light in LIGHTS:
        along = towards(points, light)
        on_ball = ((points - CENTRE) * along).sum(1) > 0
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
    found = unsettled_rays(ball(RADIUS), tiles, seen, LIGHTS, label, np.ones_like(label), need)
    out = np.zeros(label.shape, np.bool_)
    out[tuple(found.T)] = True
    return out


@pytest.mark.parametrize("moved", [0.0, 0.9, -0.9])
def test_no_ray_is_left_out_that_differs_from_its_label_while_the_surface_moves_by_less_than_promised(moved):
    seen = views()
    label = labels(seen)
    chosen = chosen_rays(abs(moved), label, seen)
    off = misses(ball(RADIUS + moved), seen, label) > 0.003
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
    nodes = np.stack(np.meshgrid(*[np.arange(0, NODES, WIDE)] * 3, indexing="ij"), -1)
    n = len(nodes)
    found, true = wide_field(ball(radius))[:n, :n, :n], np.linalg.norm(nodes - CENTRE, axis=-1) - radius
    assert (np.abs(found) <= np.abs(true) + 1e-4).all()
    assert ((found < 0) == (true < 0)).all()
    assert np.abs(found)[true > 14].min() > 9
