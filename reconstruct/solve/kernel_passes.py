"""One iteration of the solver: camera, shadow, mask and normal rays, and their gradients on the grid."""

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from reconstruct.config import FitConfig
from reconstruct.labels.supervision import Supervision
from reconstruct.scene import Scene
from reconstruct.sdf import kernels
from reconstruct.sdf.level_set import BAND, LevelSet
from reconstruct.sdf.rays import PerPart, lights_to_grid, run, thread_count, to_grid

FEWEST_RAYS = 20_000  # per iteration: averages over fewer are too rough to step on


@runtime_checkable
class RayPasses(Protocol):
    """The four passes of one level: camera, shadow, mask, normal. What a backend of the solver implements."""

    def light_gradient(self) -> Float[np.ndarray, "photos 4"]:
        """What the shadow rays since the last call left for each light: the gradient by its homogeneous x, y, z in the
        grid frame, and the sum of its sizes."""
        ...

    def aim(self, lights: Float[np.ndarray, "photos 4"]) -> None:
        """From now on the lights are there; homogeneous, grid frame."""
        ...

    def __call__(self, iteration: int, sharpness: float) -> dict[str, float]:
        """Find the surface, shoot the rays, leave their gradients in the level set; the mean errors by name.

        Args:
            iteration: of the whole solve; with the seed it decides which rays are shot.
            sharpness: NeuS s per voxel.
        """
        ...

    def settle(self) -> None:
        """Bring the running tables of the Supervision up to date, as a checkpoint needs them."""
        ...

    def forget(self) -> list[int]:
        """Take back what the last call left in the running tables and for the lights where it is no number; the photos
        whose shadow rays gave such values."""
        ...


def rays_per_iteration(config: FitConfig, pixels: int) -> int:
    """Shadow rays per iteration for so many supervised pixels."""
    return min(config.rays, max(FEWEST_RAYS, int(config.rays_per_pixel * pixels)))


class KernelPasses:
    """RayPasses by the fused kernels, on all cores: one level's rays in the grid frame, ready for them."""

    def __init__(self, state: LevelSet, scene: Scene, rays: Supervision, config: FitConfig):
        grid = state.grid()
        n = len(rays.pixels)
        self.state, self.rays, self.config = state, rays, config
        self.eye, self.lights = to_grid(grid, scene.eye), lights_to_grid(grid, scene.lights)
        self.ground_t = np.where(np.isfinite(rays.ground_t), rays.ground_t / state.spacing, 1e9)
        self.width = float(scene.pixel_angle)
        self.hit, self.part_t, self.part_f = np.empty(n), np.empty(n), np.empty(n)
        self.light_g = PerPart(np.zeros((len(self.lights), 4)) for _ in range(thread_count()))
        self.n_rays = rays_per_iteration(config, n)
        self.batch = (np.empty((self.n_rays, 2), np.int64), np.empty(self.n_rays), np.empty(self.n_rays))
        self.mask_confidence = np.float32(config.mask_weight) * rays.mask_confidence
        self.normal_confidence = np.float32(config.normal_weight) * rays.normal_confidence

    def light_gradient(self) -> Float[np.ndarray, "photos 4"]:
        """See RayPasses; the cores' parts are added in fixed order."""
        total = np.sum(self.light_g, axis=0)
        for part in self.light_g:
            part[...] = 0
        return total

    def aim(self, lights: Float[np.ndarray, "photos 4"]) -> None:
        """See RayPasses."""
        self.lights = np.ascontiguousarray(lights)

    def __call__(self, iteration: int, sharpness: float) -> dict[str, float]:
        """Find the surface, shoot the rays, leave their gradients in the level set; the mean errors by name."""
        state, rays, config, n = self.state, self.rays, self.config, len(self.rays.pixels)
        ends = (self.hit, self.part_t, self.part_f)
        run(kernels.camera_pass, n, state.field, self.eye, rays.directions, self.ground_t, self.width, *ends)
        grad = (state.field, state.g, state.c)
        view = (self.eye, rays.directions, self.ground_t, self.width, *ends, rays.role)
        setting = (config.seed, iteration, config.use_boundary, config.use_start_gradient)
        tables, (drawn, weights, misses) = (rays.error, rays.wrong), self.batch
        run(kernels.draw_rays, self.n_rays, rays.confidence, *tables, *setting[:2], drawn, weights)
        shadow = run(
            kernels.shadow_pass,
            self.n_rays,
            *(*grad, self.light_g, BAND, sharpness, view, self.lights, rays.label, self.batch, setting),
        )
        kernels.record(drawn, weights, misses, *tables)
        n_mask = int(self.n_rays * config.mask_share)
        mask = run(
            kernels.mask_pass, n_mask, *grad, BAND, sharpness, view[:3], rays.mask, self.mask_confidence, setting[:2]
        )
        normal_view = (self.eye, rays.directions, self.hit)
        normal = run(kernels.normal_pass, n, *grad, BAND, normal_view, rays.normals, self.normal_confidence)
        return {
            name: sum(p[0] for p in parts) / max(sum(p[1] for p in parts), 1e-9)
            for name, parts in (("shadow", shadow), ("mask", mask), ("normal", normal))
        }

    def forget(self) -> list[int]:
        """See RayPasses."""
        self.light_gradient()
        drawn, _, misses = self.batch
        spoilt = drawn[~np.isfinite(misses)]
        self.rays.error[spoilt[:, 0], spoilt[:, 1]] = 1.0
        self.rays.wrong[spoilt[:, 0], spoilt[:, 1]] = 0
        return np.unique(spoilt[:, 0]).tolist()

    def settle(self) -> None:
        """Nothing to do: the kernels write into the tables themselves."""
