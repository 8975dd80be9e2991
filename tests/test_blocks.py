"""A grid kept on the blocks near its surface is the grid kept whole: same values, same rays, same steps."""

import numpy as np
import pytest

from reconstruct.sdf import kernels
from reconstruct.sdf.blocks import Blocks, overlapping, pack
from reconstruct.sdf.level_set import BAND, LevelSet
from reconstruct.sdf.rays import first_surfaces

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
