"""Shadow rays that no solve has seen: the judge of which of two surfaces is better."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reconstruct.labels.labels import Labels
from reconstruct.scene import Scene, ground_points
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.rays import first_hits, visibility

SHARE = 0.05  # of the rays: some ten thousand of a small scene, whose mean repeats to a per cent
SHARPNESS = 25.0  # NeuS s per voxel, as at the end of a solve


@dataclass(frozen=True)
class HeldOut:
    """Some rays' labels, kept from the solver."""

    rays: Bool[Tensor, "photos height width"]
    visibility: Float[Tensor, "photos height width"]
    confidence: Float[Tensor, "photos height width"]


def hold_out(labels: Labels, seed: int) -> tuple[Labels, HeldOut]:
    """The labels with SHARE of them taken away (confidence 0), and those. The same seed takes the same rays."""
    drawn = np.random.default_rng(seed).random(labels.visibility.shape, np.float32) < SHARE
    rays = torch.from_numpy(drawn)
    held = HeldOut(rays, labels.visibility, labels.confidence * rays)
    return replace(labels, confidence=labels.confidence * ~rays), held


def unexplained(grid: SdfGrid, scene: Scene, held: HeldOut) -> float:
    """Mean |T - label| of the held-out rays, weighted by confidence; each starts where its pixel sees object or ground.

    inf where no pixel with such a ray sees anything.
    """
    directions = scene.directions.reshape(-1, 3)
    to_ground = (ground_points(scene).reshape(-1, 3) - scene.eye).norm(dim=-1)
    t = first_hits(grid, scene.eye, directions, torch.nan_to_num(to_ground, nan=torch.inf)).distance
    points = scene.eye + t[:, None] * directions
    weight = held.confidence.flatten(1) * torch.isfinite(t)
    photo, pixel = torch.nonzero(weight, as_tuple=True)
    if not len(photo):
        return float("inf")
    seen = visibility(grid, points[pixel], scene.lights[photo].contiguous(), SHARPNESS / grid.spacing)
    weight, label = weight[photo, pixel], held.visibility.flatten(1)[photo, pixel]
    return float((weight * (seen - label).abs()).sum() / weight.sum())
