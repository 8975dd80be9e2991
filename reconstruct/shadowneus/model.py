"""The trained model: the field, its material, and the sharpness of its surface."""

import torch
from torch import nn

from reconstruct.shadowneus.config import TrainConfig
from reconstruct.shadowneus.field import GridField, HashField, Materials, NeuralField, Sharpness, ball_on_ground

START_POINTS, START_RATE = 1024, 3e-3  # per step of the fit to the ball on the ground, and its learning rate
INNER = 0.6  # of the bounding cube: the points of every other step are in this part


class Model(nn.Module):
    """All trained parts: field, material, sharpness."""

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
    """Create the field of config.field: grid and hash begin as a ball on the ground, the network as configured.

    The paper's network begins as a ball without ground, and learns ground and shadows together. In a short training the
    ground dominates: the object is flattened before its shadows are learnt, and does not recover. So config.start_steps
    steps without rays fit it to the ball on the ground.
    """
    standing = min(config.radius, abs(ground))
    if config.field == "grid":
        return GridField(config.grid_nodes, config.bound, standing, ground, generator)
    if config.field == "hash":
        return HashField(config.hash_levels, config.bound, standing, ground, generator)
    field = NeuralField(config.network, config.radius, generator)
    optimiser = torch.optim.Adam(field.parameters(), lr=START_RATE)
    for step in range(config.start_steps):
        reach = config.bound * (INNER if step % 2 else 1.0)
        points = reach * (2 * torch.rand(START_POINTS, 3, generator=generator) - 1)
        error = (field.sdf(points) - ball_on_ground(points, standing, ground)).abs().mean()
        optimiser.zero_grad()
        error.backward()
        optimiser.step()
    return field
