"""The outline that shadow pictures show: decided by a surface, and a surface that contradicts them is told."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from synthetic import Box, Look, grid_of, render

from reconstruct.labels.observer import Observer
from reconstruct.labels.outline import outline_of
from reconstruct.labels.supervision import supervise
from reconstruct.scene import ground_points
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.rays import first_hits
from reconstruct.solve.trials import shadow_doubts

LOOK = Look(width=120, height=90, n_lights=16, with_shadow=True)
TOP = Box((-40, -30, 40), (40, 30, 48))
LEGS = tuple(Box((x, y, 0), (x + 8, y + 8, 41)) for x in (-40, 32) for y in (-30, 22))
BLOCK = Box((-5, -5, 47), (17, 17, 84))
TABLE = (TOP, *LEGS, BLOCK)  # a seat above legs and what lies on it: no height field


@pytest.fixture(scope="module")
def table():
    scene, truth = render(TABLE, LOOK)
    return replace(scene, rgb=None), truth


def test_a_missing_part_is_surely_object_and_the_rest_is_not_decided_wrongly(table):
    scene, truth = table
    found = outline_of(scene, grid_of((TOP, *LEGS), 2.0), torch.ones_like(scene.shadow))
    sure, shown = found.confidence.numpy() > 0.5, found.mask.numpy() > 0.5
    block = truth.mask & ~render((TOP, *LEGS), LOOK)[1].mask  # it stands out beyond the top
    front = block & (truth.normals[..., 2] < 0.5)  # its top is lit by every light, as the ground behind it is
    assert front.sum() > 30 and (sure & shown)[front].mean() > 0.9
    assert (sure & (shown != truth.mask))[~block].mean() < 0.003


def test_a_surface_that_lacks_a_part_is_doubted_and_the_true_one_is_not(table):
    scene, truth = table
    scene = replace(scene, mask=torch.from_numpy(truth.mask.astype(np.float32)))
    observer = Observer(scene)
    rays = supervise(scene, observer.ground_labels())
    rays = replace(rays, confidence=np.zeros_like(rays.confidence))  # as if all were held out
    assert shadow_doubts((scene,), (observer,), (rays,), grid_of(TABLE, 2.0)) == ()
    (doubt,) = shadow_doubts((scene,), (observer,), (rays,), grid_of((TOP, *LEGS), 2.0))
    assert "of the shadow that was set aside for a test" in doubt and "below 4 %" in doubt


@pytest.mark.parametrize("shift", [1.5, -1.5])  # mm; a pixel is some 3 mm wide
def test_the_labels_put_right_an_outline_that_is_off_by_half_a_pixel(table, shift):
    scene, truth = table
    whole = grid_of(TABLE, 2.0)
    shifted = SdfGrid(whole.values + shift, whole.origin, whole.spacing)
    found = outline_of(scene, shifted, torch.ones_like(scene.shadow))
    shown = found.mask.numpy() > 0.5
    to_ground = torch.nan_to_num((ground_points(scene) - scene.eye).norm(dim=-1), nan=torch.inf)
    rays = scene.directions.reshape(-1, 3)
    seen = first_hits(shifted, scene.eye, rays, to_ground.ravel()).on_object.numpy().reshape(shown.shape)
    before, after = (int((one != truth.mask).sum()) for one in (seen, shown))
    assert after < 0.2 * before
