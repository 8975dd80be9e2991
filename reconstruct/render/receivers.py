"""Visibility of lights at surface points; shadow rays that miss the object's bounds are not marched."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.rays import SHARPNESS_PER_VOXEL, visibility

TURN_HASH = (12.9898, 78.233, 37.719)  # of a place, in voxels: neighbours get unrelated fractions


@dataclass(frozen=True)
class Receivers:
    """Surface points that receive light. World frame."""

    grid: SdfGrid
    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]
    starts: Float[Tensor, "n 3"]  # of shadow rays

    def seen(self, lights: Float[Tensor, "n 4"], wanted: Bool[Tensor, " n"]) -> Float[Tensor, " n"]:
        """Return the visibility of each point's own homogeneous light, in [0, 1]; 0 where not wanted."""
        out = torch.zeros(len(self.points))
        sharpness = SHARPNESS_PER_VOXEL / self.grid.spacing
        out[wanted] = visibility(self.grid, self.starts[wanted], lights[wanted], sharpness)
        return out

    def sees_whole_lamp(
        self, towards: Float[Tensor, "n 3"], distance: Float[Tensor, "n 1"], sine: Float[Tensor, "n 1"]
    ) -> Bool[Tensor, " n"]:
        """Find the points that surely face all of a round lamp with none of it hidden by the object.

        Args:
            towards, distance: unit direction and distance to the lamp's centre.
            sine: of the lamp's angular radius.
        """
        tangent = (sine / (1 - sine * sine).sqrt())[:, 0]
        faces = (self.normals * towards).sum(-1) > sine[:, 0]
        return faces & ~self.grid.ball.may_hide(self.starts, towards, tangent, distance[:, 0])

    def from_afar(self, directions: Float[Tensor, "lights 3"]) -> Float[Tensor, "lights n"]:
        """Return max(n . w, 0) * visibility of directional lights at each point.

        Args:
            directions: unit, towards the lights.
        """
        out = (directions @ self.normals.T).clamp_(min=0)
        for cosine, direction in zip(out, directions, strict=True):
            wanted = self.grid.ball.may_hide(self.starts, direction) & (cosine > 0)
            light = torch.cat([direction, torch.zeros(1)])
            cosine[wanted] *= self.seen(light.expand(len(wanted), 4), wanted)[wanted]
        return out


def disc(samples: int) -> list[tuple[float, float]]:
    """Return evenly spread points of the unit disc: a sunflower spiral, one point per ring of equal area."""
    places = []
    for k in range(samples):
        turn, reach = k * math.pi * (3 - math.sqrt(5)), math.sqrt((k + 0.5) / samples)
        places.append((reach * math.cos(turn), reach * math.sin(turn)))
    return places


def across(
    axis: Float[Tensor, "n 3"], places: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Return two orthonormal vectors perpendicular to each axis, turned by a pseudo-random angle (hash of the place).

    Args:
        axis: unit.
        places: positions in voxels.
    """
    helper = torch.eye(3)[axis.abs().argmin(-1)]
    first = normalize(torch.linalg.cross(axis, helper), dim=-1)
    second = torch.linalg.cross(axis, first)
    turn = 2 * math.pi * ((places @ torch.tensor(TURN_HASH)).sin() * 43758.5453).frac()[:, None]
    return turn.cos() * first + turn.sin() * second, turn.cos() * second - turn.sin() * first
