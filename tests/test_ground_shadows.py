"""Object and ground in pictures of the ground's residuals: level tops, looks and walls; and when shading is doubted."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from calibration.flashlight.light_estimate import LightFit, surely_placed
from calibration.ground.ground_field import GroundField, at_photo_size, fit_ground_field
from calibration.ground.ground_shadows import GROUND_LIKE, bare_ground, find_shadows, of_one_ground
from calibration.ground.outline_model import witness_odds
from calibration.ground.table_edges import find_table_edges, on_table
from calibration.light import Light

PHOTOS, HEIGHT, WIDTH = 6, 120, 160
ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH]
FIGURE = (np.abs(COLUMNS - 80) < 14) & (ROWS > 40) & (ROWS < 88)


def _field(strange: np.ndarray) -> GroundField:
    """Ground with 1 % of noise, whose strange pixels are as bright as they like."""
    rng = np.random.default_rng(0)
    residual = 0.01 * rng.standard_normal((PHOTOS, HEIGHT, WIDTH))
    residual[:, strange] = rng.uniform(-0.9, 0.9, (PHOTOS, 1))
    everywhere = np.ones(residual.shape, bool)
    flat = np.zeros((HEIGHT, WIDTH), np.float32)
    return GroundField(flat, np.zeros_like(residual), residual, everywhere, 1.0 - strange)


def test_another_thing_beside_the_object_is_no_plinth():
    beside = (ROWS > 34) & (ROWS < 39) & (COLUMNS > 50) & (COLUMNS < 110)
    found = find_shadows(_field(FIGURE | beside)).object_mask
    assert (found & beside).sum() == 0 and (found ^ FIGURE).sum() < 0.1 * FIGURE.sum()


def test_print_larger_than_the_object_is_not_the_object_whose_shadows_fall_beside_it():
    block = (ROWS > 30) & (ROWS < 100) & (COLUMNS > 8) & (COLUMNS < 48)
    field = _field(FIGURE | block)
    for photo in range(PHOTOS):  # to one side or the other
        shift = 20 if photo % 2 else -18
        field.residual[photo, (np.abs(COLUMNS - 80 - shift) < 12) & (ROWS > 74) & (ROWS < 94) & ~FIGURE & ~block] = -1.8
    found = find_shadows(field).object_mask
    assert block.sum() > FIGURE.sum() and not found[block].any() and found[FIGURE].mean() > 0.95


def test_what_lies_beyond_a_walls_foot_is_no_ground():
    """The foot is a line from border to border, with gaps and the object before it."""
    foot = (np.abs(ROWS - 45 - COLUMNS // 20) < 2) & (COLUMNS % 40 > 1)
    shadows = find_shadows(_field(FIGURE | foot))
    one = of_one_ground(shadows)
    assert (shadows.likelihood[:40] < GROUND_LIKE).mean() > 0.9
    assert (one.likelihood[:40] > GROUND_LIKE).all()
    below = (ROWS > 90) & ~FIGURE
    np.testing.assert_array_equal(one.likelihood[below], shadows.likelihood[below])


def test_lights_whose_stated_error_is_large_are_notsurely_placed():
    """They are used, and yet outlines are asked: powers that differ contradict the shading."""
    places = np.array([[0.0, 0.0, 500.0]] * 4)
    sigmas = (2.0, 10.0, 60.0, 100.0)
    lights = tuple(
        Light(f"{k}", "point", position=place, power=np.ones(3), sigma=np.full(3, sigma))
        for k, (place, sigma) in enumerate(zip(places, sigmas, strict=True))
    )
    assert surely_placed(LightFit(lights, (), np.zeros(3)), np.zeros(3)) == 0.5


def test_print_that_is_too_dark_to_show_shadows_stays_ground():
    """A black square in the shadow of three photos: no part of the object borders it."""
    figure = (np.abs(COLUMNS - 50) < 10) & (ROWS > 40) & (ROWS < 80)
    square = (np.abs(COLUMNS - 90) < 6) & (np.abs(ROWS - 60) < 6)
    field = _field(figure)
    for residual in field.residual[:3]:
        residual[(np.abs(ROWS - 60) < 15) & (COLUMNS > 58) & (COLUMNS < 110) & ~square & ~figure] = -2.0
    found = find_shadows(field).object_mask
    assert found[figure].mean() > 0.9 and not found[square].any()


def _two_boxes(step: float) -> tuple[np.ndarray, ...]:
    """Two boxes, the upper one above the larger lower one: the sides of both, what lies between, and what is found.

    step: log units by which what lies between is brighter or darker than the ground, in turns.
    """
    lower = (np.abs(COLUMNS - 80) < 30) & (np.abs(ROWS - 90) < 10)
    upper = (np.abs(COLUMNS - 80) < 14) & (np.abs(ROWS - 50) < 14)
    top = (np.abs(COLUMNS - 80) < 30) & (ROWS > 46) & (ROWS < 81) & ~upper
    field = _field(lower | upper)
    field.residual[:, top] += step * np.array([-1, 1, -1, 1, -1, 1])[:, None]
    return lower, upper, top, find_shadows(field).object_mask


def test_what_stands_on_a_level_top_belongs_to_the_object_and_the_top_too():
    """The top parts the sides of two boxes, and no edge of it shows; it is nearer to the lights than the ground."""
    lower, upper, top, found = _two_boxes(0.06)
    assert found[lower].mean() > 0.95 and found[upper].mean() > 0.95 and found[top].mean() > 0.9
    assert (found & ~lower & ~upper & ~top).sum() < 0.1 * top.sum()


@pytest.mark.parametrize("off", [1, 5])  # times the noise
@pytest.mark.parametrize("look", [(-0.7, 0.0, 0.0), (0.0, 0.5, -0.3), (0.4, -0.3, 0.2)])
def test_a_part_that_is_lit_as_the_ground_is_or_nearly_is_told_by_its_look(look, off):
    """A mug of one look throughout: darker, of another hue, or brighter; its top gets the light that ground gets."""
    top, rng = (np.abs(COLUMNS - 80) < 14) & (ROWS > 22) & (ROWS < 41), np.random.default_rng(1)
    field, whole = _field(FIGURE), FIGURE | top
    field.residual[:, top] *= off
    colour = 0.01 * rng.standard_normal((*field.residual.shape, 2))
    colour[:, whole] += look[1:]
    albedo = np.where(whole, look[0], field.albedo).astype(np.float32)
    alike, other = (
        find_shadows(one).object_mask
        for one in (field, replace(field, albedo=albedo, colour=colour.astype(np.float16)))
    )
    assert alike[top].mean() < 0.1
    assert other[whole].mean() > 0.95 and (other & ~whole).sum() < 0.05 * whole.sum()


@pytest.mark.parametrize("width", [4, 8, 12])
def test_ground_between_feet_is_ground_though_it_is_mostly_in_shadow(width):
    """There the albedo that fits the photos is that of shadow; the ground around tells the true one."""
    gap = (np.abs(COLUMNS - 80) < width / 2) & (ROWS > 70) & (ROWS < 88)
    field = _field(FIGURE & ~gap)
    albedo, residual = field.albedo.copy(), field.residual.copy()
    albedo[gap] = -1.8
    residual[:3, gap] = 1.8  # lit in half of the photos
    bare = bare_ground(replace(field, albedo=albedo, residual=residual))
    assert not bare.shadows.object_mask[gap].any() and bare.shadows.object_mask[FIGURE & ~gap].mean() > 0.95
    inside = cv2.erode(gap.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    assert (bare.shadows.visibility[3:, inside] < 0.3).mean() > 0.9 and bare.shadows.visibility[:3, inside].min() > 0.7


@pytest.mark.parametrize(("hits", "alarms"), [(0.9, 0.05), (1.0, 0.9), (0.5, 0.5), (0.0, 0.0)])
def test_a_witness_counts_as_much_as_it_agrees_with_the_region(hits, alarms):
    """One that calls all an object, or tosses a coin, makes nothing one; silent pixels say nothing."""
    rng = np.random.default_rng(0)
    said = np.where(rng.random(FIGURE.shape) < np.where(FIGURE, hits, alarms), 1, -1)
    said[:10] = 0
    odds = witness_odds(said, FIGURE)
    assert np.isfinite(odds).all() and not odds[:10].any()
    tells = odds[10:].max()
    assert (tells > 2.0) == (hits > 2 * alarms) and (tells < 0.5) == (hits < 2 * alarms or hits == alarms)


# --- where the ground ends -------------------------------------------------------------------------------------------


EYE = np.array([0.0, -500.0, 400.0])
ROWS_SEEN, COLUMNS_SEEN, LIT = 96, 128, 12
BALL, RADIUS = np.array([0.0, 0.0, 30.0]), 30.0


def table_points() -> np.ndarray:
    """The ground in each pixel of a camera that looks from EYE at the origin."""
    forward = -EYE / np.linalg.norm(EYE)
    right = np.array([1.0, 0.0, 0.0])
    down = np.cross(forward, right)
    v, u = np.mgrid[:ROWS_SEEN, :COLUMNS_SEEN]
    rays = forward + ((u - COLUMNS_SEEN / 2)[..., None] * right + (v - ROWS_SEEN / 2)[..., None] * down) / (
        1.1 * COLUMNS_SEEN
    )
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
    for turn in np.linspace(0, 2 * np.pi, LIT, endpoint=False):
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
    rgb[:, :, : COLUMNS_SEEN // 3] *= 0.4  # a cloth: an edge of albedo, the same in all photos
    assert not find_table_edges(rgb, everywhere(rgb), points, EYE)


@pytest.mark.parametrize("count", [5, LIT])
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
