"""The object is found in shadow pictures without a mask, and pictures of something else are left alone or refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from synthetic import BALL, HEAP, Look, default_camera, render

from calibration.pose import Pose
from capture.errors import ReconstructionError
from reconstruct.initialization.choose_start import HullStart, choose_start
from reconstruct.initialization.shadow_mask import with_object_mask
from reconstruct.labels.observer import Observer
from reconstruct.run.presets import preset

LOOK = Look(width=160, height=120, n_lights=24, with_shadow=True)


def found(scene, truth) -> float:
    mask = with_object_mask(replace(scene, rgb=None)).mask
    assert mask is not None
    found = mask.numpy() > 0.5
    return (found & truth.mask).sum() / (found | truth.mask).sum()


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
