"""Object and ground in pictures of the ground's residuals: level tops, looks and walls; and when shading is doubted."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from calibration.flashlight.light_estimate import LightFit, surely_placed
from calibration.ground.ground_field import GroundField
from calibration.ground.ground_shadows import GROUND_LIKE, bare_ground, find_shadows, of_one_ground
from calibration.ground.outline_model import witness_odds
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
