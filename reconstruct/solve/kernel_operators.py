"""The solver's operators by the fused kernels, on all cores of the CPU."""

import numpy as np
from jaxtyping import Float

from reconstruct.config import FitConfig
from reconstruct.labels.supervision import Supervision
from reconstruct.scene import Scene
from reconstruct.sdf import kernels
from reconstruct.sdf.blocks import overlapping
from reconstruct.sdf.level_set import BAND, LevelSet
from reconstruct.sdf.rays import PerThread, camera_ends, lights_to_grid, run, thread_count, to_grid
from reconstruct.solve.operators import DrawnRays, Sums


class KernelOperators:
    """RayOperators of one level; its rays are kept in the grid frame for the kernels."""

    def __init__(self, surface: LevelSet, scene: Scene, rays: Supervision, config: FitConfig):
        grid = surface.grid()
        n = len(rays.pixels)
        self.surface, self.rays, self.config = surface, rays, config
        self.eye, self.lights = to_grid(grid, scene.eye), lights_to_grid(grid, scene.lights)
        self.ground_t = np.where(np.isfinite(rays.ground_t), rays.ground_t / surface.spacing, 1e9)
        self.width = float(scene.pixel_angle)
        self._field = overlapping(surface.field)
        self.hit, self.part_t, self.part_f = np.full(n, kernels.NEVER), np.full(n, -1.0), np.zeros(n)
        self.light_g = PerThread(np.zeros((len(self.lights), 4)) for _ in range(thread_count()))
        self.normal_confidence = np.float32(config.normal_weight) * rays.normal_confidence
        # Rays of pixels that surely show ground start there, wherever the surface is.
        self._on_surface = np.flatnonzero((rays.role != kernels.GROUND) | (self.normal_confidence > kernels.NO_WEIGHT))
        self._view = rays.directions[self._on_surface], self.ground_t[self._on_surface]

    def find_surface(self) -> None:
        """See RayOperators."""
        own = self._on_surface
        self._field = overlapping(self.surface.field)  # it moves only after all operators
        found = camera_ends(self._field, self.eye, *self._view, self.width)
        self.hit[own], self.part_t[own], self.part_f[own] = found

    def shadow(self, rays: DrawnRays, iteration: int, sharpness: float) -> Sums:
        """See RayOperators."""
        config, given = self.config, self.rays
        ends = (self.hit, self.part_t, self.part_f)
        view = (self.eye, given.directions, self.ground_t, self.width, *ends, given.role)
        batch = (rays.places, rays.weights, rays.misses)
        setting = (config.seed, iteration, config.use_boundary, config.use_start_gradient)
        light = (view, self.lights, given.label, batch, setting)
        return _sums(run(kernels.shadow_pass, len(rays.weights), *self._sinks(), self.light_g, BAND, sharpness, *light))

    def mask(self, rays: DrawnRays, iteration: int, sharpness: float) -> Sums:
        """See RayOperators."""
        view = (self.eye, self.rays.directions, self.ground_t)
        labels = (self.rays.mask, (rays.places[:, 0], rays.weights), (self.config.seed, iteration))
        return _sums(run(kernels.mask_pass, len(rays.weights), *self._sinks(), BAND, sharpness, view, *labels))

    def normal(self) -> Sums:
        """See RayOperators."""
        view = (self.eye, self.rays.directions, self.hit)
        labels = (self.rays.normals, self.normal_confidence)
        return _sums(run(kernels.normal_pass, len(self.hit), *self._sinks(), BAND, view, *labels))

    def light_gradient(self) -> Float[np.ndarray, "photos 4"]:
        """See RayOperators; the cores' parts are added in fixed order."""
        total = np.sum(self.light_g, axis=0)
        for part in self.light_g:
            part[...] = 0
        return total

    def move_lights(self, lights: Float[np.ndarray, "photos 4"]) -> None:
        """See RayOperators."""
        self.lights = np.ascontiguousarray(lights)

    def _sinks(self) -> tuple:
        """Return the surface, and the accumulators of its gradient and of the gradient's magnitude."""
        return self._field, self.surface.g, self.surface.c


def _sums(parts: list[Sums]) -> Sums:
    """Add the sums of all cores' parts, in fixed order."""
    return sum(part[0] for part in parts), sum(part[1] for part in parts)
