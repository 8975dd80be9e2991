"""Where the ground ends: lines along which the light of the photos jumps, in pictures made of one plane or two."""

import numpy as np
import pytest

from calibration.ground.ground_field import at_photo_size, fit_ground_field
from calibration.ground.ground_shadows import GROUND_LIKE, find_shadows
from calibration.ground.table_edges import find_table_edges, on_table

EYE = np.array([0.0, -500.0, 400.0])
HEIGHT, WIDTH, PHOTOS = 96, 128, 12
BALL, RADIUS = np.array([0.0, 0.0, 30.0]), 30.0


def table_points() -> np.ndarray:
    """The ground in each pixel of a camera that looks from EYE at the origin."""
    forward = -EYE / np.linalg.norm(EYE)
    right = np.array([1.0, 0.0, 0.0])
    down = np.cross(forward, right)
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    rays = forward + ((u - WIDTH / 2)[..., None] * right + (v - HEIGHT / 2)[..., None] * down) / (1.1 * WIDTH)
    away = np.where(rays[..., 2] < -0.01, -EYE[2] / np.minimum(rays[..., 2], -0.01), np.nan)
    return EYE + away[..., None] * rays


def photos(points: np.ndarray, inside: np.ndarray, drop: float, rng: np.random.Generator) -> np.ndarray:
    """A table whose points outside lie `drop` lower along their rays, a ball with its shadow, and noise."""
    lower = EYE + (points - EYE) * ((EYE[2] + drop) / EYE[2])
    seen = np.where(inside[..., None], points, lower)
    albedo = np.where(inside, 0.5, 0.3) * np.exp(0.1 * rng.standard_normal(inside.shape))
    rays = points - EYE
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    ball = hits(np.broadcast_to(EYE, points.shape), rays)
    pictures = []
    for turn in np.linspace(0, 2 * np.pi, PHOTOS, endpoint=False):
        light = np.array([350 * np.cos(turn), 250 * np.sin(turn), 350 + 100 * np.cos(3 * turn)])
        way = light - seen
        away = np.linalg.norm(way, axis=-1, keepdims=True)
        shade = 3e4 * way[..., 2] / away[..., 0] ** 3 * np.where(inside & hits(seen, way / away), 0.05, 1.0)
        grey = np.where(ball, 0.15 + 0.1 * np.sin(turn + points[..., 0] / 15), albedo * shade * 8)
        pictures.append(grey * np.exp(0.01 * rng.standard_normal(grey.shape)))
    return np.repeat(np.nan_to_num(np.stack(pictures), nan=1e-4)[..., None], 3, -1).astype(np.float32)


def hits(start: np.ndarray, along: np.ndarray) -> np.ndarray:
    to_ball = BALL - start
    reach = (to_ball * along).sum(-1)
    return (reach > 0) & ((to_ball**2).sum(-1) - reach**2 < RADIUS**2)


def outside(points: np.ndarray, angle: float, offset: float) -> np.ndarray:
    normal = -np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    return ~(points[..., :2] @ normal > -offset)


def everywhere(rgb: np.ndarray) -> np.ndarray:
    return np.ones(rgb.shape[:3], bool)


@pytest.mark.parametrize("angle", [90.0, 65.0, 120.0])
def test_the_line_along_which_the_light_jumps_is_the_tables_edge(angle):
    points, rng = table_points(), np.random.default_rng(0)
    beyond = outside(points, angle, 110.0)
    rgb = photos(points, ~beyond, 700.0, rng)
    (edge,) = find_table_edges(rgb, everywhere(rgb), points, EYE)
    normal = -np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    assert edge.normal @ normal > np.cos(np.radians(3)) and abs(edge.offset + 110) < 10
    assert (edge.on_table(points) == ~beyond).mean() > 0.98 and edge.on_table(np.zeros((1, 3))).all()


def test_shadows_stains_and_a_ball_on_a_table_without_end_are_no_edge():
    points, rng = table_points(), np.random.default_rng(2)
    rgb = photos(points, np.isfinite(points[..., 0]), 0.0, rng)
    rgb[:, :, : WIDTH // 3] *= 0.4  # a cloth: an edge of albedo, the same in all photos
    assert not find_table_edges(rgb, everywhere(rgb), points, EYE)


@pytest.mark.parametrize("count", [5, PHOTOS])
def test_the_straight_edges_of_a_high_object_are_no_edge_of_the_ground(count):
    points, rng = table_points(), np.random.default_rng(7)
    rgb = photos(points, np.isfinite(points[..., 0]), 0.0, rng)[:count]
    for left in (40, 56):  # the sides of a box, each lit in its own way, over three quarters of the picture
        rgb[:, 12:84, left : left + 16] = rng.uniform(0.05, 0.5, (count, 1, 1, 1))
    assert not find_table_edges(rgb, everywhere(rgb), points, EYE)


def test_no_ground_and_no_shadow_is_seen_beyond_the_edge_and_the_object_before_it_is_whole():
    points, rng = table_points(), np.random.default_rng(4)
    beyond = outside(points, 90.0, 60.0)
    rgb = photos(points, ~beyond, 700.0, rng)
    found = ~on_table(find_table_edges(rgb, everywhere(rgb), points, EYE), points)
    assert (found == beyond).mean() > 0.98
    field = at_photo_size(fit_ground_field(rgb, everywhere(rgb), found), rgb, everywhere(rgb))
    shadows = find_shadows(field)
    rays = points - EYE
    ball = hits(np.broadcast_to(EYE, points.shape), rays / np.linalg.norm(rays, axis=-1, keepdims=True))
    assert (ball & beyond).sum() > 30, "the ball is seen before the floor"
    assert (shadows.object_mask & ball).sum() / (shadows.object_mask | ball).sum() > 0.85
    assert not (shadows.likelihood < GROUND_LIKE)[beyond & (np.roll(beyond, -3, 0))].any()
