"""Where the table ends, from how well points of the ground follow the lights."""

import numpy as np
import pytest

from calibration.ground.table_edges import find_table_edges

EYE = np.array([0.0, -500.0, 400.0])


def points(rng) -> np.ndarray:
    return np.column_stack([rng.uniform(-400, 400, 3000), rng.uniform(-300, 600, 3000), np.zeros(3000)])


@pytest.mark.parametrize("angle", [90.0, 60.0, 135.0])
def test_a_line_beyond_which_nothing_follows_is_the_tables_edge(angle):
    rng = np.random.default_rng(0)
    places, normal = points(rng), -np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    beyond = places[:, :2] @ normal < -150
    follows = np.where(beyond, 0.4, 0.9) + rng.normal(0, 0.15, 3000)
    (edge,) = find_table_edges(places, follows, EYE)
    assert edge.normal @ normal > np.cos(np.radians(3)) and abs(edge.offset + 150) < 25
    assert (edge.on_table(places) == ~beyond).mean() > 0.97 and edge.on_table(np.zeros((1, 3))).all()


def test_a_corner_of_the_table_has_two_edges():
    rng = np.random.default_rng(1)
    places = points(rng)
    beyond = (places[:, 1] > 200) | (places[:, 0] > 150)
    edges = find_table_edges(places, np.where(beyond, 0.3, 0.9) + rng.normal(0, 0.1, 3000), EYE)
    on_table = np.all([edge.on_table(places) for edge in edges], axis=0)
    assert len(edges) == 2 and (on_table == ~beyond).mean() > 0.96


def test_shadows_around_an_object_and_a_table_without_end_have_no_edge():
    rng = np.random.default_rng(2)
    places = points(rng)
    follows = 0.95 - 0.6 * np.exp(-((np.linalg.norm(places, axis=1) / 120) ** 2)) + rng.normal(0, 0.05, 3000)
    assert not find_table_edges(places, follows, EYE)
    assert not find_table_edges(places, np.full(3000, 0.9), EYE)
