"""The interface of all SDF fields, and functions shared by the trainable ones.

A trainable SDF grid: the default field's representation, with the same rays and losses as the networks.

A field of multi-resolution hash features and a small MLP [Instant-NGP], in plain torch, for any device.

The paper's networks: the SDF (8 x 256), the material, and the trained sharpness.
"""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol, runtime_checkable

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from reconstruct.appearance.brdf import LOBES, lobe_values
from reconstruct.torch_sdf.march import central_differences

SOFTPLUS_BETA = 100.0  # of the SDF's activations and of the material's output [ShadowNeuS, supplement]
INITIAL_ALBEDO = 0.5  # below zero, a channel would have no gradient through the Softplus
SHARPEST, BLUNTEST = 1e6, 1e-6  # limits of NeuS s
INITIAL_LOG_SHARPNESS = 0.3  # times ten: s = e^3 = 20 at the start (as in NeuS)
CHANNELS = 4  # of the material's own grid
COARSER = 2  # nodes of the SDF per node of the material's grid: colour is read through an MLP
PRIMES = (1, 2654435761, 805459861)  # of the spatial hash [Instant-NGP, eq. 4]
INITIAL_FEATURE = 1e-4  # bound of the initial features, so that the field begins as its ball [Instant-NGP]


@dataclass(frozen=True)
class Network:
    """Sizes of the SDF and material networks; the defaults are the paper's."""

    width: int = 256
    depth: int = 8  # hidden layers
    skip: int = 4  # the layer that gets the input again; beyond `depth`: none
    frequencies: int = 6
    features: int = 256
    material_width: int = 256
    material_depth: int = 4


class WeightNormLinear(nn.Module):
    """A linear layer with weight normalisation, w = g v / |v|, in plain operations that every device supports."""

    def __init__(self, weight: Float[Tensor, "outputs inputs"], bias: Float[Tensor, " outputs"]):
        super().__init__()
        self.direction = nn.Parameter(weight)
        self.length = nn.Parameter(torch.linalg.vector_norm(weight, dim=1, keepdim=True))
        self.bias = nn.Parameter(bias)

    def forward(self, x: Float[Tensor, "n inputs"]) -> Float[Tensor, "n outputs"]:
        """Return x w^T + b."""
        norm = torch.linalg.vector_norm(self.direction, dim=1, keepdim=True)
        return F.linear(x, self.direction * (self.length / norm), self.bias)


def encode(points: Float[Tensor, "n 3"], frequencies: int) -> Float[Tensor, "n channels"]:
    """Return the positional encoding with identity: x, sin(2^k x), cos(2^k x) for k < frequencies."""
    scaled = (points[:, None] * 2.0 ** torch.arange(frequencies, device=points.device)[:, None]).flatten(1)
    return torch.cat([points, scaled.sin(), scaled.cos()], 1)


