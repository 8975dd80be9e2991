"""One iteration of the solver: rays are drawn, and each operator of the surface gives its errors and its gradient.

The operators are what a backend implements: fused kernels on the CPU (kernel_operators.py), or plain torch on any
device (torch_operators.py). Everything else of a solve is there once.
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
    """What rays see of a surface, and how the surface and the lights should change: value and gradient in one go.

    Gradients are added on the surface, over NeuS s and so in voxels; its step uses them up. `iteration` is of the whole
    solve: with the seed it decides every random number. `sharpness` is NeuS s per voxel.
    """

    def find_surface(self) -> None:
        """Where each pixel's ray meets the surface as it now is: the other operators start there."""
        ...

    def shadow(self, rays: DrawnRays, iteration: int, sharpness: float) -> Sums:
        """Transmittance from each ray's pixel to its light against the label; fills `misses`."""
        ...

    def mask(self, count: int, iteration: int, sharpness: float) -> Sums:
        """Transmittance from the camera to the ground along so many pixels' rays, against the object mask."""
        ...

    def normal(self) -> Sums:
        """The SDF's gradient where pixels' rays meet the surface, against the pixels' normals: squared distances."""
        ...

    def light_gradient(self) -> Float[np.ndarray, "photos 4"]:
        """The gradient of the shadow rays since the last call by each light's homogeneous x, y, z (grid frame), and the
        sum of its sizes over rays."""
        ...

    def move_lights(self, lights: Float[np.ndarray, "photos 4"]) -> None:
        """Set the lights of all further rays; homogeneous, grid frame."""
        ...


def rays_per_iteration(config: FitConfig, pixels: int) -> int:
    """Shadow rays per iteration for so many supervised pixels."""
    return min(config.rays, max(FEWEST_RAYS, int(config.rays_per_pixel * pixels)))


class RayPasses:
    """Draws the rays of an iteration, applies the operators, and keeps the running table of each ray's error."""

    def __init__(self, operators: RayOperators, rays: Supervision, config: FitConfig):
        self.operators, self.rays, self.config = operators, rays, config
        self.n_rays = rays_per_iteration(config, len(rays.pixels))
        n = self.n_rays
        self.drawn = DrawnRays(np.empty((n, 2), np.int64), np.empty(n), np.empty(n))

    def __call__(self, iteration: int, sharpness: float) -> dict[str, float]:
        """Find the surface, shoot the rays, leave their gradients on it; the mean errors by name.

        Args:
            iteration: of the whole solve; with the seed it decides which rays are shot.
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
        """Undo what the last call left in the running tables and for the lights where it is not finite; return the
        photos whose shadow rays gave such values."""
        self.operators.light_gradient()
        photo, pixel = self.drawn.places[~np.isfinite(self.drawn.misses)].T
        self.rays.error[photo, pixel] = 1.0
        self.rays.wrong[photo, pixel] = 0
        return np.unique(photo).tolist()
