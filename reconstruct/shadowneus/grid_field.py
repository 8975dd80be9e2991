"""A trainable SDF grid: the default field's representation, with the same rays and losses as the networks."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from reconstruct.shadowneus.field import ball_on_ground, cell_corners, gathered
from reconstruct.torch_sdf.volume import central_differences

CHANNELS = 4  # of the material's own grid
COARSER = 2  # nodes of the SDF per node of the material's grid: colour is read through an MLP


class GridField(nn.Module):
    """SDF values on the nodes of a cube about the origin, trilinear between; outside, plus the distance to the cube."""

    def __init__(self, nodes: int, reach: float, radius: float, ground: float, generator: torch.Generator):
        """Begin as a ball on the ground.

        Args:
            nodes: along each side.
            reach: half of the cube's side, unit frame.
            radius: of the ball.
            ground: z of the ground.
        """
        super().__init__()
        self.nodes, self.reach = nodes, reach
        axis = torch.linspace(-reach, reach, nodes)
        self.values = nn.Parameter(ball_on_ground(torch.cartesian_prod(axis, axis, axis), radius, ground)[:, None])
        rows = (nodes // COARSER) ** 3
        self.material = nn.Parameter(1e-2 * torch.randn(rows, CHANNELS, generator=generator))

    def sdf(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """See SdfField."""
        outside = torch.linalg.vector_norm(points - points.clamp(-self.reach, self.reach), dim=-1)
        return self._read(self.values, self.nodes, points)[:, 0] + outside

    def gradient(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """See SdfField: differences over half a node spacing, as in SdfGrid."""
        return central_differences(self.sdf, points, self.reach / (self.nodes - 1))

    def features(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n features"]:
        """See SdfField."""
        return self._read(self.material, self.nodes // COARSER, points)

    def _read(self, table: Tensor, nodes: int, points: Tensor) -> Tensor:
        index, weights = cell_corners((points / self.reach + 1) * (0.5 * (nodes - 1)), nodes)
        return gathered(table, (index[..., 0] * nodes + index[..., 1]) * nodes + index[..., 2], weights)
