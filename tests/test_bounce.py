"""Truth: a ball over an endless plane, whose light for each other has closed forms or a plain integral."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from fake_run import fields_of, mesh_of
from jaxtyping import Float
from stage_runs import SHAPES, stage_run, truth_of
from synthetic import BALL, HEAP, Look, grid_of, render
from test_relight import CAMERA, CENTRE, POSE, RADIUS, sphere_grid
from torch.nn.functional import normalize

from calibration.light import Light
from reconstruct.export.stage_scene import stage_scene
from reconstruct.fields import SolvedScene
from reconstruct.labels.ground_test import empty_ground_test
from reconstruct.labels.ground_test import test_ground as ground_tested
from reconstruct.labels.observer import Observer
from reconstruct.labels.photometric_stereo import label_object
from reconstruct.render.g_buffer import look, material_at, seen_material
from reconstruct.render.interreflection import photo_interreflection, true_scale
from reconstruct.render.radiosity import find_patches, nearest_patches
from reconstruct.render.receivers import Receivers
from reconstruct.render.relight import environment, relight
from reconstruct.render.soft_light import soft_light
from reconstruct.render.studio import direction_of, studio_of, towards
from reconstruct.sdf.grid import SdfGrid
from reconstruct.stored_run.stored_run import StoredRun
from viewer.stage.facts import home_pose
from viewer.stage.parts import first_view

HEIGHT = float(CENTRE[2])
OVERHEAD = Light("", "directional", direction=np.array([0.0, 0.0, 1.0]))


def on_ball(polar: Float[np.ndarray, " n"]) -> tuple[torch.Tensor, torch.Tensor]:
    """Points of the ball at these angles from the top, and their normals."""
    normals = torch.from_numpy(np.stack([np.sin(polar), np.zeros_like(polar), np.cos(polar)], -1)).float()
    return CENTRE + RADIUS * normals, normals


def from_plane(points: torch.Tensor, normals: torch.Tensor, radiosity) -> Float[np.ndarray, " n"]:
    """1 / pi * integral of radiosity(distance from below the ball) cos cos / d^2 over the plane z = 0."""
    ring = np.geomspace(1e-3, 300, 1200)
    r, width = (ring[1:] + ring[:-1]) / 2, np.diff(ring)
    phi = 2 * np.pi * (np.arange(180) + 0.5) / 180
    x, y = r[:, None] * np.cos(phi) + float(CENTRE[0]), r[:, None] * np.sin(phi) + float(CENTRE[1])
    plane = np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3)
    area = np.repeat(r * width * 2 * np.pi / 180, 180) * np.repeat(radiosity(r), 180)
    out = []
    for point, normal in zip(points.numpy(), normals.numpy(), strict=True):
        offset = plane - point
        square = (offset**2).sum(-1)
        cosines = np.maximum(offset @ normal, 0) * point[2] / square
        out.append((area * cosines / square).sum() / np.pi)
    return np.array(out)


def scene(interreflection: float, albedo: float = 0.5) -> SolvedScene:
    return SolvedScene(
        sphere_grid(), torch.full((48, 64, 3), albedo), CAMERA, POSE, 0.0, "scene", interreflection=interreflection
    )


def test_a_lamp_from_overhead_lights_the_dark_half_of_the_ball_by_the_ground():
    view = look(scene(0.8), width=64)
    picture, plain = relight(view, OVERHEAD), relight(look(scene(0.0), width=64), OVERHEAD)
    dark = view.maps.mask & (view.maps.normals[..., 2] < -0.1)
    points, normals = view.maps.points[dark], view.maps.normals[dark]
    truth = from_plane(points, normals, lambda r: (r > RADIUS).astype(float))
    assert dark.sum() > 40 and float(plain[dark].max()) == 0
    assert np.abs(picture[dark][:, 0].numpy() - 0.5 * 0.4 * truth).max() < 0.03 * 0.5
    assert (picture >= plain).all()


def test_in_a_white_furnace_the_ball_receives_what_the_ground_receives_and_nothing_exceeds_the_furnace():
    view = look(scene(2.0), width=16)  # albedo 0.5, by the light it sends 1: a white ball on white ground
    received = environment(view, torch.ones(32, 64, 3), rows=16)[..., 0] / 0.5
    ball = view.maps.mask
    z = view.maps.normals[ball][:, 2].numpy()
    sheltered = from_plane(
        view.maps.points[ball], view.maps.normals[ball], lambda r: 1 - RADIUS**2 * HEIGHT / (r**2 + HEIGHT**2) ** 1.5
    )
    assert np.abs(received[ball].numpy() - (1 + z) / 2 - sheltered).max() < 0.05
    assert abs(float((received[ball].numpy() - (1 + z) / 2 - sheltered).mean())) < 0.01
    away = view.maps.points[~ball][:, :2] - CENTRE[:2]
    far = received[~ball][away.norm(dim=-1) > 4]
    assert len(far) and (far - 1).abs().max() < 0.02
    assert received.max() < 1.02


def test_a_thin_wall_has_patches_on_both_sides_and_the_bottom_of_the_world_none():
    nodes = torch.stack(torch.meshgrid(*[torch.arange(n).float() for n in (70, 70, 9)], indexing="ij"), -1)
    beyond = (nodes - torch.tensor([35.0, 35, 4.75])).abs() - torch.tensor([30.0, 30, 0.6])
    wall = find_patches(SdfGrid(beyond.amax(-1), torch.zeros(3), 1.0), None)
    assert wall is not None and wall.size > 2 * 0.6
    for facing in (1, -1):
        assert (facing * wall.normals[:, 2] > 0.9).sum() > 0.7 * (60 / wall.size) ** 2
    assert find_patches(SdfGrid(torch.ones(4, 4, 4), torch.zeros(3), 0.1), 0.0) is None


@pytest.mark.parametrize(
    ("true", "room", "ground_known"), [(0.0, 0, True), (0.7, 0, True), (0.0, 3, False), (0.7, 3, False)]
)
def test_how_white_surfaces_are_shows_in_what_they_send_each_other(true, room, ground_known):
    """Also where nothing tells the room's light: it is not taken for light between surfaces, nor the reverse."""
    photos, truth = render((BALL,), Look(n_lights=12, texture=0.3, noise=0.002))
    grid = grid_of((BALL,), 2.5)
    albedo, at, facing = (torch.from_numpy(a).float() for a in (truth.albedo, truth.points, truth.normals))
    camera, pose = truth.calibration.camera, truth.calibration.world_from_camera
    fields = SolvedScene(grid, albedo, camera, pose, 0.0, "mm")
    interreflection = photo_interreflection(fields, photos)
    photos = replace(photos, ground_known=ground_known)
    assert interreflection is not None and photos.rgb is not None
    on_ball = torch.from_numpy(truth.mask)
    sent = interreflection.at(at[on_ball], facing[on_ball])
    photos.rgb[:, on_ball] += albedo[on_ball] * (true * sent + room * sent.mean())
    assert math.isclose(true_scale(fields, photos, interreflection), true, abs_tol=0.03)


