"""Everything that is trained: the field, its material, and how sharp its surface is."""

import torch
from torch import nn

from reconstruct.grid_field import GridField
from reconstruct.hash_field import HashField
from reconstruct.neural import Materials, NeuralField, Sharpness
from reconstruct.train_config import TrainConfig


class Model(nn.Module):
    """Everything that is trained: field, material, sharpness."""

    def __init__(self, config: TrainConfig, ground: float):
        """As training begins.

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
    """The field of config.field: a ball in the unit frame; the network as the paper's, the others with the ground."""
    if config.field == "grid":
        return GridField(config.grid_nodes, config.bound, config.radius, ground, generator)
    if config.field == "hash":
        return HashField(config.hash_levels, config.bound, config.radius, ground, generator)
    return NeuralField(config.network, config.radius, generator)
