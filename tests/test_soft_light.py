"""Light of a sky and of one bounce, kept as eight numbers a vertex, and the first lamp, on three made scenes."""

import numpy as np
import pytest
import torch
from fake_run import fields_of, mesh_of
from stage_runs import SHAPES, stage_run, truth_of

from reconstruct.export.stage_scene import stage_scene
from reconstruct.render.g_buffer import albedo_at, seen_material
from reconstruct.render.radiosity import find_patches, nearest_patches
from reconstruct.render.receivers import Receivers
from reconstruct.render.soft_light import soft_light
from reconstruct.render.studio import direction_of, studio_of, towards
from reconstruct.stored_run.stored_run import StoredRun
from viewer.stage.facts import home_pose
from viewer.stage.parts import first_view


@pytest.fixture(scope="module", params=list(SHAPES))
def scene(request):
    """SolvedScene, mesh, its vertices and normals, its soft light."""
    fields = fields_of(truth_of(request.param))
    mesh = mesh_of(fields)
    normals = torch.from_numpy(np.array(mesh.vertex_normals)).float()
    points = torch.from_numpy(np.array(mesh.vertices)).float()
    return fields, points, normals, soft_light(fields, seen_material(fields), mesh, normals)


def test_what_lies_open_above_sees_all_of_the_sky_and_an_underside_none(scene):
    _, points, normals, soft = scene
    top = (normals[:, 2] > 0.99) & (points[:, 2] > points[:, 2].max() - 1)
    under = (normals[:, 2] < -0.95) & (points[:, 2] > 4)
    assert soft.sky[top].mean() > 0.9
    assert soft.sky.min() >= 0 and soft.sky.max() <= 1.001
    if under.any():
        assert soft.sky[under].mean() < 0.1


def test_four_numbers_tell_the_bounce_of_lamps_from_all_sides(scene):
    fields, points, normals, soft = scene
    patches = find_patches(fields.grid, fields.ground_height)
    assert patches is not None
    albedo = albedo_at(fields, seen_material(fields), patches.points, patches.on_object)
    between = nearest_patches(patches, points, normals)
    at = Receivers(fields.grid, patches.points, patches.normals, patches.starts)
    for azimuth, elevation in ((0.3, 0.5), (2.5, 0.9), (4.4, 1.4)):
        way = torch.from_numpy(towards(azimuth, elevation)).float()
        direct = at.from_afar(way[None])[0][:, None].expand(-1, 3)
        wanted = between.interpolated(patches.bounced(albedo, direct))
        found = soft.arriving(way, 1.0, 0.0)
        assert (found - wanted).abs().mean() < 0.25 * wanted.mean()
        assert np.corrcoef(found.mean(-1), wanted.mean(-1))[0, 1] > 0.85


@pytest.mark.parametrize("name", list(SHAPES))
def test_the_first_lamp_stands_high_and_aside_and_shows_more_than_one_at_the_camera(name, tmp_path):
    run = StoredRun(stage_run(tmp_path, name))
    studio = studio_of(np.asarray(run.mesh.bounds))
    view = first_view(run, studio, stage_scene(run))
    camera = direction_of(home_pose(run.fields, studio).translation - studio.centre)[0]
    azimuth, elevation = view.lamp
    assert 34 < np.degrees(elevation) < 66 and 29 < abs(np.degrees(azimuth - camera)) < 61
    assert view.entropy(azimuth, elevation) > view.entropy(camera, elevation)
