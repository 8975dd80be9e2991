"""The object is found in shadow pictures without a mask, and pictures of something else are left alone or refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from synthetic import BALL, HEAP, Box, Look, default_camera, grid_of, render

from calibration.pose import Pose
from capture.errors import ReconstructionError
from reconstruct.initialization.choose_start import HullStart, choose_start
from reconstruct.initialization.shadow_mask import with_object_mask
from reconstruct.labels.observer import Observer
from reconstruct.labels.outline import outline_of
from reconstruct.labels.supervision import supervise
from reconstruct.run.presets import preset
from reconstruct.scene import ground_points
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.rays import first_hits
from reconstruct.solve.trials import shadow_doubts

LOOK = Look(width=160, height=120, n_lights=24, with_shadow=True)


def found(scene, truth) -> float:
    mask = with_object_mask(replace(scene, rgb=None)).mask
    assert mask is not None
    return truth.overlap(mask)


@pytest.mark.parametrize("kind", ["point", "directional"])
def test_a_heap_is_found_in_its_shadows(kind):
    scene, truth = render(HEAP, replace(LOOK, kind=kind))  # the box's top is lit by every light, as bare ground is
    assert found(scene, truth) > 0.93  # an outline pixel either way would be 0.91


def test_ground_up_to_the_horizon_does_not_hide_the_object():
    camera, _ = default_camera(LOOK.width, LOOK.height)
    sine, cosine = np.sin(0.3), np.cos(0.3)  # 17 degrees down, and 21 to the picture's rim
    level = np.array([[1.0, 0, 0], [0, -sine, cosine], [0, -cosine, -sine]])
    view = (replace(camera, fx=155.0, fy=155.0), Pose(level, np.array([0.0, -400.0, 160.0])))
    scene, truth = render((BALL,), LOOK, view)
    assert not np.isfinite(truth.depth[0]).any()
    assert found(scene, truth) > 0.9


def test_sixteen_lights_and_two_per_cent_of_flipped_labels_are_enough_for_a_ball():
    scene, truth = render((BALL,), replace(LOOK, n_lights=16))
    assert scene.shadow is not None
    flip = torch.from_numpy(np.random.default_rng(2).random(scene.shadow.shape) < 0.02)
    assert found(replace(scene, shadow=torch.where(flip, 1 - scene.shadow, scene.shadow)), truth) > 0.9


def test_shadow_pictures_without_a_mask_start_from_the_hull():
    scene, _ = render((BALL,), LOOK)
    scene = with_object_mask(replace(scene, rgb=None))
    assert isinstance(choose_start(scene, Observer(scene), preset("standard", 0)[1]), HullStart)


def test_shadows_that_no_object_on_the_ground_throws_are_left_to_the_height_field():
    scene, _ = render((), LOOK)
    assert scene.shadow is not None
    spots = torch.from_numpy(np.random.default_rng(4).random((24, 12, 16))) > 0.5
    patchy = spots.repeat_interleave(10, 1).repeat_interleave(10, 2).float()
    scene = replace(scene, rgb=None, shadow=patchy)
    assert with_object_mask(scene) is scene


def test_pictures_without_a_shadow_are_refused_in_words():
    scene, _ = render((BALL,), LOOK)
    assert scene.shadow is not None
    with pytest.raises(ReconstructionError, match="24 shadow pictures show no shadow"):
        with_object_mask(replace(scene, rgb=None, shadow=torch.ones_like(scene.shadow)))


# --- the outline that shadow pictures show ---------------------------------------------------------------------------


SEEN = Look(width=120, height=90, n_lights=16, with_shadow=True)
TOP = Box((-40, -30, 40), (40, 30, 48))
LEGS = tuple(Box((x, y, 0), (x + 8, y + 8, 41)) for x in (-40, 32) for y in (-30, 22))
BLOCK = Box((-5, -5, 47), (17, 17, 84))
TABLE = (TOP, *LEGS, BLOCK)  # a seat above legs and what lies on it: no height field


@pytest.fixture(scope="module")
def table():
    scene, truth = render(TABLE, SEEN)
    return replace(scene, rgb=None), truth


def test_a_missing_part_is_surely_object_and_the_rest_is_not_decided_wrongly(table):
    scene, truth = table
    found = outline_of(scene, grid_of((TOP, *LEGS), 2.0), torch.ones_like(scene.shadow))
    sure, shown = found.confidence.numpy() > 0.5, found.mask.numpy() > 0.5
    block = truth.mask & ~render((TOP, *LEGS), SEEN)[1].mask  # it stands out beyond the top
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
