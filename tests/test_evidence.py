"""What holds each vertex of a solved ball, and whether it says how wrong it is."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from synthetic import BALL, Look, render
from test_solver import assert_ball, of_shadows

from reconstruct.mesh.evidence import SEEN, SHADOW, UNCONSTRAINED, vertex_evidence, volume_sigma
from reconstruct.mesh.mesh import extract_mesh
from reconstruct.run.report_json import guessed, undersides
from reconstruct.scene import light_share
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
