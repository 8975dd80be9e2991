"""One surface from the photos of several cameras: what one cannot see, the others show."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from brief_drafts import NORMAL_STEPS
from scipy.spatial import KDTree
from synthetic import Look, Sphere, Truth, default_camera, grid_of, render

from calibration.camera import Camera
from calibration.pose import Pose
from capture.errors import ReconstructionError
from reconstruct.config import FitConfig, Level
from reconstruct.fields import SolvedScene, load_fields, save_fields
from reconstruct.labels.labels import assemble_labels
from reconstruct.render.g_buffer import material_at, seen_material, surface_maps
from reconstruct.render.joined import join_views
from reconstruct.scene import Scene
from reconstruct.sdf.grid import SdfGrid
from reconstruct.shading import joint_normals
from reconstruct.solve.solver import fit

SHAPES = (Sphere((0.0, 0.0, 30.0), 30.0, (0.7, 0.5, 0.3)), Sphere((12.0, 8.0, 60.0), 14.0, (0.3, 0.5, 0.7)))
QUICK = FitConfig(levels=(Level(28, 14, (0.5, 0.3), 3, 4e-4), Level(44, 14, (0.3, 0.1), 2)), rays=20_000)


def turned(azimuth: float) -> tuple[Camera, Pose]:
    """The default camera, turned about the vertical through the origin by degrees."""
    camera, pose = default_camera(64, 48)
    c, s = np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth))
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return camera, Pose(turn @ pose.rotation, turn @ pose.translation)


def seen_from(azimuth: float, n_lights: int = 8, seed: int = 0, shapes=SHAPES) -> tuple[Scene, Truth]:
    look = Look(width=64, height=48, n_lights=n_lights, seed=seed)
    scene, truth = render(shapes, look, turned(azimuth))
    return replace(scene, view=f"view_{azimuth:.0f}"), truth


@pytest.fixture(scope="module", autouse=True)
def brief_normals():
    """Six photos a view leave normals to be fitted together, many times in a solve: a few steps of that will do."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(joint_normals, "STEPS", NORMAL_STEPS)
        yield


@pytest.fixture(scope="module")
def views() -> tuple[tuple[Scene, ...], tuple[Truth, ...]]:
    scenes, truths = zip(*(seen_from(120.0 * k, 6, k) for k in range(3)), strict=True)
    return scenes, truths


@pytest.fixture(scope="module")
def solved(views) -> SolvedScene:
    return fit(views[0], QUICK, lambda **_: None)


