"""Points picked on a ball on the ground, and lengths between them."""

import numpy as np
import pytest
from test_section import CENTRE, RADIUS, SPACING, UP, ball, grid_of

from reconstruct.sdf.measure import PickedPoint, length_between, pick, sigma_at
from reconstruct.sdf.section import Plane

OFF = 0.02 * SPACING  # trilinear interpolation of a ball of twenty voxels


@pytest.fixture(scope="module")
def grid():
    return grid_of(ball)


def test_the_poles_of_a_ball_are_two_radii_apart(grid):
    left, right = (
        pick(grid, 0.0, CENTRE + side * np.array([100.0, 0, 0]), -side * np.array([3.0, 0, 0])) for side in (1, -1)
    )
    assert left is not None and right is not None and left.on_object and right.on_object
    assert length_between(left.place, right.place, (None,)).value == pytest.approx(2 * RADIUS, abs=2 * OFF)


def test_a_ray_past_the_object_meets_the_ground_and_one_upwards_nothing(grid):
    eye = np.array([200.0, 0.0, 100.0])
    picked = pick(grid, 0.0, eye, np.array([-1.0, -1.0, -1.0]))
    assert picked is not None and not picked.on_object
    np.testing.assert_allclose(picked.place, [100, -100, 0], atol=1e-9)
    assert pick(grid, 0.0, eye, UP) is None and pick(grid, 0.0, eye, np.array([1.0, 0, 0])) is None


def test_the_nearer_of_object_and_ground_is_picked(grid):
    picked = pick(grid, 0.0, CENTRE + 100.0 * UP, -UP)
    assert picked is not None and picked.on_object
    np.testing.assert_allclose(picked.place, CENTRE + RADIUS * UP, atol=OFF)


def test_uncertainties_of_both_ends_add_as_independent_ones_do():
    a, b = np.zeros(3), np.array([3.0, 4.0, 0.0])
    length = length_between(a, b, (0.3, 0.4))
    assert (length.value, length.sigma) == (pytest.approx(5.0), pytest.approx(0.5))
    assert length_between(a, b, (0.3, None)).sigma is None


def test_what_moves_both_ends_alike_does_not_change_their_length():
    a, b = np.zeros(3), np.array([3.0, 4.0, 0.0])
    assert length_between(a, b, (0.5, 0.5), (0.4, 0.4)).sigma == pytest.approx(np.hypot(0.3, 0.3))
    assert length_between(a, b, (0.5, 0.3), (0.4, 0.0)).sigma == pytest.approx(np.hypot(0.5, 0.3))
    assert length_between(a, b, (0.5, 0.5), (0.5, 0.5)).sigma == 0


def test_the_sigma_of_a_length_is_how_far_noisy_ends_scatter():
    rng = np.random.default_rng(0)
    a, b, spread = np.zeros(3), np.array([30.0, 40.0, 0.0]), (0.3, 0.4)
    noisy = [length_between(a + rng.normal(0, 0.3, 3), b + rng.normal(0, 0.4, 3), spread).value for _ in range(2000)]
    assert np.std(noisy) == pytest.approx(length_between(a, b, spread).sigma, rel=0.1)


def test_a_picked_point_is_as_uncertain_as_the_nearest_vertex_and_the_ground_is_exact():
    vertices, sigma = np.array([[0.0, 0, 0], [10.0, 0, 0]]), np.array([0.1, 0.7])
    assert sigma_at(PickedPoint(np.array([8.0, 1, 0]), True), vertices, sigma) == pytest.approx(0.7)
    assert sigma_at(PickedPoint(np.array([8.0, 1, 0]), False), vertices, sigma) == 0.0
    assert sigma_at(PickedPoint(np.array([8.0, 1, 0]), True), vertices, None) is None


def test_what_a_plane_hides_is_not_picked_but_the_face_of_the_cut_is(grid):
    plane = Plane(UP, float(CENTRE[2]) + 5.0)
    above, sideways = CENTRE + np.array([4.0, 3.0, 100.0]), np.array([1.0, 0, 0])
    face = pick(grid, 0.0, above, -UP, plane.span(above, -UP))
    assert face is not None and face.on_object
    np.testing.assert_allclose(face.place, CENTRE + np.array([4.0, 3.0, 5.0]), atol=1e-9)
    beside = CENTRE + np.array([-100.0, 0, 10.0])
    assert pick(grid, 0.0, beside, sideways) is not None
    assert pick(grid, 0.0, beside, sideways, plane.span(beside, sideways)) is None
    lower = CENTRE + np.array([-100.0, 0, -10.0])
    assert pick(grid, 0.0, lower, sideways, plane.span(lower, sideways)) is not None
    upwards = np.array([1.0, 0.0, 0.6]) / np.sqrt(1.36)  # it meets the ball only above the plane
    below_it = CENTRE + np.array([-30.0, 0.0, 0.0])
    assert pick(grid, 0.0, below_it, upwards) is not None
    assert pick(grid, 0.0, below_it, upwards, plane.span(below_it, upwards)) is None
