"""A field of multi-resolution hash features and a small MLP [Instant-NGP], in plain torch, for any device."""

from dataclasses import dataclass
from itertools import pairwise

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from reconstruct.shadowneus.field import ball_on_ground, cell_corners, gathered
from reconstruct.shadowneus.mlp_field import SOFTPLUS_BETA
from reconstruct.torch_sdf.volume import central_differences

PRIMES = (1, 2654435761, 805459861)  # of the spatial hash [Instant-NGP, eq. 4]
INITIAL_FEATURE = 1e-4  # bound of the initial features, so that the field begins as its ball [Instant-NGP]


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
