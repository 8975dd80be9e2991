"""Shake without texture: a plain table, an object's edges, and shadows whose edges are soft."""

import cv2
import numpy as np
import pytest

from capture.checks.camera_motion import SMEARED, edge_sharpness

HEIGHT, WIDTH, PHOTOS = 480, 640, 8
ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)


def _photo(k: int) -> np.ndarray:
    """A bright disc with a dark square on plain ground under a light from one side; its shadow's edge is 8 px wide."""
    rng, turn = np.random.default_rng(k), 2 * np.pi * k / PHOTOS
    ground = 0.3 * np.exp(0.001 * (np.cos(turn) * (COLUMNS - 320) + np.sin(turn) * (ROWS - 240)))
    shadow = np.hypot(COLUMNS - 320 + 60 * np.cos(turn), ROWS - 260 + 60 * np.sin(turn)) < 80
    picture = ground * (1 - 0.9 * cv2.GaussianBlur(shadow.astype(np.float32), (0, 0), 4))
    disc = np.hypot(COLUMNS - 320, ROWS - 240) < 90
    picture = np.where(disc, 0.7 + 0.1 * np.cos(turn), picture)
    picture = np.where((np.abs(COLUMNS - 320) < 30) & (np.abs(ROWS - 240) < 30), 0.15, picture)
    return cv2.GaussianBlur(picture, (0, 0), 0.7) * (1 + 0.02 * rng.standard_normal((HEIGHT, WIDTH)))


def _stack(pictures: list[np.ndarray]) -> list[np.ndarray]:
    return [one.astype(np.float32) for one in pictures]


def _shaken(picture: np.ndarray, angle: float, length: int = 6) -> np.ndarray:
    way = length / 2 * np.array([np.cos(angle), np.sin(angle)])
    moves = [np.array([[1, 0, x], [0, 1, y]], np.float32) for x, y in np.linspace(-way, way, 13)]
    moved = [
        cv2.warpAffine(picture.astype(np.float32), m, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REPLICATE) for m in moves
    ]
    return np.mean(moved, axis=0)


@pytest.mark.parametrize("angle", [0.0, 0.5, 1.57, 2.5])
def test_a_shaken_photo_of_a_plain_table_has_soft_edges(angle):
    pictures = [_photo(k) for k in range(PHOTOS)]
    assert (edge_sharpness(_stack(pictures)) > SMEARED).all()
    pictures[3] = _shaken(pictures[3], angle)
    np.testing.assert_array_equal(np.flatnonzero(edge_sharpness(_stack(pictures)) < SMEARED), [3])


def test_edges_are_compared_at_one_size_and_not_in_small_pictures():
    pictures = [_photo(k) for k in range(PHOTOS)]
    pictures[5] = _shaken(pictures[5], 0.8)
    large = [cv2.resize(one, None, fx=1.5, fy=1.5, interpolation=cv2.INTER_CUBIC) for one in pictures]
    np.testing.assert_array_equal(np.flatnonzero(edge_sharpness(_stack(large)) < SMEARED), [5])
    small = [cv2.resize(one, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for one in pictures]
    assert np.isnan(edge_sharpness(_stack(small))).all()


def test_photos_without_edges_tell_nothing():
    plain = np.full((PHOTOS, HEIGHT, WIDTH), 0.4, np.float32)
    assert np.isnan(edge_sharpness(list(plain))).all()
