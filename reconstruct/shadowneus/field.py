"""The interface of all SDF fields, and functions shared by the trainable ones."""

from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor


@runtime_checkable
class SdfField(Protocol):
    """A signed distance function, negative inside, in the frame and length unit of its arguments."""

    def sdf(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """Return the signed distance at points."""
        ...

    def gradient(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Return the SDF's gradient at points, outward, not normalised; differentiable where gradients are enabled."""
        ...

    def features(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n features"]:
        """Return features at points, input of the material network; (n, 0) if the field has none."""
        ...


def cell_corners(place: Float[Tensor, "n 3"], nodes: int) -> tuple[Int[Tensor, "n 8 3"], Float[Tensor, "n 8"]]:
    """Return the eight nodes around each place on a grid of nodes^3, and their trilinear weights.

    Plain gathers are used instead of grid_sample, which has no second derivative and no three-dimensional form on MPS.

    Args:
        place: in node coordinates; clamped to the grid.
    """
    inside = place.clamp(0, nodes - 1)
    low = inside.detach().floor().clamp(max=nodes - 2)
    share = (inside - low)[:, None]
    bits = torch.tensor([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)], device=place.device)
    parts = torch.where(bits.bool(), share, 1 - share)
    return low.long()[:, None] + bits, parts[..., 0] * parts[..., 1] * parts[..., 2]


def gathered(
    table: Float[Tensor, "rows channels"], rows: Int[Tensor, "n 8"], weights: Float[Tensor, "n 8"]
) -> Float[Tensor, "n channels"]:
    """Return weighted sums of eight table rows per point."""
    return (table[rows] * weights[..., None]).sum(1)


def ball_on_ground(points: Float[Tensor, "n 3"], radius: float, ground: float) -> Float[Tensor, " n"]:
    """Return the SDF of a ball about the origin united with the ground below z = ground, the fields' initial shape."""
    return torch.minimum(torch.linalg.vector_norm(points, dim=-1) - radius, points[:, 2] - ground)