def points_on(shapes=SHAPES) -> np.ndarray:
    """Points on the shapes' common surface, above the ground."""
    rng = np.random.default_rng(0)
    normals = rng.standard_normal((4000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = np.concatenate([np.array(s.centre) + s.radius * normals for s in shapes])
    inside = np.min([np.linalg.norm(points - np.array(s.centre), axis=1) - s.radius for s in shapes], axis=0) < -1e-6
    return points[~inside & (points[:, 2] > 8)]


def error(grid: SdfGrid, points: np.ndarray) -> float:
    return float(grid.sdf(torch.from_numpy(points).float()).abs().mean())


def test_several_views_find_the_side_that_one_does_not_see(views, solved):
    alone = fit(views[0][0], QUICK, lambda **_: None)
    points = points_on()
    behind = points[points[:, 1] > 15]  # the first camera stands at negative y
    assert error(solved.grid, behind) < 0.75 * error(alone.grid, behind)
    assert error(solved.grid, points) < 1.3  # mm, of pixels of 4 mm; with the true outlines it is 1.0
    before = points[points[:, 1] < -15]
    assert error(solved.grid, before) < 1.1 * error(alone.grid, before)  # views more never make it worse


def exact_views(gains: tuple[tuple[float, float, float], ...]) -> list[SolvedScene]:
    """The true surface and the true, patterned albedo as three cameras see it, each in a scale of its own."""
    found = []
    for number, gain in enumerate(gains):
        camera, pose = turned(70.0 * number)
        scene, truth = render(SHAPES, Look(160, 120, 1, texture=0.3), (camera.resized(160, 120), pose))
        albedo = torch.from_numpy(truth.albedo * np.array(gain)).float()
        place = (scene.camera, scene.world_from_camera, 0.0, "mm")
        found.append(SolvedScene(grid_of(SHAPES, 1.5), albedo, *place, view=f"view_{number}"))
    return found


def test_views_with_other_exposure_and_white_balance_are_brought_to_one_scale():
    true = exact_views(((1, 1, 1),) * 3)
    joined = join_views(exact_views(((1.0, 1.0, 1.0), (1.3, 1.0, 0.8), (1.0, 0.9, 1.0)))).views()
    ratios = []
    for one, other in zip(joined, true, strict=True):
        seen = surface_maps(one.grid, one.posed_camera).mask & (other.albedo > 0.05).all(-1)
        ratios.append((one.albedo / other.albedo.clamp(min=1e-3))[seen])
    scale = torch.cat(ratios).median(0).values
    torch.testing.assert_close(scale, torch.tensor([1.3, 0.9, 0.8]) ** (1 / 3), rtol=0.01, atol=0)
    for ratio in ratios:  # no view has a colour of its own
        torch.testing.assert_close(ratio.median(0).values, scale, rtol=0.01, atol=0)
        assert float((ratio / scale - 1).abs().mean()) < 0.02


def test_no_seam_is_left_where_the_sight_of_a_view_ends():
    plain = exact_views(((1, 1, 1),) * 3)
    tilted = []  # what shading gets wrong at grazing views: an error that ends with the view
    for view in plain:
        maps = surface_maps(view.grid, view.posed_camera)
        towards = torch.nn.functional.normalize(torch.tensor(view.posed_camera.centre).float() - maps.points, dim=-1)
        facing = (maps.normals * towards).sum(-1, keepdim=True)
        tilted.append(replace(view, albedo=torch.where(maps.mask[..., None], 0.5 + 0.1 * (1 - facing), view.albedo)))
    joined = join_views(tilted)
    points = torch.from_numpy(points_on()).float()
    points = points[points[:, 2] > 20]
    found = material_at(seen_material(joined), points, torch.ones(len(points)) > 0)[0].mean(-1).numpy()
    low = np.linalg.norm(points.numpy() - SHAPES[0].centre, axis=1) < SHAPES[0].radius + 1e-3
    found, points = found[low], points[low]
    pairs = KDTree(points.numpy()).query_pairs(3.0, output_type="ndarray")
    apart = np.abs(found[pairs[:, 0]] - found[pairs[:, 1]])
    assert float(np.quantile(apart, 0.99)) < 0.03  # of white


def test_further_views_of_a_damaged_file_are_refused(solved, tmp_path):
    file = tmp_path / "fields.safetensors"
    save_fields(replace(solved, further=(replace(solved.further[0], albedo=solved.albedo[:-1]),)), file)
    with pytest.raises(ReconstructionError, match="pixels of albedo"):
        load_fields(file)


def test_views_without_a_common_ground_or_of_objects_at_different_places_are_refused(views):
    first, second = views[0][:2]
    away = tuple(replace(s, centre=(s.centre[0] - 70, s.centre[1] + 40, s.centre[2])) for s in SHAPES)
    for other, said in (
        (replace(second, ground_height=5.0), "ground of view view_120"),
        (replace(second, ground_known=False), "unknown or uneven"),
        (seen_from(120.0, 6, 1, away)[0], r"different places|contradict each other"),
    ):
        with pytest.raises(ReconstructionError, match=said):
            fit((first, other), QUICK, lambda **_: None)


@pytest.mark.slow
def test_shadow_pictures_of_several_cameras_need_no_photos():
    looks = [Look(width=64, height=48, n_lights=8, with_shadow=True, with_mask=True, seed=k) for k in range(2)]
    scenes = tuple(
        replace(render(SHAPES, look, turned(150.0 * k))[0], rgb=None, view=str(k)) for k, look in enumerate(looks)
    )
    assert all(assemble_labels(scene, None, None).visibility.any() for scene in scenes)
    found = fit(scenes, replace(QUICK, levels=QUICK.levels[:1]), lambda **_: None)
    assert error(found.grid, points_on()) < 2.5
