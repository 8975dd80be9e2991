"""Triangles of marching cubes face as the distance function says, and stay where the surface is."""

import numpy as np
import pytest
import torch
import trimesh
from jaxtyping import Float

from reconstruct.mesh.facets import flipped
from reconstruct.mesh.mesh import MAX_NODES, ROUNDS, surface_mesh
from reconstruct.sdf.grid import SdfGrid

RADIUS, SPACING = 20.0, 2.0
MIDDLE = np.array([1.3, -0.4, 30.7])


def noisy_ball(noise: float = 0.04) -> SdfGrid:
    """Return the distances from a ball in the air, each node off by a share of a voxel."""
    axis = np.arange(-26, 27, SPACING)
    nodes = np.stack(np.meshgrid(axis, axis, axis + 30, indexing="ij"), -1)
    values = np.linalg.norm(nodes - MIDDLE, axis=-1) - RADIUS
    values += noise * SPACING * np.random.default_rng(0).standard_normal(values.shape)
    return SdfGrid(torch.from_numpy(values).float(), torch.tensor([-26.0, -26.0, 4.0]), SPACING)


def errors(mesh) -> tuple[Float[np.ndarray, " m"], float, float]:
    """Return each triangle's angle from the ball's normal (degrees), and mean and spread of the vertices' radius."""
    out = np.asarray(mesh.triangles_center) - MIDDLE
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    radius = np.linalg.norm(np.asarray(mesh.vertices) - MIDDLE, axis=1)
    cosine = (out * np.asarray(mesh.face_normals)).sum(1).clip(-1, 1)
    return np.degrees(np.arccos(cosine)), float(radius.mean()), float(radius.std())


def test_triangles_face_as_the_distances_say_and_no_vertex_leaves_the_surface():
    after = surface_mesh(noisy_ball(), 0.0, MAX_NODES, is_faced=True)
    before = surface_mesh(noisy_ball(), 0.0, MAX_NODES)
    (angle, radius, spread), (angle_before, radius_before, spread_before) = errors(after), errors(before)
    areas = [np.asarray(one.area_faces) for one in (after, before)]
    assert np.average(angle, weights=areas[0]) < 0.7 * np.average(angle_before, weights=areas[1])
    assert abs(radius - radius_before) < 0.01 * SPACING and spread < spread_before
    assert angle.max() < 90 and after.is_watertight


def test_a_vertex_moves_by_a_quarter_of_a_voxel_at_most_each_round():
    grid = noisy_ball(0.3)
    after, before = surface_mesh(grid, 0.0, MAX_NODES, is_faced=True), surface_mesh(grid, 0.0, MAX_NODES)
    moved = np.linalg.norm(after.vertices - before.vertices, axis=1)
    assert 0.2 * SPACING < moved.max() < ROUNDS * 0.2501 * SPACING


@pytest.mark.parametrize("radius", [2.0, 3.0, 4.0])  # voxels
def test_thin_parts_are_not_made_thinner(radius):
    axis = np.arange(-12.0, 13.0)
    nodes = np.stack(np.meshgrid(axis, axis, axis + 15, indexing="ij"), -1)
    away = np.linalg.norm(nodes - [0.3, -0.4, 15.2], axis=-1) - radius
    rod = np.maximum(np.linalg.norm(nodes[..., :2] - [0.3, -0.4], axis=-1) - radius, np.abs(nodes[..., 2] - 15) - 8)
    for values, volume in ((away, 4 / 3 * np.pi * radius**3), (rod, 16 * np.pi * radius**2)):
        grid = SdfGrid(torch.from_numpy(values).float(), torch.tensor([-12.0, -12.0, 3.0]), 1.0)
        after, before = surface_mesh(grid, 0.0, MAX_NODES, is_faced=True), surface_mesh(grid, 0.0, MAX_NODES)
        assert before.volume < after.volume < volume  # chords of a convex surface lie inside it


def test_edges_are_turned_where_triangles_then_face_better_and_the_mesh_stays_closed():
    grid = noisy_ball()
    before = surface_mesh(grid, 0.0, MAX_NODES)
    places, faces = np.asarray(before.vertices), np.asarray(before.faces)
    after = trimesh.Trimesh(places, flipped(grid, places, faces, np.zeros(len(places), bool)), process=False)
    angles = [np.average(errors(mesh)[0], weights=mesh.area_faces) for mesh in (after, before)]
    assert angles[0] < 0.9 * angles[1]
    assert after.is_watertight and after.volume > 0 and after.faces.shape == before.faces.shape
    assert (after.faces != before.faces).any(1).mean() > 0.1
    assert np.sort(np.unique(after.faces)).tolist() == np.arange(len(places)).tolist()
    narrow = [(trimesh.triangles.angles(mesh.triangles).min(1) < np.radians(10)).sum() for mesh in (after, before)]
    assert narrow[0] <= narrow[1]


def test_no_edge_is_made_twice():
    """An octahedron in a plate: two of its edges would face better turned, both to the line between its tips."""
    axis = torch.arange(-4.0, 5.0)
    plate = SdfGrid(torch.meshgrid(axis, axis, axis, indexing="ij")[1].abs() - 0.5, torch.full((3,), -4.0), 1.0)
    places = np.array([[-2, 0.5, 0], [2, 0.5, 0], [2, -0.5, 0], [-2, -0.5, 0], [0, 0, 0.5], [0, 0, -0.5]])
    faces = np.array([[1, 0, 4], [0, 3, 4], [3, 2, 4], [2, 1, 4], [0, 1, 5], [3, 0, 5], [2, 3, 5], [1, 2, 5]])
    after = flipped(plate, places, faces, np.zeros(6, bool))
    edges, uses = np.unique(np.sort(after[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)), axis=0, return_counts=True)
    assert [4, 5] in edges.tolist() and (uses == 2).all()


def test_a_flat_cut_at_the_ground_stays_flat():
    ground = 24.0  # through the ball
    mesh = surface_mesh(noisy_ball(), ground, MAX_NODES, is_faced=True)
    level = np.asarray(mesh.vertices)[:, 2] < ground + 0.01 * SPACING
    is_base = level[mesh.faces].all(1)
    assert is_base.sum() > 50 and mesh.is_watertight
    assert np.allclose(np.asarray(mesh.face_normals)[is_base], [0, 0, -1])
    radius = np.sqrt(RADIUS**2 - (MIDDLE[2] - ground) ** 2)
    assert abs(mesh.area_faces[is_base].sum() / (np.pi * radius**2) - 1) < 0.03
