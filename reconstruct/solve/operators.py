"""One iteration of the solver: draw rays, and compute the errors and gradients of each operator on the surface.

A backend implements the operators: fused kernels on the CPU (kernel_operators.py), or plain torch on any device
(torch_operators.py). Both backends share all other code of a solve.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int

from reconstruct.config import FitConfig
from reconstruct.labels.supervision import Supervision
from reconstruct.sdf import kernels
from reconstruct.sdf.rays import run

FEWEST_RAYS = 20_000  # per iteration: averages over fewer are too rough to step on
Sums = tuple[float, float]  # of weight * error over rays, and of the weights


@dataclass(frozen=True)
class DrawnRays:
    """Shadow rays of one iteration, on the host."""

    places: Int[np.ndarray, "rays 2"]  # photo and pixel, places in the Supervision
    weights: Float[np.ndarray, " rays"]
    misses: Float[np.ndarray, " rays"]  # |T - label|, filled by the shadow operator; -1: the pixel shows no surface


@runtime_checkable
class RayOperators(Protocol):
    """Losses of rays, and their gradients with respect to the surface and the lights, in one pass.

    Gradients are accumulated on the surface, divided by NeuS s and so in voxels, until its next step. `iteration` is of
    the whole solve: with the seed it determines every random number. `sharpness` is NeuS s per voxel.
    """

    def find_surface(self) -> None:
        """Find where each pixel's ray meets the current surface: the other operators start there."""
        ...

    def shadow(self, rays: DrawnRays, iteration: int, sharpness: float) -> Sums:
        """Compare the transmittance from each ray's pixel to its light with the label; fill `misses`."""
        ...

    def mask(self, count: int, iteration: int, sharpness: float) -> Sums:
        """Compare the transmittance from camera to ground, along `count` pixels' rays, with the object mask."""
        ...

    def normal(self) -> Sums:
        """Compare the SDF's gradient where pixel rays meet the surface with the pixels' normals: squared distances."""
        ...

    def light_gradient(self) -> Float[np.ndarray, "photos 4"]:
        """Return the gradient of the shadow rays since the last call, and the sum of its magnitudes over rays.

        The gradient is with respect to each light's homogeneous x, y, z, grid frame.
        """
        ...

    def move_lights(self, lights: Float[np.ndarray, "photos 4"]) -> None:
        """Set the lights of all further rays; homogeneous, grid frame."""
        ...


def rays_per_iteration(config: FitConfig, pixels: int) -> int:
    """Return the number of shadow rays per iteration for a number of supervised pixels."""
    return min(config.rays, max(FEWEST_RAYS, int(config.rays_per_pixel * pixels)))


class RayPasses:
    """Draw the rays of an iteration, apply the operators, and update the running table of each ray's error."""

    def __init__(self, operators: RayOperators, rays: Supervision, config: FitConfig):
        self.operators, self.rays, self.config = operators, rays, config
        self.n_rays = rays_per_iteration(config, len(rays.pixels))
        n = self.n_rays
        self.drawn = DrawnRays(np.empty((n, 2), np.int64), np.empty(n), np.empty(n))

    def __call__(self, iteration: int, sharpness: float) -> dict[str, float]:
        """Find the surface, cast the rays, accumulate their gradients on it, and return the mean errors by name.

        Args:
            iteration: of the whole solve; with the seed it determines the rays.
            sharpness: NeuS s per voxel.
        """
        operators, rays, drawn = self.operators, self.rays, self.drawn
        operators.find_surface()
        tables = (rays.error, rays.wrong)
        chance = (self.config.seed, iteration)
        run(kernels.draw_rays, self.n_rays, rays.confidence, *tables, *chance, drawn.places, drawn.weights)
        shadow = operators.shadow(drawn, iteration, sharpness)
        kernels.record(drawn.places, drawn.weights, drawn.misses, *tables)
        mask = operators.mask(int(self.n_rays * self.config.mask_share), iteration, sharpness)
        sums = {"shadow": shadow, "mask": mask, "normal": operators.normal()}
        return {name: total / max(weight, 1e-9) for name, (total, weight) in sums.items()}

    def forget(self) -> list[int]:
        """Undo the last call's non-finite changes to the running tables, and its light gradient.

        Returns:
            The photos whose shadow rays gave non-finite values.
        """
        self.operators.light_gradient()
        photo, pixel = self.drawn.places[~np.isfinite(self.drawn.misses)].T
        self.rays.error[photo, pixel] = 1.0
        self.rays.wrong[photo, pixel] = 0
        return np.unique(photo).tolist()
