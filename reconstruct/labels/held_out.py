"""Shadow rays held out from training: they show when a level stops improving, and which of two surfaces is better."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from reconstruct.labels.labels import Labels
from reconstruct.labels.supervision import Supervision
from reconstruct.scene import Scene
from reconstruct.sdf import kernels
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.rays import first_hits, visibility
from reconstruct.views import Scenes

BLOCK = 8  # px: neighbours of a held-out pixel would give away its label
SHARE = 0.04  # of the blocks of every photo
SHARPNESS = 8.0  # NeuS s per voxel: a shadow edge within half a voxel counts as met
HORIZON = 1e6  # world length, in place of inf: where rays that meet nothing start


@dataclass(frozen=True)
class HeldOut:
    """Held-out labels, which no gradient uses: photo and pixel of each, and the rays of the pixels."""

    photo: Int[np.ndarray, " rays"]
    pixel: Int[np.ndarray, " rays"]  # row of `directions`
    label: Float[np.ndarray, " rays"]  # visibility, 1 = lit
    weight: Float[np.ndarray, " rays"]  # confidence of the label
    directions: Float[Tensor, "pixels 3"]  # world, unit length
    ground_t: Float[Tensor, " pixels"]  # world length to the ground, HORIZON where there is none

    def error(self, grid: SdfGrid, scene: Scene, sharpness: float = SHARPNESS) -> float:
        """Return the weighted mean |T - label| under the scene's lights, in [0, 1]; 0 if nothing is held out."""
        if not len(self.photo):
            return 0.0
        return float((self.weight * self.errors(grid, scene, sharpness)).sum() / self.weight.sum())

    def errors(self, grid: SdfGrid, scene: Scene, sharpness: float = SHARPNESS) -> Float[np.ndarray, " rays"]:
        """Return |T - label| of every ray under the scene's lights, in [0, 1], see `differences`."""
        return np.abs(self.differences(grid, scene, sharpness))

    def differences(self, grid: SdfGrid, scene: Scene, sharpness: float = SHARPNESS) -> Float[np.ndarray, " rays"]:
        """Return T - label of every ray under the scene's lights, in [-1, 1].

        T is the transmittance from the point that the pixel sees to the light, see reconstruct.sdf.rays.visibility.

        Args:
            grid: world frame.
            sharpness: NeuS s per voxel.
        """
        t = first_hits(grid, scene.eye, self.directions, self.ground_t).distance
        points = scene.eye + t[:, None] * self.directions
        starts, lights = points[torch.from_numpy(self.pixel)], scene.lights[torch.from_numpy(self.photo)]
        seen = visibility(grid, starts.contiguous(), lights.contiguous(), sharpness / grid.spacing)
        return seen.numpy() - self.label


@dataclass(frozen=True)
class ValidationRays:
    """The held-out labels of several views; photos are numbered through."""

    parts: tuple[HeldOut, ...]
    first: tuple[int, ...]  # photo of each part

    @property
    def photo(self) -> Int[np.ndarray, " rays"]:
        """Return the photo of each label."""
        return np.concatenate([start + part.photo for start, part in zip(self.first, self.parts, strict=True)])

    @property
    def weight(self) -> Float[np.ndarray, " rays"]:
        """Return the confidence of each label."""
        return np.concatenate([part.weight for part in self.parts])

    def error(self, grid: SdfGrid, scenes: Scenes, sharpness: float = SHARPNESS) -> float:
        """Return the weighted mean |T - label| over all views, see HeldOut.error."""
        weight = self.weight
        if not len(weight):
            return 0.0
        return float((weight * self.errors(grid, scenes, sharpness)).sum() / weight.sum())

    def errors(self, grid: SdfGrid, scenes: Scenes, sharpness: float = SHARPNESS) -> Float[np.ndarray, " rays"]:
        """Return |T - label| of every ray under its scene's lights, see HeldOut.errors."""
        views = zip(self.parts, scenes, strict=True)
        return np.concatenate([part.errors(grid, scene, sharpness) for part, scene in views])


def draw_blocks(
    pixels: Int[np.ndarray, " pixels"],
    width: int,
    photos: int,
    seed: int | tuple[int, int],
    block: int = BLOCK,
    share: float = SHARE,
) -> Bool[np.ndarray, "photos pixels"]:
    """Draw a share of the picture's blocks, anew for every photo; True for the pixels in them.

    The same pixels and seed give the same blocks.

    Args:
        pixels: flat indices into the picture.
        width: of the picture, px.
        block: side of a block, px.
        share: of the blocks of every photo, in [0, 1].
    """
    row, column = np.divmod(pixels, width)
    _, index = np.unique((row // block) * width + column // block, return_inverse=True)
    drawn = np.random.default_rng(seed).random((photos, int(index.max(initial=0)) + 1)) < share
    return drawn[:, index]


def hold_out(
    rays: Supervision, drawn: Bool[np.ndarray, "photos pixels"], with_outline: bool = False
) -> tuple[Supervision, HeldOut]:
    """The rays without the drawn ones (their confidence becomes 0), and those.

    Args:
        drawn: see draw_blocks.
        with_outline: hold out pixels on an outline, too. They mix two surfaces, so their label belongs to neither; but
            where no mask is known every pixel may be one.
    """
    chosen = drawn & (rays.confidence > kernels.NO_WEIGHT)
    photo, pixel = np.nonzero(chosen if with_outline else chosen & (rays.role != kernels.EDGE))
    t = torch.from_numpy(rays.ground_t).float()
    held = HeldOut(
        photo,
        pixel,
        rays.label[photo, pixel],
        rays.confidence[photo, pixel],
        torch.from_numpy(rays.directions).float(),
        torch.where(t.isfinite(), t, torch.full_like(t, HORIZON)),
    )
    return replace(rays, confidence=np.where(drawn, np.float32(0), rays.confidence)), held


def without(labels: Labels, drawn: Bool[np.ndarray, "photos pixels"]) -> Labels:
    """Return the labels with confidence 0 where a ray is held out.

    Args:
        drawn: see draw_blocks, of all pixels of the picture.
    """
    kept = torch.from_numpy(~drawn).reshape(labels.confidence.shape)
    return replace(labels, confidence=labels.confidence * kept)
