"""The normals of shadow pictures alone: read from which lights reach each pixel, on the surface so far."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from reconstruct.labels.labels import Labels
from reconstruct.labels.outline import dilated
from reconstruct.scene import Scene
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.rays import visibility
from reconstruct.shading.normal_fit import normals_of_lit

TRUST = 0.3  # of the confidence of a normal from shading: a cut sphere leaves some degrees open
EDGE_SHARE = 0.25  # of the confidence at the outline, where a pixel mixes two surfaces
LIFT, SHARPNESS = 1.0, 8.0  # voxels above the surface, and NeuS s per voxel, of rays to the lights


def with_lit_normals(
    labels: Labels,
    scene: Scene,
    surface: SdfGrid,
    points: Float[Tensor, "height width 3"],
    normals: Float[Tensor, "height width 3"],
) -> Labels:
    """Return the labels with normals where the surface is seen and the lights that reach a pixel leave few open.

    Args:
        points: world, where each pixel's ray meets the surface.
        normals: the surface's, world; 0 on the ground.
    """
    shown = (labels.mask > 0.5) & (normals != 0).any(-1)
    if not shown.any():
        return labels
    at, above = points[shown], points[shown] + LIFT * surface.spacing * normals[shown]
    towards = torch.stack([normalize(light[:3] - light[3] * at, dim=-1) for light in scene.lights])
    free = [visibility(surface, above, k.expand(len(at), 4), SHARPNESS / surface.spacing) for k in scene.lights]
    lit, known = labels.visibility[:, shown], labels.confidence[:, shown]
    found, sure = normals_of_lit(lit, known, towards, torch.stack(free), scene.directions[shown])
    read, confidence = torch.zeros_like(labels.normals), torch.zeros_like(labels.normal_confidence)
    read[shown], confidence[shown] = found, TRUST * sure
    edge = torch.where(dilated(~shown, 3), EDGE_SHARE, 1.0)
    return replace(labels, normals=read, normal_confidence=confidence * edge)
