"""Cuts of balls and boxes, whose area and outline are known."""

import numpy as np
import pytest
import torch
import trimesh

from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.section import Plane, below, section

RADIUS, SPACING = 20.0, 1.0
CENTRE = np.array([3.0, -2.0, 25.0])
UP = np.array([0.0, 0.0, 1.0])


def grid_of(sdf, lower=(-25, -30, -2), nodes=(60, 60, 55)) -> SdfGrid:
    axes = [low + SPACING * np.arange(n) for low, n in zip(lower, nodes, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    return SdfGrid(torch.from_numpy(sdf(points)).float(), torch.tensor(lower).float(), SPACING)


def ball(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points - CENTRE, axis=-1) - RADIUS


@pytest.fixture(scope="module")
def ball_grid() -> SdfGrid:
    return grid_of(ball)


@pytest.mark.parametrize("normal", [UP, np.array([1.0, 0, 0]), np.array([0.6, 0.0, 0.8])])
@pytest.mark.parametrize("beside", [0.0, 7.3, -12.0])
def test_the_cut_of_a_ball_is_a_disc_of_the_right_area(ball_grid, normal, beside):
    cut = section(ball_grid, 0.0, Plane(normal, float(CENTRE @ normal + beside)))
    radius = np.sqrt(RADIUS**2 - beside**2)
    assert cut.area == pytest.approx(np.pi * radius**2, rel=0.01)
    assert len(cut.outlines) == 1
    from_middle = cut.outlines[0] - (CENTRE + beside * normal)
    np.testing.assert_allclose(np.linalg.norm(from_middle, axis=1), radius, atol=0.1 * SPACING)
    np.testing.assert_allclose(from_middle @ normal, 0, atol=1e-9)


def test_the_segments_of_an_outline_are_as_long_as_the_circle(ball_grid):
    segments = section(ball_grid, 0.0, Plane(UP, float(CENTRE[2]))).segments()
    length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1).sum()
    assert length == pytest.approx(2 * np.pi * RADIUS, rel=0.01)


def test_a_plane_beside_the_object_cuts_nothing(ball_grid):
    cut = section(ball_grid, 0.0, Plane(UP, 50.0))
    assert cut.area == 0 and cut.outlines == () and len(cut.segments()) == 0 and len(cut.cap[1]) == 0


def test_a_hole_is_taken_off_the_area_and_left_open_in_the_cap():
    hollow = grid_of(lambda p: np.maximum(ball(p), 8.0 - np.linalg.norm((p - CENTRE)[..., :2], axis=-1)))
    cut = section(hollow, 0.0, Plane(UP, float(CENTRE[2])))
    assert len(cut.outlines) == 2
    assert cut.area == pytest.approx(np.pi * (RADIUS**2 - 8.0**2), rel=0.01)
    places, faces = cut.cap
    assert trimesh.Trimesh(places, faces, process=False).area == pytest.approx(cut.area, rel=0.01)
    assert (np.linalg.norm(places[faces].mean(1)[:, :2] - CENTRE[:2], axis=1) > 7.5).all()


def test_below_the_ground_there_is_nothing_and_beyond_the_grid_there_is_air():
    tall = grid_of(lambda p: np.abs(p[..., 0] - 3.0) - 10.0)  # a wall without end
    upright = section(tall, 0.0, Plane(np.array([0.0, 1.0, 0.0]), 0.0))
    assert upright.area == pytest.approx(20.0 * 52.0, rel=0.01), "from the ground, z = 0, to the grid's top, z = 52"
    assert min(line[:, 2].min() for line in upright.outlines) >= -0.5 * SPACING


def test_what_is_above_a_cut_is_taken_away_and_colours_go_along():
    mesh = trimesh.creation.box((10, 10, 10))
    colours = np.where(mesh.vertices[:, 2:] > 0, 200.0, 100.0) * np.ones(3)
    vertices, faces, kept = below(mesh, colours, Plane(UP, 2.0))
    assert vertices[:, 2].max() == pytest.approx(2.0) and vertices[:, 2].min() == -5
    assert trimesh.Trimesh(vertices, faces, process=False).area == pytest.approx(100 + 4 * 70)
    np.testing.assert_allclose(kept[vertices[:, 2] == vertices[:, 2].max()], 170.0)