class NeuralField(nn.Module):
    """An MLP that regresses SDF and features, and begins as a ball [ShadowNeuS, supplement; NeuS, IDR].

    Points are in the trainer's unit frame. The last layer gives the SDF first, then the features.
    """

    def __init__(self, network: Network, radius: float, generator: torch.Generator):
        super().__init__()
        self.network = network
        channels = 3 + 6 * network.frequencies
        widths = [channels, *[network.width] * network.depth, 1 + network.features]
        layers = []
        for place in range(len(widths) - 1):
            outputs = widths[place + 1] - (channels if place + 1 == network.skip else 0)
            weight = _geometric(place, (outputs, widths[place]), network, channels, generator)
            is_last = place == len(widths) - 2
            layers.append(WeightNormLinear(weight, torch.full((outputs,), -radius if is_last else 0.0)))
        self.layers = nn.ModuleList(layers)

    def sdf(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """See SdfField."""
        return self._outputs(points)[:, 0]

    def gradient(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """See SdfField: exact, by differentiation of the network."""
        wanted = torch.is_grad_enabled()
        with torch.enable_grad():
            at = points if points.requires_grad else points.detach().requires_grad_()
            return torch.autograd.grad(self.sdf(at).sum(), at, create_graph=wanted)[0]

    def features(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n features"]:
        """See SdfField."""
        return self._outputs(points)[:, 1:]

    def _outputs(self, points: Tensor) -> Tensor:
        given = encode(points, self.network.frequencies)
        x = given
        for place, layer in enumerate(self.layers):
            if place == self.network.skip:
                x = torch.cat([x, given], 1) / math.sqrt(2)
            x = layer(x)
            if place < len(self.layers) - 1:
                x = F.softplus(x, beta=SOFTPLUS_BETA)
        return x


def _geometric(
    place: int, shape: tuple[int, int], network: Network, channels: int, generator: torch.Generator
) -> Float[Tensor, "outputs inputs"]:
    """Return initial weights with which the network is the SDF of a ball [IDR]; sines and cosines have weight 0."""
    outputs, inputs = shape
    weight = torch.randn(outputs, inputs, generator=generator)
    if place == network.depth:
        return math.sqrt(math.pi / inputs) + 1e-4 * weight
    weight = weight * math.sqrt(2 / outputs)
    if place == 0:
        weight[:, 3:] = 0
    elif place == network.skip:
        weight[:, inputs - channels + 3 :] = 0
    return weight


class Sharpness(nn.Module):
    """The trained s of NeuS in Phi(x) = sigmoid(s x): s = exp(10 v), 1 / length of the unit frame."""

    def __init__(self):
        super().__init__()
        self.value = nn.Parameter(torch.tensor(INITIAL_LOG_SHARPNESS))

    def forward(self) -> Float[Tensor, ""]:
        """Return s."""
        return (10 * self.value).exp().clamp(BLUNTEST, SHARPEST)


class Materials(nn.Module):
    """Networks for albedo (3) and the spherical Gaussians' coefficients (9 x 3), given point, normal and features."""

    def __init__(self, features: int, network: Network, generator: torch.Generator):
        super().__init__()
        sizes = [6 + features, *[network.material_width] * network.material_depth]
        self.diffuse = _perceptron([*sizes, 3], generator, INITIAL_ALBEDO)
        self.specular = _perceptron([*sizes, 3 * LOBES], generator, 0.0)

    def forward(
        self, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], features: Float[Tensor, "n features"]
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n lobes 3"]]:
        """Return albedo and coefficients, linear, not negative."""
        known = torch.cat([points, normals, features], 1)
        albedo = F.softplus(self.diffuse(known), beta=SOFTPLUS_BETA)
        coefficients = F.softplus(self.specular(known), beta=SOFTPLUS_BETA)
        return albedo, coefficients.reshape(-1, LOBES, 3)


def _perceptron(widths: list[int], generator: torch.Generator, level: float) -> nn.Sequential:
    """Make linear layers with ReLU between; weights are uniform in +-1 / sqrt(inputs), outputs near `level`."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        reach = 1 / math.sqrt(inputs)
        weight = (2 * torch.rand(outputs, inputs, generator=generator) - 1) * reach
        bias = (2 * torch.rand(outputs, generator=generator) - 1) * reach
        is_last = len(layers) == 2 * (len(widths) - 2)
        layers += [WeightNormLinear(weight, bias + level if is_last else bias), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def specular(
    coefficients: Float[Tensor, "n lobes 3"],
    normals: Float[Tensor, "n 3"],
    towards: Float[Tensor, "n 3"],
    directions: Float[Tensor, "n 3"],
) -> Float[Tensor, "n 3"]:
    """Return rho_s = y^T D(h, n), h = (l - v) / |l - v|, with the plain lobes D.

    Source: [ShadowNeuS, "Decomposing incoming radiance"].

    Args:
        coefficients: y.
        normals: unit.
        towards: unit vectors l to the light.
        directions: unit rays v from the camera.
    """
    basis = lobe_values(normals, F.normalize(towards - directions, dim=-1))
    return (coefficients * basis[..., None]).sum(1)


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
