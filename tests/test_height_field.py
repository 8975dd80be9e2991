"""Height fields: their light rays, what passes beneath, their solid on a grid, and a solve that starts from one."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from synthetic import BALL, Look, render
from test_solver import Listener

from calibration.camera import Camera
from calibration.pose import Pose
from reconstruct.config import FitConfig, Level
from reconstruct.initialization.choose_start import JUDGES_BLOCK, JUDGES_SEED, JUDGES_SHARE, choose_start
from reconstruct.initialization.height_field import HeightConfig, HeightField, fit_heights
from reconstruct.initialization.height_grid import base_of, height_grid
from reconstruct.initialization.height_view import height_view
from reconstruct.labels.held_out import draw_blocks, hold_out
from reconstruct.labels.labels import Labels, assemble_labels
from reconstruct.labels.observer import Observer
from reconstruct.labels.supervision import supervise
from reconstruct.render.g_buffer import surface_maps
from reconstruct.scene import Scene
from reconstruct.sdf.grid import SdfGrid
from reconstruct.solve.solver import fit

EYE_MM, WIDTH = 400.0, 48
QUICK = HeightConfig(iterations=(30, 50))


def seen_from_above(depth: np.ndarray, lights: np.ndarray, mask: np.ndarray | None = None) -> tuple[Scene, Labels]:
    """A camera straight above a relief given by its depth in each pixel, with the shadows that the relief throws.

    Shadows come from marching each ray over the depth map in space, not from the kernels.
    """
    scene, _ = render((BALL,), Look(width=WIDTH, height=WIDTH, n_lights=len(lights), with_shadow=True, with_mask=True))
    camera = Camera(WIDTH, WIDTH, 2.0 * WIDTH, 2.0 * WIDTH, WIDTH / 2 - 0.5, WIDTH / 2 - 0.5)
    pose = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, EYE_MM]))
    rays = camera.unproject(camera.pixel_grid())
    shadow = np.stack([lit_from(depth, camera, (light[:3] - [0, 0, EYE_MM]) * [1, -1, -1]) for light in lights])
    scene = replace(
        scene,
        rgb=None,
        shadow=torch.from_numpy(shadow).float(),
        mask=None if mask is None else torch.from_numpy(mask).float(),
        usable=torch.ones(shadow.shape, dtype=torch.bool),
        eye=torch.tensor([0.0, 0.0, EYE_MM]),
        directions=torch.from_numpy(pose.rotate(rays / np.linalg.norm(rays, axis=-1, keepdims=True))).float(),
        forward=torch.tensor([0.0, 0.0, -1.0]),
        lights=torch.from_numpy(lights).float(),
        light_sigma=torch.zeros(len(lights), 3),
        camera=camera,
        world_from_camera=pose,
    )
    return scene, assemble_labels(scene, None, None)


def lit_from(depth: np.ndarray, camera: Camera, light: np.ndarray) -> np.ndarray:
    """1 where the straight way to a point light (camera axes) stays before the relief, by samples along it."""
    points = camera.unproject(camera.pixel_grid()) * depth[..., None]
    lit = np.ones(depth.shape)
    for t in np.linspace(0.004, 0.5, 400):
        at = points + t * (light - points)
        uv = np.rint(camera.project(at)).astype(int)
        inside = ((uv >= 0) & (uv < WIDTH)).all(-1) & (at[..., 2] > 0)
        u, v = np.clip(uv[..., 0], 0, WIDTH - 1), np.clip(uv[..., 1], 0, WIDTH - 1)
        lit[inside & (at[..., 2] > depth[v, u] + 0.5)] = 0
    return lit


def lights_around(n: int = 12) -> np.ndarray:
    """Point lights 15 to 45 degrees above the ground."""
    turn = 2 * np.pi * np.arange(n) / n
    rise = np.radians(np.linspace(15, 45, n)[(5 * np.arange(n)) % n])
    flat = 900 * np.cos(rise)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), 900 * np.sin(rise), np.ones(n)], 1)


def waves(height_mm: float) -> np.ndarray:
    """Depth of hills on the ground 400 mm below the camera, which show no bare ground."""
    v, u = np.mgrid[:WIDTH, :WIDTH] / WIDTH * 2 * np.pi
    return EYE_MM - height_mm * (1 + np.sin(2 * u + 0.5) * np.cos(1.5 * v)) / 2


def test_hills_without_any_bare_ground_come_from_their_shadows():
    depth = waves(60.0)
    scene, labels = seen_from_above(depth, lights_around(), np.ones((WIDTH, WIDTH)))
    field = fit_heights(height_view(scene, labels), QUICK)
    p = field.view.padding
    found = field.view.depth(field.heights)[p:-p, p:-p]
    away = found - depth
    assert 0.01 < np.abs(away - away.mean()).mean() < 4.0  # of 60 mm; a pixel is 8 mm wide
    flat = EYE_MM - 30.0 - depth
    assert np.abs(away - away.mean()).mean() < 0.25 * np.abs(flat).mean()


def test_normals_alone_give_the_hills_and_a_step_stays_a_step():
    """Without a shadow label. Across the step no slope is told, and a break in depth costs little."""
    depth = waves(60.0)
    depth[:, : WIDTH // 2] += 25.0
    scene, labels = seen_from_above(depth, lights_around(2), np.ones((WIDTH, WIDTH)))
    points = scene.camera.unproject(scene.camera.pixel_grid()) * depth[..., None] * [1, -1, -1]
    normals = np.cross(np.gradient(points, axis=1), -np.gradient(points, axis=0))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    trust = torch.ones(WIDTH, WIDTH)
    trust[:, WIDTH // 2 - 1 : WIDTH // 2 + 1] = 0
    nothing = torch.zeros_like(labels.confidence)
    told = replace(labels, confidence=nothing, normals=torch.from_numpy(normals).float(), normal_confidence=trust)
    field = fit_heights(height_view(scene, told), replace(QUICK, stiffness=0.0002))
    p = field.view.padding
    found = field.view.depth(field.heights)[p:-p, p:-p]
    for half in (slice(0, WIDTH // 2 - 1), slice(WIDTH // 2 + 1, None)):
        away = (found - depth)[:, half]
        assert np.abs(away - away.mean()).mean() < 2.0  # of 60 mm, and 25 across the step


def test_the_solid_on_a_grid_has_the_depth_and_the_normals_of_the_field():
    """The rule of normals, on a relief that has known ones: the gradient of the SDF where a pixel's ray meets it."""
    depth = waves(60.0)
    scene, labels = seen_from_above(depth, lights_around(2), np.ones((WIDTH, WIDTH)))
    view = height_view(scene, labels)
    heights = np.pad(view.focal * (view.reference / depth - 1), view.padding, mode="edge").astype(np.float32)
    field = HeightField(view, heights, view.ground_heights() - 2)
    grid = height_grid(field, scene, 2 * WIDTH)
    maps = surface_maps(grid, replace(scene.posed_camera, ground_height=base_of(grid)))
    inner = (slice(4, -4), slice(4, -4))
    assert np.abs(maps.depth.numpy() - depth)[inner].mean() < 0.5
    points = scene.camera.unproject(scene.camera.pixel_grid()) * depth[..., None] * [1, -1, -1]
    across, down = np.gradient(points, axis=1), np.gradient(points, axis=0)
    true = np.cross(across, -down)
    true /= np.linalg.norm(true, axis=-1, keepdims=True)
    cosine = (maps.normals.numpy() * true).sum(-1)[inner].clip(-1, 1)
    assert np.degrees(np.arccos(cosine)).mean() < 4.0  # half of it are the differences taken for the truth
    assert base_of(grid) == pytest.approx(scene.ground_height, abs=1e-3)


