"""Directions spread evenly: over a disc, and across an axis, turned by an angle that belongs to a place."""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

TURN_HASH = (12.9898, 78.233, 37.719)  # of a place, in voxels: neighbours get unrelated fractions


def disc(samples: int) -> list[tuple[float, float]]:
    """Points spread evenly over the unit disc: a sunflower's spiral, one in each ring of equal area."""
    places = []
    for k in range(samples):
        turn, reach = k * math.pi * (3 - math.sqrt(5)), math.sqrt((k + 0.5) / samples)
        places.append((reach * math.cos(turn), reach * math.sin(turn)))
    return places


def across(
    axis: Float[Tensor, "n 3"], places: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Two unit vectors across each axis and each other, turned by an angle that is a hash of the place.

    Args:
        axis: unit.
        places: in voxels.
    """
    helper = torch.eye(3)[axis.abs().argmin(-1)]
    first = normalize(torch.linalg.cross(axis, helper), dim=-1)
    second = torch.linalg.cross(axis, first)
    turn = 2 * math.pi * ((places @ torch.tensor(TURN_HASH)).sin() * 43758.5453).frac()[:, None]
    return turn.cos() * first + turn.sin() * second, turn.cos() * second - turn.sin() * first
