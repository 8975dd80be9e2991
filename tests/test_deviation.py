"""Distances to balls and boxes, which are known in closed form."""

import numpy as np
import pytest
import trimesh
from synthetic import Box, _distance

from capture.errors import ReconstructionError
from reconstruct.evaluate.deviation import ReferenceMesh, best_fit, deviations, in_unit, load_reference, summary


def small_ball(radius: float) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=4, radius=radius)


def test_a_ball_inside_a_larger_one_is_behind_it_everywhere():
    distances = deviations(small_ball(10.0), small_ball(12.0))
    np.testing.assert_allclose(distances, -2.0, atol=0.02)  # the larger one's facets lie up to 0.016 inside it
    np.testing.assert_allclose(deviations(small_ball(12.0), small_ball(10.0)), 2.0, atol=0.02)


def test_around_a_box_of_twelve_triangles_the_distance_is_exact_at_faces_edges_and_corners():
    box = Box((-10.0, -6.0, -3.0), (10.0, 6.0, 3.0))
    reference = trimesh.creation.box((20, 12, 6))
    points = np.random.default_rng(0).uniform([-13, -9, -6], [13, 9, 6], (4000, 3))
    cloud = trimesh.Trimesh(points, [[0, 1, 2]], process=False)
    found, truth = deviations(cloud, reference), _distance(box, points)
    np.testing.assert_allclose(found, truth, atol=1e-3)


def test_the_summary_counts_area_and_not_vertices():
    plane = trimesh.Trimesh([[0, 0, 0], [3, 0, 0], [0, 3, 0], [9, 9, 9]], [[0, 1, 2]], process=False)
    numbers = summary(plane, np.array([1.0, 2.0, -3.0, 50.0]))
    assert numbers.mean == pytest.approx(0.0) and numbers.mean_absolute == pytest.approx(2.0)
    assert numbers.percentiles[1] == pytest.approx(1.0)


def test_a_turned_and_shifted_reference_is_brought_back():
    mesh = trimesh.creation.box((40, 25, 12)).subdivide_to_size(1.5)
    mesh = trimesh.util.concatenate([mesh, small_ball(8.0).apply_translation([14, 4, 10])])
    c, s = np.cos(2.2), np.sin(2.2)
    motion = np.array([[c, -s, 0, 60], [s, c, 0, -30], [0, 0, 1, 5], [0, 0, 0, 1.0]])
    reference = trimesh.Trimesh(mesh.vertices @ motion[:3, :3].T + motion[:3, 3], mesh.faces, process=False)
    back = best_fit(reference, mesh)
    np.testing.assert_allclose(back.apply(np.asarray(reference.vertices)), mesh.vertices, atol=0.05)


def test_a_run_folder_and_a_file_can_be_compared_with(tmp_path):
    small_ball(10.0).export(tmp_path / "mesh.ply")
    assert load_reference(tmp_path).name == tmp_path.name
    assert len(load_reference(tmp_path / "mesh.ply").mesh.faces) == len(small_ball(1.0).faces)


def test_a_file_in_metres_is_brought_to_millimetres_and_upright(tmp_path):
    trimesh.creation.box((0.1, 0.3, 0.2)).export(tmp_path / "model.glb")  # glTF: y is up
    reference = load_reference(tmp_path / "model.glb")
    np.testing.assert_allclose(in_unit(reference, "mm").extents, [100, 200, 300], rtol=1e-5)
    np.testing.assert_allclose(in_unit(reference, "scene").extents, [0.1, 0.2, 0.3], rtol=1e-5)


def test_what_cannot_be_compared_is_refused_by_name(tmp_path):
    with pytest.raises(ReconstructionError, match=r"mesh\.ply is not there"):
        load_reference(tmp_path)
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(ReconstructionError, match=r"notes\.txt: not a mesh"):
        load_reference(tmp_path / "notes.txt")
    trimesh.PointCloud(np.eye(3)).export(tmp_path / "points.ply")
    with pytest.raises(ReconstructionError, match=r"points\.ply"):
        load_reference(tmp_path / "points.ply")
    with pytest.raises(ReconstructionError, match="one unit was needed"):
        in_unit(ReferenceMesh("other", small_ball(1.0), "scene"), "mm")
