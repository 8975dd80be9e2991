"""A ball around a surface: what passes it by passes the object by, and needs no marching to know it."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

REACH_VOXELS = 2.0  # from the surface: farther away the object takes less than 1e-6 of a ray's light


@dataclass(frozen=True)
class Ball:
    """A ball, world."""

    centre: Float[Tensor, "3"]
    radius: float  # -inf: there is none

    def may_hide(
        self,
        places: Float[Tensor, "n 3"],
        towards: Float[Tensor, "*#n 3"],
        tangent: Float[Tensor, "n"] | None = None,
        distance: Float[Tensor, "n"] | None = None,
    ) -> Bool[Tensor, "n"]:
        """Whether the ball lies in the cone from each place to a round light; False: the object surely does not.

        Args:
            towards: unit, to the middle of the light.
            tangent: of half the cone's angle; a ray unless given.
            distance: to the light; endless unless given.
        """
        offset = self.centre - places
        along, square = (offset * towards).sum(-1), (offset * offset).sum(-1)
        reach = self.radius if tangent is None else self.radius + tangent * (along + self.radius).clamp(min=0)
        meets = (square - along * along <= reach * reach) & (along >= -self.radius)
        return meets if distance is None else meets & (along - self.radius <= distance)


def ball_around(values: Float[Tensor, "nx ny nz"], origin: Float[Tensor, "3"], spacing: float) -> Ball:
    """A ball that holds every place at which the surface of an SdfGrid takes light from a ray."""
    nodes = torch.nonzero(values < spacing).float()  # its surface lies between two such nodes
    if not len(nodes):
        return Ball(origin, -torch.inf)
    middle = (nodes.amax(0) + nodes.amin(0)) / 2
    radius = float((nodes - middle).norm(dim=-1).max())
    return Ball(origin + spacing * middle, spacing * (radius + REACH_VOXELS))
