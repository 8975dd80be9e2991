"""A signed distance function on a dense grid of nodes: the default field."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reconstruct.sdf.blocks import Blocks, overlapping, pack
from reconstruct.sdf.kernels import gradients

REACH_VOXELS = 2.0  # from the surface: beyond, the object absorbs less than 1e-6 of a ray's light


@dataclass(frozen=True)
class Ball:
    """A ball, world."""

    centre: Float[Tensor, "3"]
    radius: float  # -inf: there is none

    def may_hide(
        self,
        places: Float[Tensor, "n 3"],
        towards: Float[Tensor, "*#n 3"],
        tangent: Float[Tensor, " n"] | None = None,
        distance: Float[Tensor, " n"] | None = None,
    ) -> Bool[Tensor, " n"]:
        """Return whether the ball intersects the cone from each place to a round light; if not, the object hides none.

        Args:
            places: world.
            towards: unit directions to the middle of the light, world.
            tangent: of half the cone's angle; by default 0, a ray.
            distance: to the light, world length; infinite by default.
        """
        offset = self.centre - places
        along, square = (offset * towards).sum(-1), (offset * offset).sum(-1)
        reach = self.radius if tangent is None else self.radius + tangent * (along + self.radius).clamp(min=0)
        meets = (square - along * along <= reach * reach) & (along >= -self.radius)
        return meets if distance is None else meets & (along - self.radius <= distance)


@dataclass(frozen=True)
class SdfGrid:
    """SDF values at nodes origin + spacing * (i, j, k), world frame and length, negative inside, trilinear between.

    The grid does not contain the ground, which is the plane z = ground_height of the Scene. Outside its box is empty
    space.
    """

    values: Float[Tensor, "nx ny nz"]
    origin: Float[Tensor, "3"]
    spacing: float

    def upper(self) -> Float[Tensor, "3"]:
        """Return the corner opposite to origin, world."""
        return self.origin + self.spacing * self._last()

    def in_voxels(self) -> Float[np.ndarray, "nx ny nz"]:
        """Return a copy of the values in voxels, float32."""
        return np.ascontiguousarray((self.values / self.spacing).numpy(), np.float32)

    def with_voxels(self, phi: Float[np.ndarray, "nx ny nz"]) -> "SdfGrid":
        """Return the grid of the same box whose values in voxels, float32, are phi."""
        return SdfGrid(torch.from_numpy(phi * np.float32(self.spacing)), self.origin, self.spacing)

    @cached_property
    def blocks(self) -> Blocks:
        """The SDF in voxels, in the format of the kernels of rays; made once, because a grid's values do not change."""
        return overlapping(pack(self.in_voxels()))

    @cached_property
    def ball(self) -> Ball:
        """A ball that contains every point at which the surface absorbs light from a ray; made once."""
        nodes = torch.nonzero(self.values < self.spacing).float()  # the surface lies between two such nodes
        if not len(nodes):
            return Ball(self.origin, -torch.inf)
        middle = (nodes.amax(0) + nodes.amin(0)) / 2
        radius = float((nodes - middle).norm(dim=-1).max())
        return Ball(self.origin + self.spacing * middle, self.spacing * (radius + REACH_VOXELS))

    def sdf(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """Return the trilinear SDF at world points; outside the box, the nearest value plus the distance to the box."""
        last = self._last()
        x = (points - self.origin) / self.spacing
        inside = torch.minimum(x.clamp(min=0), last)
        scaled = 2 * inside / last - 1
        sampled = torch.nn.functional.grid_sample(
            self.values[None, None], scaled.flip(-1)[None, None, None], mode="bilinear", align_corners=True
        ).reshape(-1)
        return sampled + self.spacing * torch.linalg.vector_norm(x - inside, dim=-1)

    def gradient(self, points: Float[Tensor, "n 3"], step: float = 0.5) -> Float[Tensor, "n 3"]:
        """Return the gradient at world points: central differences over step spacings each way; not normalised."""
        places, out = (points.double() - self.origin.double()) / self.spacing, torch.empty_like(points)
        gradients(self.blocks, np.ascontiguousarray(places.numpy()), step, out.numpy(), 0, len(points))
        return out

    def _last(self) -> Float[Tensor, "3"]:
        return torch.tensor(self.values.shape, dtype=self.values.dtype, device=self.values.device) - 1
