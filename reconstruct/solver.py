"""From labels to a surface: an SDF grid moved until every shadow ray agrees with what its pixel saw."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from reconstruct import kernels
from reconstruct.fields import Fields, load_fields, save_fields
from reconstruct.grid import SdfGrid
from reconstruct.march import PerPart, lights_to_grid, run, thread_count, to_grid
from reconstruct.scene import Scene
from reconstruct.supervision import Supervision
from reconstruct.surface import BAND, LevelSet, resampled

REDISTANCE_EVERY = 10  # iterations: steps of at most 0.5 voxel stay well inside the band


@dataclass(frozen=True)
class Level:
    """One stage of coarse to fine."""

    nodes: int  # along the longest side of the object's box
    iterations: int
    rate: tuple[float, float]  # largest step, voxels, first and last iteration
    blur: int  # passes of gradient averaging at the first iteration, falling to one
    shrink: float = 0.0  # pull on nodes without evidence: unseen matter that no ray needs goes


@dataclass(frozen=True)
class FitConfig:
    """The solver's settings. Lengths in voxels."""

    seed: int = 0
    rays: int = 40_000  # shadow rays per iteration
    levels: tuple[Level, ...] = (
        Level(48, 70, (0.5, 0.4), 4, 5e-4),
        Level(96, 80, (0.4, 0.25), 3, 5e-4),
        Level(160, 90, (0.25, 0.08), 2),
    )
    sharpness: tuple[float, float] = (4.0, 25.0)  # NeuS s per voxel, first and last iteration of every level
    curvature: float = 0.25  # of the step size: curvature flow
    mask_share: float = 0.25  # camera rays per shadow ray
    mask_weight: float = 0.3
    normal_weight: float = 1.0
    votes: int = 1  # lights that must prove a node empty for the hull
    use_boundary: bool = True
    use_start_gradient: bool = True


class _Step:
    """One level's rays in the grid frame, ready for the kernels."""

    def __init__(self, state: LevelSet, scene: Scene, rays: Supervision, config: FitConfig):
        grid = state.grid()
        n = len(rays.pixels)
        self.state, self.rays, self.config = state, rays, config
        self.eye, self.lights = to_grid(grid, scene.eye), lights_to_grid(grid, scene.lights)
        self.ground_t = np.where(np.isfinite(rays.ground_t), rays.ground_t / state.spacing, 1e9)
        self.width = float(scene.pixel_angle)
        self.hit, self.part_t, self.part_f = np.empty(n), np.empty(n), np.empty(n)
        self.light_g = PerPart(np.zeros((len(self.lights), 4)) for _ in range(thread_count()))
        self.batch = (np.empty((config.rays, 2), np.int64), np.empty(config.rays), np.empty(config.rays))
        self.mask_confidence = np.float32(config.mask_weight) * rays.mask_confidence
        self.normal_confidence = np.float32(config.normal_weight) * rays.normal_confidence

    def __call__(self, iteration: int, sharpness: float) -> dict[str, float]:
        """Find the surface, shoot the rays, leave their gradients in the level set; the mean errors by name."""
        state, rays, config, n = self.state, self.rays, self.config, len(self.rays.pixels)
        ends = (self.hit, self.part_t, self.part_f)
        run(kernels.camera_pass, n, state.phi, self.eye, rays.directions, self.ground_t, self.width, *ends)
        grad = (state.phi, state.g, state.c)
        view = (self.eye, rays.directions, self.ground_t, self.width, *ends)
        setting = (config.seed, iteration, config.use_boundary, config.use_start_gradient)
        tables, (drawn, weights, misses) = (rays.error, rays.wrong), self.batch
        run(kernels.draw_rays, config.rays, rays.confidence, *tables, *setting[:2], drawn, weights)
        shadow = run(
            kernels.shadow_pass,
            config.rays,
            *(*grad, self.light_g, BAND, sharpness, view, self.lights, rays.label, self.batch, setting),
        )
        kernels.record(drawn, weights, misses, *tables)
        n_mask = int(config.rays * config.mask_share)
        mask = run(
            kernels.mask_pass, n_mask, *grad, BAND, sharpness, view[:3], rays.mask, self.mask_confidence, setting[:2]
        )
        normal_view = (self.eye, rays.directions, self.hit)
        normal = run(kernels.normal_pass, n, *grad, BAND, normal_view, rays.normals, self.normal_confidence)
        return {
            name: sum(p[0] for p in parts) / max(sum(p[1] for p in parts), 1e-9)
            for name, parts in (("shadow", shadow), ("mask", mask), ("normal", normal))
        }


def _between(ends: tuple[float, float], share: float) -> float:
    """Geometric interpolation."""
    return ends[0] * (ends[1] / ends[0]) ** share


def fit_level(
    state: LevelSet,
    scene: Scene,
    rays: Supervision,
    level: Level,
    config: FitConfig,
    start: int,
    first_iteration: int,
    on_iteration: Callable[[int, dict[str, float]], None],
) -> SdfGrid:
    """One stage: state after iterations start .. level.iterations - 1, each an independent batch of rays.

    Args:
        first_iteration: of this level in the whole run; with the seed it decides the rays, so any step can be repeated.
        on_iteration: called after each with its number and errors.
    """
    step = _Step(state, scene, rays, config)
    for i in range(start, level.iterations):
        share = i / max(1, level.iterations - 1)
        losses = step(first_iteration + i, _between(config.sharpness, share))
        passes = max(1, round(level.blur * (1 - share) + share))
        state.step(passes, _between(level.rate, share), level.shrink, config.curvature)
        if (i + 1) % REDISTANCE_EVERY == 0 or i + 1 == level.iterations:
            state.redistance()
        on_iteration(i, losses)
    return state.grid()


__all__ = ["FitConfig", "Fields", "Level", "fit_level", "load_fields", "save_fields", "resampled"]
