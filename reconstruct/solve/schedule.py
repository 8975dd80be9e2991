"""The course of a level: shadow rays that never train say when it gains no more, and which surface was best."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from reconstruct.labels.supervision import Supervision
from reconstruct.scene import Scene
from reconstruct.sdf import kernels
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.rays import find_surface, visibility

BLOCK = 8  # px: neighbours of a held-out pixel would tell its label
SHARE = 0.04  # of the blocks of every photo
SHARPNESS = 8.0  # NeuS s per voxel: a shadow edge within half a voxel counts as met
REST = 10  # iterations between two looks at the held-out rays
PATIENCE = 3  # looks without GAIN after which a level only cools down
GAIN = 0.02  # of the best error so far: less is noise
COOL_DOWN = 50  # iterations in which rate and sharpness still reach their last values
SPARE = 1.25  # of the best error: smoother normals cost a few edge rays; beyond, the best surface is taken back


@dataclass(frozen=True)
class Watched:
    """Labels that no gradient has seen: photo and pixel (places in the Supervision) of each, and the pixels' rays."""

    photo: Int[np.ndarray, " rays"]
    pixel: Int[np.ndarray, " rays"]
    label: Float[np.ndarray, " rays"]
    weight: Float[np.ndarray, " rays"]
    directions: Float[Tensor, "pixels 3"]  # world
    ground_t: Float[Tensor, " pixels"]  # world length

    def error(self, grid: SdfGrid, scene: Scene) -> float:
        """Weighted mean |T - label| under the scene's lights; 0 where nothing is held out."""
        if not len(self.photo):
            return 0.0
        return float((self.weight * self.errors(grid, scene)).sum() / self.weight.sum())

    def errors(self, grid: SdfGrid, scene: Scene) -> Float[np.ndarray, " rays"]:
        """|T - label| of every ray under the scene's lights."""
        hit = find_surface(grid, scene.eye.expand_as(self.directions).contiguous(), self.directions)
        points = scene.eye + torch.minimum(hit, self.ground_t)[:, None] * self.directions
        starts, lights = points[torch.from_numpy(self.pixel)], scene.lights[torch.from_numpy(self.photo)]
        seen = visibility(grid, starts.contiguous(), lights.contiguous(), SHARPNESS / grid.spacing)
        return np.abs(seen.numpy() - self.label)


def watch(rays: Supervision, width: int, seed: int) -> tuple[Supervision, Watched]:
    """The same rays without a share of blocks of pixels, drawn for every photo anew, and what was taken out.

    Pixels on an outline, which mix two surfaces, stay out of both: their label belongs to neither.

    Args:
        width: of the picture, px.
    """
    n_photos = len(rays.confidence)
    row, column = np.divmod(rays.pixels, width)
    _, block = np.unique((row // BLOCK) * width + column // BLOCK, return_inverse=True)
    drawn = np.random.default_rng(seed).random((n_photos, int(block.max(initial=0)) + 1)) < SHARE
    out = drawn[:, block]
    photo, pixel = np.nonzero(out & (rays.role != kernels.EDGE) & (rays.confidence > kernels.NO_WEIGHT))
    t = torch.from_numpy(rays.ground_t).float()
    held = Watched(
        photo,
        pixel,
        rays.label[photo, pixel],
        rays.confidence[photo, pixel],
        torch.from_numpy(rays.directions).float(),
        torch.where(t.isfinite(), t, torch.full_like(t, 1e6)),
    )
    return replace(rays, confidence=np.where(out, np.float32(0), rays.confidence)), held


@dataclass(frozen=True)
class Course:
    """What the held-out rays said in a level so far, and the best surface they saw."""

    errors: tuple[float, ...] = ()  # one for every REST iterations
    best: SdfGrid | None = None

    def after(self, error: float, surface: SdfGrid) -> "Course":
        """The course with one more look."""
        is_best = error <= min(self.errors, default=np.inf)
        return Course((*self.errors, error), surface if is_best else self.best)

    def chosen(self, last: SdfGrid) -> SdfGrid:
        """The surface a level ends in: the last one, unless an earlier one explained the held-out rays far better."""
        is_spoilt = bool(self.errors) and self.errors[-1] > SPARE * min(self.errors)
        return self.best if is_spoilt and self.best is not None else last

    def share(self, iteration: int, iterations: int) -> float:
        """How far along its schedule an iteration is, 0 to 1; beyond 1, the level is over.

        As planned, until the held-out rays gain no more: then the rest of the schedule is run in COOL_DOWN iterations.
        """
        last = max(1, iterations - 1)
        stalled = self._stalled()
        if stalled is None or stalled + COOL_DOWN >= iterations or iteration < stalled:
            return iteration / last
        done = (stalled - 1) / last
        return done + (1 - done) * (iteration - stalled + 1) / COOL_DOWN

    def _stalled(self) -> int | None:
        """The number of iterations after which the held-out rays had stopped gaining."""
        for looks in range(PATIENCE + 1, len(self.errors) + 1):
            if min(self.errors[looks - PATIENCE : looks]) > (1 - GAIN) * min(self.errors[: looks - PATIENCE]):
                return looks * REST
        return None
