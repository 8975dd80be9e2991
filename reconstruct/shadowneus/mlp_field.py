"""The paper's networks: the SDF (8 x 256), the material, and the trained sharpness."""

import math
from dataclasses import dataclass
from itertools import pairwise

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from reconstruct.appearance.brdf import LOBES, lobe_values

SOFTPLUS_BETA = 100.0  # of the SDF's activations and of the material's output [ShadowNeuS, supplement]
INITIAL_ALBEDO = 0.5  # below zero, a channel would have no gradient through the Softplus
SHARPEST, BLUNTEST = 1e6, 1e-6  # limits of NeuS s
INITIAL_LOG_SHARPNESS = 0.3  # times ten: s = e^3 = 20 at the start (as in NeuS)


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
