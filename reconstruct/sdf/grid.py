"""A signed distance function on a dense grid of nodes: the default field."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from reconstruct.sdf.ball import Ball, ball_around
from reconstruct.sdf.blocks import Blocks, pack


@dataclass(frozen=True)
class SdfGrid:
    """SDF values at nodes origin + spacing * (i, j, k), world frame and length, negative inside, trilinear between.

    The ground is not in it: it is the plane z = ground_height of the Scene. Outside the box there is only empty space.
    """

    values: Float[Tensor, "nx ny nz"]
    origin: Float[Tensor, "3"]
    spacing: float

    def upper(self) -> Float[Tensor, "3"]:
        """The corner opposite to origin, world."""
        return self.origin + self.spacing * self._last()

    @cached_property
    def blocks(self) -> Blocks:
        """The SDF in voxels as the kernels want it, made once: the values of a grid do not change."""
        return pack(np.ascontiguousarray((self.values / self.spacing).numpy(), dtype=np.float32))

    @cached_property
    def ball(self) -> Ball:
        """Around the object, for rays that pass it by; made once."""
        return ball_around(self.values, self.origin, self.spacing)

    def sdf(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Trilinear SDF at world points; outside the box, the nearest value plus the distance to the box."""
        last = self._last()
        x = (points - self.origin) / self.spacing
        inside = torch.minimum(x.clamp(min=0), last)
        scaled = 2 * inside / last - 1
        sampled = torch.nn.functional.grid_sample(
            self.values[None, None], scaled.flip(-1)[None, None, None], mode="bilinear", align_corners=True
        ).reshape(-1)
        return sampled + self.spacing * torch.linalg.vector_norm(x - inside, dim=-1)

    def gradient(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Central differences of the trilinear SDF over half a node spacing each way; not normalised."""
        step = 0.5 * self.spacing
        offsets = step * torch.eye(3, dtype=points.dtype, device=points.device)
        return torch.stack([(self.sdf(points + o) - self.sdf(points - o)) / (2 * step) for o in offsets], -1)

    def features(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n features"]:
        """Nothing: see reconstruct.shadowneus.field.Field."""
        return points.new_zeros(len(points), 0)

    def _last(self) -> Float[Tensor, "3"]:
        return torch.tensor(self.values.shape, dtype=self.values.dtype, device=self.values.device) - 1
