"""A light that is off by some degrees is named by what its shadow cannot be; right lights are not."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation
from synthetic import BALL, HEAP, Look, render

from reconstruct.fields import SolvedScene
from reconstruct.initialization.light_contradictions import contradictions
from reconstruct.labels.labels import assemble_labels
from reconstruct.run.report_json import misfit, pieces
from reconstruct.sdf.grid import SdfGrid

LOOK = Look(with_shadow=True, with_mask=True, n_lights=10)


@pytest.mark.parametrize("kind", ["point", "directional"])
def test_right_lights_contradict_nothing(kind):
    scene, _ = render(HEAP, replace(LOOK, kind=kind))
    found = contradictions(scene, assemble_labels(scene, None, None))
    assert np.nanmax(found.unexplained) < 0.02 and found.sentences() == ()


def test_the_edge_of_a_shadow_that_is_hardly_seen_contradicts_nothing():
    scene, _ = render(HEAP, LOOK)
    labels = assemble_labels(scene, None, None)
    visibility, confidence = labels.visibility[3].clone(), labels.confidence[3].clone()
    ground = (labels.mask < 0.5) & (confidence > 0.5)
    dark, lit = (torch.nonzero(ground & part) for part in (visibility < 0.1, visibility > 0.9))
    confidence[dark[45:].unbind(1)] = 0
    visibility[lit[:15].unbind(1)] = 0
    assert len(dark) > 450
    changed = [
        torch.stack([*old[:3], new, *old[4:]])
        for old, new in ((labels.visibility, visibility), (labels.confidence, confidence))
    ]
    found = contradictions(scene, replace(labels, visibility=changed[0], confidence=changed[1]))
    assert found.contradicting() == [] and found.unexplained[3] > 0


@pytest.mark.parametrize("about", ["its azimuth", "its elevation"])
def test_a_light_that_is_off_by_seven_degrees_is_named(about):
    scene, _ = render((BALL,), LOOK)
    lights = scene.lights.clone()
    place = lights[3, :3].double().numpy()
    axis = np.array([0, 0, 1.0]) if about == "its azimuth" else np.cross(place, [0, 0, 1]) / np.hypot(*place[:2])
    lights[3, :3] = torch.from_numpy(Rotation.from_rotvec(np.radians(7) * axis).apply(place)).float()
    found = contradictions(replace(scene, lights=lights), assemble_labels(scene, None, None))
    assert found.contradicting() == [3]
    assert scene.photo_names[3] in found.sentences()[0] and "a larger error of the lights" in found.sentences()[0]


def test_a_surface_that_misses_held_out_shadows_says_so():
    assert misfit({"loss_held_out": 0.05}) == [] and misfit({}) == []
    assert "wrong by 18 %" in misfit({"loss_held_out": 0.18})[0]
    chord = 2 * np.sin(np.radians([14.9, 25.0]) / 2)
    assert misfit({"loss_normal": chord[0] ** 2}) == []
    assert "slopes are 25 degrees off" in misfit({"loss_normal": chord[1] ** 2})[0]


def test_pieces_in_the_air_are_warned_of_and_objects_on_the_ground_are_not():
    scene, _ = render((BALL,), replace(LOOK, n_lights=1, width=16, height=12))
    camera, pose = scene.camera, scene.world_from_camera
    grid = SdfGrid(torch.ones(2, 2, 2), torch.zeros(3), 1.0)
    fields = SolvedScene(grid, torch.zeros(12, 16, 3), camera, pose, 0.0, "mm")
    box = trimesh.creation.box(bounds=[[0, 0, 0], [10, 10, 10]])
    beside, above = box.copy().apply_translation([20, 0, 0]), box.copy().apply_translation([0, 0, 30])
    assert pieces(box, fields) == []
    assert pieces(trimesh.util.concatenate([box, beside]), fields) == []
    apart = trimesh.util.concatenate([box, above])
    assert "2 pieces, 1 of them in the air: shadows that contradict" in pieces(apart, fields)[0]
    assert "in the air: 5 photos leave open" in pieces(apart, replace(fields, lights=torch.ones(5, 4)))[0]
