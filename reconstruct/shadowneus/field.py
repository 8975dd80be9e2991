"""The interface of all SDF fields, and functions shared by the trainable ones.

A trainable SDF grid: the default field's representation, with the same rays and losses as the networks.

A field of multi-resolution hash features and a small MLP [Instant-NGP], in plain torch, for any device.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol, runtime_checkable

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from reconstruct.shadowneus.mlp_field import SOFTPLUS_BETA
from reconstruct.torch_sdf.march import central_differences

CHANNELS = 4  # of the material's own grid
COARSER = 2  # nodes of the SDF per node of the material's grid: colour is read through an MLP
PRIMES = (1, 2654435761, 805459861)  # of the spatial hash [Instant-NGP, eq. 4]
INITIAL_FEATURE = 1e-4  # bound of the initial features, so that the field begins as its ball [Instant-NGP]


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


@dataclass(frozen=True)
class HashLevels:
    """Sizes of a hash field."""

    coarsest: int = 16  # nodes along each side
    finest: int = 256
    levels: int = 8
    rows: int = 2**17  # of each level's table: beyond, nodes share rows
    channels: int = 2
    width: int = 64  # of the two hidden layers
    features: int = 15


class HashField(nn.Module):
    """A ball on the ground, plus an MLP of the place and of interpolated features of every level [Instant-NGP]."""

    def __init__(self, sizes: HashLevels, reach: float, radius: float, ground: float, generator: torch.Generator):
        """Begin as a ball of `radius` about the origin in a cube of side 2 reach, and the ground below z = ground."""
        super().__init__()
        growth = (sizes.finest / sizes.coarsest) ** (1 / max(1, sizes.levels - 1))
        self.nodes = [round(sizes.coarsest * growth**level) for level in range(sizes.levels)]
        self.reach, self.rows, self.start = reach, sizes.rows, (radius, ground)
        lengths = [min(n**3, sizes.rows) for n in self.nodes]
        self.tables = nn.ParameterList(
            nn.Parameter(INITIAL_FEATURE * (2 * torch.rand(n, sizes.channels, generator=generator) - 1))
            for n in lengths
        )
        widths = [3 + sizes.levels * sizes.channels, sizes.width, sizes.width, 1 + sizes.features]
        layers = []
        for inputs, outputs in pairwise(widths):
            layer = nn.Linear(inputs, outputs)
            with torch.no_grad():
                layer.weight.copy_(torch.randn(outputs, inputs, generator=generator) * (1 / inputs) ** 0.5)
                layer.bias.zero_()
            layers.append(layer)
        with torch.no_grad():
            layers[-1].weight[0] *= INITIAL_FEATURE
        self.layers = nn.ModuleList(layers)

    def sdf(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """See SdfField."""
        return self._outputs(points)[:, 0] + ball_on_ground(points, *self.start)

    def gradient(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """See SdfField: differences over half the finest cell, because the features have kinks between cells."""
        return central_differences(self.sdf, points, self.reach / (self.nodes[-1] - 1))

    def features(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n features"]:
        """See SdfField."""
        return self._outputs(points)[:, 1:]

    def _outputs(self, points: Tensor) -> Tensor:
        place = points / self.reach
        known = [place]
        for nodes, table in zip(self.nodes, self.tables, strict=True):
            index, weights = cell_corners((place + 1) * (0.5 * (nodes - 1)), nodes)
            known.append(gathered(table, self._row(index, nodes), weights))
        x = torch.cat(known, 1)
        for layer in self.layers[:-1]:
            x = F.softplus(layer(x), beta=SOFTPLUS_BETA)
        return self.layers[-1](x)

    def _row(self, index: Tensor, nodes: int) -> Tensor:
        if nodes**3 <= self.rows:
            return (index[..., 0] * nodes + index[..., 1]) * nodes + index[..., 2]
        x, y, z = (index[..., axis] * prime for axis, prime in enumerate(PRIMES))
        return (x ^ y ^ z) % self.rows
