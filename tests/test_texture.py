"""Truth: the balls' own normals and colours, against what a shader would make of the baked pictures."""

from dataclasses import replace

import fake_run
import numpy as np
import pytest
import torch

from capture.photos.photo import decode_srgb
from reconstruct.mesh.mesh import extract_mesh
from reconstruct.mesh.simplify import simplified
from reconstruct.mesh.texture import TexturedMesh, bake, vertex_tangents

SIZE = 256


@pytest.fixture(scope="module")
def fields(truth):
    return fake_run.fields_of(truth)


@pytest.fixture(scope="module")
def full(fields):
    return extract_mesh(fields)


@pytest.fixture(scope="module")
def baked(fields, full) -> TexturedMesh:
    return bake(fields, simplified(full, 3000), full, SIZE)


def sampled(baked: TexturedMesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """World places, shaded normals and linear base colours at the triangles' middles, as glTF says they are read."""
    uv = baked.uv[baked.faces].mean(1)
    column, row = np.clip((uv * SIZE).astype(int), 0, SIZE - 1).T
    local = baked.normal_map[row, column] / 127.5 - 1
    normal = baked.normals[baked.faces].mean(1)
    tangent = baked.tangents[baked.faces].mean(1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    along = tangent[:, :3] / np.linalg.norm(tangent[:, :3], axis=1, keepdims=True)
    up = np.cross(normal, along) * tangent[:, 3:]
    shaded = local[:, :1] * along + local[:, 1:2] * up + local[:, 2:] * normal
    places = baked.vertices[baked.faces].mean(1)
    return places, shaded / np.linalg.norm(shaded, axis=1, keepdims=True), decode_srgb(baked.base[row, column])


def test_shaded_normals_are_those_of_the_full_surface(fields, baked):
    places, shaded, _ = sampled(baked)
    wanted = torch.nn.functional.normalize(fields.grid.gradient(torch.from_numpy(places).float()), dim=-1).numpy()
    smooth = np.linalg.norm(places - [-25, 10, 35], axis=1) < 36  # the large ball, away from the others' edges
    smooth &= (places[:, 0] < -10) & (places[:, 2] > 8)
    assert smooth.sum() > 300
    angle = np.degrees(np.arccos(np.clip((shaded * wanted).sum(1)[smooth], -1, 1)))
    assert np.median(angle) < 1.5 and np.percentile(angle, 95) < 6


def test_colours_are_those_of_the_photo(fields, baked):
    places, _, base = sampled(baked)
    seen = (places[:, 1] < -5) & (places[:, 2] > 20)  # towards the camera
    ball = seen & (places[:, 0] < 0)
    assert np.median(base[ball], axis=0) == pytest.approx([0.7, 0.6, 0.5], abs=0.06)  # a pattern of 15 % lies on it


def test_the_base_is_flat_and_looks_down(baked):
    places, shaded, _ = sampled(baked)
    base = places[:, 2] < 0.1
    assert base.any()
    assert (shaded[base, 2] < -0.99).all()


def test_tangents_follow_the_picture():
    """A square in the xz plane seen from -y, its picture upright: u along +x, up along +z."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]])
    uv = np.array([[0.0, 1], [1, 1], [1, 0], [0, 0]])  # v down
    normals = np.tile([0.0, -1, 0], (4, 1))
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    tangents = vertex_tangents(vertices, normals, uv, faces)
    assert np.allclose(tangents, [1, 0, 0, 1])
    assert np.allclose(np.cross(normals, tangents[:, :3]) * tangents[:, 3:], [0, 0, 1])
    mirrored = vertex_tangents(vertices, normals, uv * [-1, 1] + [1, 0], faces)
    assert np.allclose(mirrored, [-1, 0, 0, -1])


def test_a_scene_that_no_photo_saw_is_baked_too(fields, full):
    dark = replace(fields, albedo=torch.zeros_like(fields.albedo))
    assert not bake(dark, simplified(full, 500), full, 64).base.any()
