"""What holds each vertex of a solved ball, and whether it says how wrong it is."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation
from synthetic import BALL, HEAP, Look, render
from test_solver import assert_ball, of_shadows

from reconstruct.fields import SolvedScene
from reconstruct.initialization.light_contradictions import contradictions
from reconstruct.labels.labels import assemble_labels
from reconstruct.mesh.evidence import SEEN, SHADOW, UNCONSTRAINED, vertex_evidence, volume_sigma
from reconstruct.mesh.mesh import extract_mesh
from reconstruct.run.report_json import guessed, misfit, pieces, undersides
from reconstruct.scene import light_share
from reconstruct.sdf.grid import SdfGrid
from reconstruct.solve import solver


@pytest.fixture(scope="module")
def by_shadows():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(solver, "hull_is_better", lambda *_: True)  # as hull_start, for all tests of this file
        return of_shadows("point")


@pytest.fixture(scope="module")
def solved(by_shadows):
    return by_shadows[0], by_shadows[2]


def test_shadows_alone_give_the_ball_and_every_iteration_tells_its_error(by_shadows):
    assert_ball(*by_shadows)


def test_seen_vertices_face_the_camera_and_the_foot_behind_is_held_by_nothing(solved):
    fields, _ = solved
    mesh = extract_mesh(fields)
    kind, vertices = mesh.vertex_attributes["evidence"], np.asarray(mesh.vertices)
    towards = fields.world_from_camera.translation - vertices
    cosine = (mesh.vertex_normals * towards).sum(1) / np.linalg.norm(towards, axis=1)
    above = vertices[:, 2] > 1  # mm: where the ball is cut at the ground, a vertex's normal turns down
    assert (cosine[(kind == SEEN) & above] > -0.5).all() and (kind[cosine > 0.5] == SEEN).mean() > 0.98
    behind_foot = (vertices[:, 1] > 10) & (vertices[:, 2] < 15)  # the camera stands at negative y
    assert (kind[behind_foot] != SEEN).all() and (kind[behind_foot] == UNCONSTRAINED).any()
    assert (kind[vertices[:, 2] > 60] != UNCONSTRAINED).mean() > 0.9
    assert (kind == SHADOW).any()


def test_sigma_is_right_within_a_factor_of_two_and_grows_where_nothing_holds_the_surface(solved):
    fields, truth = solved
    mesh = extract_mesh(fields)
    vertices, kind, sigma = np.asarray(mesh.vertices), *mesh.vertex_attributes.values()
    held = (vertices[:, 2] > 3) & (kind != UNCONSTRAINED)  # the cut at the ground is no surface of the ball
    error = np.abs(truth.sdf(vertices[held]))
    assert (
        0.5 < np.median(error) / (0.6745 * np.median(sigma[held])) < 2
    )  # of a normal error the median is 0.6745 sigma
    assert sigma[kind == UNCONSTRAINED].min() > sigma[held].min()
    assert np.median(sigma[kind == UNCONSTRAINED]) > 1.5 * np.median(sigma[held])


def test_uncertain_lights_make_high_vertices_uncertain_and_the_volume_is_within_its_sigmas(solved):
    fields, _ = solved
    mesh = extract_mesh(fields)
    vertices, known = np.asarray(mesh.vertices), mesh.vertex_attributes["sigma"]
    doubted = vertex_evidence(replace(fields, light_share=0.05), vertices)
    assert doubted is not None
    np.testing.assert_allclose(doubted.sigma**2, known**2 + doubted.lean**2, rtol=1e-3)
    towards = fields.world_from_camera.translation - vertices
    facing = np.abs((mesh.vertex_normals * towards).sum(1)) / np.linalg.norm(towards, axis=1)
    across = np.where(doubted.kind == SEEN, np.maximum(facing, 0.5), 0.5)
    high = vertices[:, 2] > 5  # mm: below, normals of the mesh are those of the cut
    np.testing.assert_allclose(doubted.lean[high], (0.8 * 0.05 * across * vertices[:, 2])[high], rtol=0.1)
    true_volume = 4 / 3 * np.pi * BALL.radius**3
    under = max(0.0, BALL.radius - BALL.centre[2])  # the cap below the ground is no part of the mesh
    true_volume -= np.pi * under**2 * (BALL.radius - under / 3)
    told = volume_sigma(mesh)
    assert told is not None and abs(mesh.volume - true_volume) < 3 * told < 0.5 * true_volume
    del mesh.vertex_attributes["sigma"]
    assert volume_sigma(mesh) is None


def test_the_share_of_a_light_is_its_sigma_over_its_distance():
    scene, _ = render((BALL,), Look(n_lights=4))
    middle = np.array([10.0, 0.0, 20.0])
    away = np.linalg.norm(scene.lights[:, :3].double().numpy() - middle, axis=1)
    sigma = torch.from_numpy(np.outer(0.02 * away, [1, 0, 0])).float()
    assert light_share(replace(scene, light_sigma=sigma), middle) == pytest.approx(0.02, rel=1e-4)
    assert light_share(scene, middle) == 0


def test_a_volume_is_as_uncertain_as_its_surface_all_in_or_all_out_and_less_where_it_is_guessed():
    ball, sigma = trimesh.creation.icosphere(4, radius=50.0), 0.5
    n = len(ball.vertices)
    between = trimesh.creation.icosphere(4, radius=50.0 + sigma).volume - ball.volume
    told = []
    for kind in (SEEN, SHADOW, UNCONSTRAINED):
        ball.vertex_attributes |= {"evidence": np.full(n, kind, np.uint8), "sigma": np.full(n, sigma, np.float32)}
        told.append(volume_sigma(ball))
    assert told[:2] == pytest.approx([between] * 2, rel=0.02)
    assert 0.2 * between < told[2] < 0.6 * between  # what is guessed is off to both sides


def test_a_surface_that_is_mostly_guessed_is_warned_of():
    mesh = trimesh.creation.icosphere(3)
    n = len(mesh.vertices)
    mesh.vertex_attributes["sigma"] = np.full(n, 2.0, np.float32)
    for share, warnings in ((0.5, 0), (0.8, 1)):
        kind = np.full(n, SEEN, np.uint8)
        kind[: round(share * n)] = UNCONSTRAINED
        mesh.vertex_attributes["evidence"] = kind
        assert len(guessed(mesh)) == warnings
    assert "80 %" in guessed(mesh)[0]
    assert guessed(trimesh.creation.icosphere(1)) == []


def test_undersides_that_nothing_holds_are_warned_of_and_the_base_is_none(solved):
    fields = solved[0]
    plate = trimesh.creation.box((100, 100, 10)).apply_translation((0, 0, fields.ground_height + 80))
    leg = trimesh.creation.box((30, 30, 75)).apply_translation((0, 0, fields.ground_height + 37.5))
    for parts, warnings in (((plate, leg), 1), ((leg,), 0)):
        mesh = trimesh.util.concatenate(parts).subdivide().subdivide()
        mesh.vertex_attributes["evidence"] = np.where(
            mesh.vertices[:, 2] > fields.ground_height + 78, SEEN, UNCONSTRAINED
        )
        assert len(undersides(mesh, fields)) == warnings
        mesh.vertex_attributes["evidence"] = np.full(len(mesh.vertices), SEEN)
        assert undersides(mesh, fields) == []


# --- what contradicts a light, and pieces in the air -----------------------------------------------------------------


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
    assert pieces(box, fields, 20) == []
    assert pieces(trimesh.util.concatenate([box, beside]), fields, 20) == []
    apart = trimesh.util.concatenate([box, above])
    assert "2 pieces, 1 of them in the air: shadows that contradict" in pieces(apart, fields, 20)[0]
    assert "in the air: 5 photos leave open" in pieces(apart, fields, 5)[0]
