"""Uneven ground of known depth: its shadows on itself are told apart, and the ball on it is found."""

from dataclasses import replace

import numpy as np
import OpenEXR
import pytest
import torch
from synthetic import BALL as BALL_ON_PLANE
from synthetic import Look, Sphere, render
from test_known import write_scene
from test_solver import Listener

from calibration.scenes.shadowneus import read_ground_depth
from capture.errors import CalibrationError, CaptureError
from reconstruct.config import FitConfig, Level
from reconstruct.hull.shadow_hull import shadow_hull
from reconstruct.labels.observer import Observer
from reconstruct.labels.uneven_ground import ground_relief, ground_visibility
from reconstruct.mesh.mesh import extract_mesh
from reconstruct.render.g_buffer import surface_maps
from reconstruct.scene import build_scene, ground_points
from reconstruct.solve.solver import fit
from reconstruct.source.photos import read_photos
from reconstruct.source.source import RunOptions, open_source

BALL = Sphere((0.0, 0.0, 33.0), 35.0)
BUMPS = tuple(  # 8 mm high, up to 35 degrees steep
    Sphere((x, y, -36.0), 44.0, (0.6, 0.6, 0.6)) for x in range(-210, 211, 60) for y in range(-180, 361, 60)
)
SMALL = FitConfig(levels=(Level(24, 20, (0.5, 0.4), 3, 5e-4), Level(40, 25, (0.4, 0.1), 2)))


@pytest.fixture(scope="module")
def bumpy():
    """The truth of bare bumps and that of a ball among them, which hides the ground where it is nearer."""
    return tuple(render(shapes, Look(n_lights=24))[1] for shapes in (BUMPS, (BALL, *BUMPS)))


def scene_of(bumpy, pictures):
    bare, both = bumpy
    if pictures == "photos":
        return build_scene(both.stack, both.calibration, 120, ground_depth=bare.depth)
    mask = (both.depth < bare.depth).astype(float)
    return build_scene(None, both.calibration, 120, both.visibility, mask, bare.depth)


def test_shadows_of_the_ground_on_itself_are_left_out_and_little_else(bumpy):
    scene, (bare, both) = scene_of(bumpy, "shadows"), bumpy
    relief = ground_relief(scene)
    assert relief is not None
    kept = ground_visibility(scene, relief, ground_points(scene)).numpy() > 0
    ground = np.broadcast_to(both.depth >= bare.depth, kept.shape)
    dark = (bare.visibility < 0.5) & ground
    assert dark.mean() > 0.01  # there is something to leave out
    assert (kept & dark).sum() < 0.04 * dark.sum()  # in the creases where bumps meet the plane
    assert (~kept & ~dark & ground).mean() < 0.04  # the rim of two pixels


def test_photos_of_bumpy_ground_show_ground_and_object(bumpy):
    bare, both = bumpy
    labels, mask = Observer(scene_of(bumpy, "photos")).ground_labels(), both.depth < bare.depth
    found, told = labels.mask.numpy() > 0.5, (labels.confidence.numpy() > 0.5) & ~mask
    assert (found & mask).sum() > 0.95 * (found | mask).sum()
    assert ((labels.visibility.numpy() > 0.5) != (both.visibility > 0.5))[told].mean() < 1e-3
    assert told.mean() > 0.7


def test_a_depth_map_of_level_ground_gives_the_hull_of_the_plane():
    plane, _ = render((BALL_ON_PLANE,), Look(with_shadow=True, with_mask=True))
    plane = replace(plane, rgb=None)
    level = replace(plane, ground_depth=(ground_points(plane) - plane.eye) @ plane.forward)
    expected, found = (shadow_hull(scene, Observer(scene).ground_labels(), 1, 32) for scene in (plane, level))
    points = torch.from_numpy(np.random.default_rng(0).uniform([-60, -60, 2], [60, 60, 85], (4000, 3))).float()
    inside, again = expected.sdf(points) < 0, found.sdf(points) < 0
    assert (inside != again).float().mean() < 0.005 < 0.1 < inside.float().mean()


@pytest.mark.slow
@pytest.mark.parametrize("pictures", ["shadows", "photos"])
def test_the_ball_is_found_on_bumpy_ground(bumpy, pictures):
    bare, both = bumpy
    fields = fit(scene_of(bumpy, pictures), SMALL, Listener())
    maps, mask = surface_maps(fields.grid, fields.posed_camera), both.depth < bare.depth
    found = maps.mask.numpy()
    seen = found & mask
    assert seen.sum() > 0.95 * (found | mask).sum()
    # A pixel is 2 mm here; the same shadows on an assumed plane z = 0 leave 3.2 mm, and the photos are refused.
    assert 1e-3 < np.abs(maps.depth.numpy() - both.depth)[seen].mean() < 0.035 * BALL.radius
    vertices = np.asarray(extract_mesh(fields).vertices)
    assert (bare.sdf(vertices) > -0.7 * fields.grid.spacing).all()


def write_floor(folder, depth, name="r_000_depth_0001.npy"):
    (folder / "floor").mkdir()
    path = folder / "floor" / name
    if path.suffix == ".npy":
        np.save(path, depth)
    else:
        channel = depth.astype(np.float32)
        OpenEXR.File({"type": OpenEXR.scanlineimage}, {"R": channel, "G": channel, "B": channel}).write(str(path))
    return path


@pytest.mark.parametrize("kind", ["npy", "exr"])
def test_the_depth_of_the_ground_comes_back_as_written(tmp_path, kind):
    write_scene(tmp_path, light_type="point")
    depth = np.linspace(400, 600, 44 * 60).reshape(44, 60)
    depth[0, 0] = 1e10  # nothing there
    path = write_floor(tmp_path, depth, f"r_000_depth_0001.{kind}")
    source = open_source(tmp_path, RunOptions())
    read = read_photos(source, RunOptions())[0].ground_depth
    assert path in source.files(RunOptions())
    assert read is not None and np.isnan(read[0, 0])
    assert np.allclose(read.ravel()[1:], depth.ravel()[1:], rtol=1e-6)
    assert read_photos(source, RunOptions(ground="0"))[0].ground_depth is None  # a plane was asked for


def test_a_depth_map_of_another_size_or_without_ground_is_refused(tmp_path):
    truth = write_scene(tmp_path, light_type="point")
    path = write_floor(tmp_path, np.ones((30, 40)))
    with pytest.raises(CalibrationError, match="40 x 30, 60 x 44 pixels as the photos was needed"):
        read_ground_depth(path, truth.calibration.camera)
    np.save(path, np.full((44, 60), np.inf))
    with pytest.raises(CalibrationError, match="0 % of the pixels have a positive, finite depth"):
        read_ground_depth(path, truth.calibration.camera)


def test_a_trained_field_and_photos_of_an_uncalibrated_session_refuse_uneven_ground(tmp_path, monkeypatch):
    write_scene(tmp_path, light_type="point")
    write_floor(tmp_path, np.full((44, 60), 500.0))
    with pytest.raises(CaptureError, match="is held to a plane"):
        open_source(tmp_path, RunOptions(field="neural"))
    (tmp_path / "transforms_train.json").unlink()
    monkeypatch.setattr("reconstruct.source.source.load_capture", lambda folder: None)
    with pytest.raises(CaptureError, match="needs a scene with its own camera and lights"):
        open_source(tmp_path, RunOptions())
