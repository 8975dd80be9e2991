"""Everything that is trained: the field, its material, and how sharp its surface is."""

import torch
from torch import nn

from reconstruct.shadowneus.config import TrainConfig
from reconstruct.shadowneus.field import ball_on_ground
from reconstruct.shadowneus.grid_field import GridField
from reconstruct.shadowneus.hash_field import HashField
from reconstruct.shadowneus.mlp_field import Materials, NeuralField, Sharpness

START_POINTS, START_RATE = 1024, 3e-3  # of each step onto the ball on the ground, and its learning rate
INNER = 0.6  # of the bounding cube: where every other step's points lie


class Model(nn.Module):
    """Everything that is trained: field, material, sharpness."""

    def __init__(self, config: TrainConfig, ground: float):
        """Create the model in its initial state.

        Args:
            ground: z of the ground in the unit frame.
        """
        super().__init__()
        generator = torch.Generator().manual_seed(config.seed)
        self.field = make_field(config, ground, generator)
        known = self.field.features(torch.zeros(1, 3)).shape[1]
        self.materials = Materials(known, config.network, generator)
        self.sharpness = Sharpness()


def make_field(config: TrainConfig, ground: float, generator: torch.Generator) -> GridField | HashField | NeuralField:
    """Create the field of config.field: grid and hash begin as a ball on the ground, the network as configured."""
    standing = min(config.radius, abs(ground))
    if config.field == "grid":
        return GridField(config.grid_nodes, config.bound, standing, ground, generator)
    if config.field == "hash":
        return HashField(config.hash_levels, config.bound, standing, ground, generator)
    field = NeuralField(config.network, config.radius, generator)
    _fit_to_ball(field, config, standing, ground, generator)
    return field


def _fit_to_ball(
    field: NeuralField, config: TrainConfig, radius: float, ground: float, generator: torch.Generator
) -> None:
    """Fit the network to the SDF of a ball on the ground, in config.start_steps steps without rays.

    The paper's network begins as a ball alone, and learns the ground and the shadows at once. In a brief training the
    ground wins: the object is flattened before its shadows have been learnt, and nothing brings it back.
    """
    optimiser = torch.optim.Adam(field.parameters(), lr=START_RATE)
    for step in range(config.start_steps):
        reach = config.bound * (INNER if step % 2 else 1.0)
        points = reach * (2 * torch.rand(START_POINTS, 3, generator=generator) - 1)
        error = (field.sdf(points) - ball_on_ground(points, radius, ground)).abs().mean()
        optimiser.zero_grad()
        error.backward()
        optimiser.step()