@pytest.mark.parametrize("ground_known", [True, False])
def test_light_between_surfaces_turns_no_normals(ground_known):
    """Three solids that stand close, whose light for each other the photos show: their creases look flat without it."""
    photos, truth = render(HEAP, Look(n_lights=16, noise=0.002))
    if not ground_known:
        photos = replace(photos, ground_known=False, mask=torch.from_numpy(truth.mask).float())
    fields = fields_of(truth)
    interreflection = photo_interreflection(fields, photos)
    assert interreflection is not None and photos.rgb is not None
    on = torch.from_numpy(truth.mask)
    albedo, at, facing = (torch.from_numpy(a).float()[on] for a in (truth.albedo, truth.points, truth.normals))
    sent = interreflection.at(at, facing)
    photos.rgb[:, on] += albedo * sent
    observer = Observer(photos)
    points, normals = observer.seen(fields.grid)
    ground = ground_tested(photos) if ground_known else empty_ground_test(photos)
    endless = label_object(photos, points, normals, on.float(), ground).normals
    ours = observer.labels(fields.grid, photos).normals
    in_creases = sent.mean((0, 2)) > sent.mean((0, 2)).quantile(0.7)

    def degrees_off(found: torch.Tensor) -> float:
        return float(np.median(truth.degrees(normalize(found, dim=-1))[truth.mask][in_creases]))

    assert degrees_off(ours) < 0.3 * degrees_off(endless)


# --- light of a sky and of one bounce, a vertex ----------------------------------------------------------------------


@pytest.fixture(scope="module", params=list(SHAPES))
def lit_scene(request):
    """SolvedScene, mesh, its vertices and normals, its soft light."""
    fields = fields_of(truth_of(request.param))
    mesh = mesh_of(fields)
    normals = torch.from_numpy(np.array(mesh.vertex_normals)).float()
    points = torch.from_numpy(np.array(mesh.vertices)).float()
    return fields, points, normals, soft_light(seen_material(fields), mesh, normals)


def test_what_lies_open_above_sees_all_of_the_sky_and_an_underside_none(lit_scene):
    _, points, normals, soft = lit_scene
    top = (normals[:, 2] > 0.99) & (points[:, 2] > points[:, 2].max() - 1)
    under = (normals[:, 2] < -0.95) & (points[:, 2] > 4)
    assert soft.sky[top].mean() > 0.9
    assert soft.sky.min() >= 0 and soft.sky.max() <= 1.001
    if under.any():
        assert soft.sky[under].mean() < 0.1


def test_four_numbers_tell_the_bounce_of_lamps_from_all_sides(lit_scene):
    fields, points, normals, soft = lit_scene
    patches = find_patches(fields.grid, fields.ground_height)
    assert patches is not None
    albedo, _ = material_at(seen_material(fields), patches.points, patches.on_object)
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
