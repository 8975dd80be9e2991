"""Places that light arrives at, and how much of a light each sees: rays that pass the object by are not marched."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.rays import visibility
from reconstruct.sdf.shadow_rays import RAYS_PER_BATCH, SHARPNESS_PER_VOXEL


@dataclass(frozen=True)
class Receivers:
    """Places on surfaces, world."""

    grid: SdfGrid
    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]
    starts: Float[Tensor, "n 3"]  # of shadow rays

    def seen(self, lights: Float[Tensor, "n 4"], wanted: Bool[Tensor, "n"]) -> Float[Tensor, "n"]:
        """The share of each place's own homogeneous light that reaches it; 0 where it is not wanted."""
        out = torch.zeros(len(self.points))
        out[wanted] = self._marched(self.starts[wanted], lights[wanted])
        return out

    def sees_all(
        self, towards: Float[Tensor, "n 3"], distance: Float[Tensor, "n 1"], sine: Float[Tensor, "n 1"]
    ) -> Bool[Tensor, "n"]:
        """Whether each place surely faces all of a round lamp, and the object hides none of it.

        Args:
            towards, distance: to its middle.
            sine: of half the angle that it fills.
        """
        tangent = (sine / (1 - sine * sine).sqrt())[:, 0]
        faces = (self.normals * towards).sum(-1) > sine[:, 0]
        return faces & ~self.grid.ball.may_hide(self.starts, towards, tangent, distance[:, 0])

    def from_afar(self, directions: Float[Tensor, "lights 3"]) -> Float[Tensor, "lights n"]:
        """max(n . w, 0) times the share of lights at infinity that reaches each place.

        Args:
            directions: unit, towards the lights.
        """
        out = (directions @ self.normals.T).clamp_(min=0)
        for cosine, direction in zip(out, directions, strict=True):
            place = torch.nonzero(self.grid.ball.may_hide(self.starts, direction) & (cosine > 0))[:, 0]
            light = torch.cat([direction, torch.zeros(1)])
            cosine[place] *= self._marched(self.starts[place], light.expand(len(place), 4))
        return out

    def _marched(self, starts: Float[Tensor, "m 3"], lights: Float[Tensor, "m 4"]) -> Float[Tensor, "m"]:
        some = zip(starts.split(RAYS_PER_BATCH), lights.split(RAYS_PER_BATCH), strict=True)
        return torch.cat([visibility(self.grid, s, k, SHARPNESS_PER_VOXEL / self.grid.spacing) for s, k in some])
