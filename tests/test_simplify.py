"""Truth: spheres and two boxes that touch, whose volume and topology are known."""

import numpy as np
import pytest
import trimesh

from reconstruct.mesh.simplify import bounds_a_solid, simplified


def sphere(subdivisions: int = 4) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions, 10.0)
    colours = np.where(mesh.vertices[:, :1] > 0, [[200, 20, 20, 255]], [[20, 20, 200, 255]]).astype(np.uint8)
    mesh.visual.vertex_colors = colours
    return mesh


def thin_star() -> trimesh.Trimesh:
    """Blades a tenth as thick as a triangle is wide: reduced, they fold and pinch."""
    blades = [trimesh.creation.box((20, 0.3, 20)) for _ in range(5)]
    for k, blade in enumerate(blades):
        for _ in range(4):
            blade = blade.subdivide()
        blade.apply_translation([0, k * 3.0, 0])
        blade.vertices += np.random.default_rng(k).normal(0, 0.04, blade.vertices.shape)
        blades[k] = blade
    return trimesh.util.concatenate(blades)


@pytest.mark.parametrize("faces", [200, 1000, 3000])
def test_a_sphere_keeps_its_volume_and_stays_closed(faces):
    small = simplified(sphere(), faces)
    assert len(small.faces) <= faces
    assert small.is_watertight and small.is_winding_consistent
    assert small.volume == pytest.approx(4 / 3 * np.pi * 1000, rel=8.0 / faces + 0.003)


def test_colours_and_normals_are_those_of_the_full_mesh():
    small = simplified(sphere(), 400)
    red = small.visual.vertex_colors[:, 0] > 100
    assert (small.vertices[red, 0] > -1).all() and (small.vertices[~red, 0] < 1).all()
    assert ((small.vertex_normals * small.vertices / 10).sum(1) > 0.97).all()


@pytest.mark.parametrize("faces", [120, 400, 1500])
def test_thin_parts_that_collapse_leave_no_holes(faces):
    full = thin_star()
    small = simplified(full, faces)
    assert small.is_watertight
    assert len(small.faces) < 0.9 * len(full.faces)


def test_a_surface_with_a_hole_bounds_no_solid():
    full = sphere(2)
    assert bounds_a_solid(full.vertices, full.faces)
    assert not bounds_a_solid(full.vertices, full.faces[1:])
    assert not bounds_a_solid(full.vertices, full.faces[:, ::-1])  # inside out


def test_two_boxes_that_touch_along_an_edge_bound_a_solid():
    one, other = trimesh.creation.box((1, 1, 1)), trimesh.creation.box((1, 1, 1))
    other.apply_translation([1, 1, 0])
    both = trimesh.util.concatenate([one, other])
    both.merge_vertices()
    assert not both.is_watertight
    assert bounds_a_solid(both.vertices, both.faces)