def judges(scene, labels):
    """The rays that judge a height field and the free surface that begins with it."""
    rays = supervise(scene, labels)
    height, width = scene.directions.shape[:2]
    picture = np.arange(height * width), width, len(scene.lights)
    drawn = draw_blocks(*picture, (0, JUDGES_SEED), JUDGES_BLOCK, JUDGES_SHARE)
    return hold_out(rays, drawn[:, rays.pixels], with_outline=True)[1]


@pytest.mark.slow  # 6 s
def test_a_whole_solve_without_ground_or_mask_explains_rays_it_has_not_seen():
    scene, _ = seen_from_above(waves(60.0), lights_around())
    scene = replace(scene, ground_known=False, ground_height=30.0)
    config = FitConfig(levels=(Level(32, 10, (0.2, 0.1), 1),))
    fields = fit(scene, config, Listener())
    assert fields.ground_height < 30.0  # the base stands below the lowest valley that was found
    held_out = judges(scene, assemble_labels(scene, None, None))
    flat = float((held_out.weight * (1 - held_out.label)).sum() / held_out.weight.sum())  # all lit
    assert held_out.error(fields.grid, scene) < 0.5 * flat


def test_the_start_is_judged_by_its_labels_that_were_read_and_by_no_others():
    scene, _ = render((BALL,), Look(with_shadow=True, with_mask=True, n_lights=8))
    scene = replace(scene, rgb=None, ground_known=False)
    observer = Observer(scene)
    start = choose_start(scene, observer, FitConfig())
    read, labels = [], observer.labels
    observer.labels = lambda surface, scene: read.append(surface) or labels(surface, scene)
    first, other = (SdfGrid(torch.full((8, 8, 8), size), torch.zeros(3), 1.0) for size in (1.0, 2.0))
    for surface in (first, other):
        start.labels(surface, (scene,))
    assert start.better(first, other, (scene,)) is first
    assert read == [first, other]
    start.labels(other, (scene,))
    moved = replace(scene, ground_height=scene.ground_height + 1.0)
    start.better(other, first, (moved,))
    assert read == [first, other, other, other]
