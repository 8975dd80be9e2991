"""Labels of each pixel on its own: object or ground, lit or in shadow, and the surface normal."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from reconstruct.labels.ground_test import GroundTest
from reconstruct.labels.photometric_stereo import ObjectLabels
from reconstruct.scene import Scene

LIKE_NEIGHBOURS = 2  # of 8, in a shadow picture: even a line one pixel wide has as many, a wrong pixel rarely has
NEUTRAL_ALBEDO = 0.5  # where only shadows are given, nothing is known of colour


@dataclass(frozen=True)
class Labels:
    """Targets for the solver, on the Scene's pixel grid. A confidence of 0 means "unknown"."""

    visibility: Float[
        Tensor, "photos height width"
    ]  # 1 = the surface seen here sees the light, 0 = in shadow; grey allowed
    confidence: Float[Tensor, "photos height width"]  # in [0, 1]
    mask: Float[Tensor, "height width"]  # object coverage, in [0, 1]
    mask_confidence: Float[Tensor, "height width"]
    normals: Float[Tensor, "height width 3"]  # world, from photometric stereo; 0 where unknown
    normal_confidence: Float[Tensor, "height width"]
    albedo: Float[Tensor, "height width 3"]  # linear, relative to Light.power


def assemble_labels(scene: Scene, ground: GroundTest | None, object_labels: ObjectLabels | None) -> Labels:
    """Combine the ground test, the object's shading and the given shadow pictures into one set of labels.

    Given shadow pictures replace shadow labels from shading; their grey values are kept. Where shading labels the
    object, its confidence is kept, too: it is low at grazing light, where a pixel's shadow depends on its facets.
    Elsewhere their confidence is 1, except at isolated pixels (see `not_isolated`). With shadow pictures alone and no
    mask, the object's position is unknown (confidence 0).

    Args:
        ground: None for a scene of shadow pictures alone.
        object_labels: None while there is no surface yet: the object's pixels then have no labels.
    """
    if ground is None:
        return _from_shadow_pictures(scene)
    confidence = ground.confidence
    visibility = torch.where(confidence > 0, ground.visibility, 0.0)
    height, width = ground.mask.shape
    normals, normal_confidence = torch.zeros(height, width, 3), torch.zeros(height, width)
    albedo = ground.albedo
    if object_labels is not None:
        trusted = object_labels.confidence * ground.mask_confidence  # in the gap at a contact it may be ground
        is_object = trusted > 0
        visibility = torch.where(is_object, object_labels.visibility, visibility)
        confidence = torch.where(is_object, trusted, confidence)
        normals = object_labels.normals
        normal_confidence = object_labels.normal_confidence * ground.mask_confidence
        albedo = torch.where((object_labels.albedo > 0).any(-1, keepdim=True), object_labels.albedo, albedo)
    if scene.shadow is not None:
        visibility, given = scene.shadow, not_isolated(scene.shadow)
        confidence = given if object_labels is None else torch.where(object_labels.confidence > 0, confidence, given)
    return Labels(visibility, confidence, ground.mask, ground.mask_confidence, normals, normal_confidence, albedo)


def _from_shadow_pictures(scene: Scene) -> Labels:
    if scene.shadow is None:
        raise ValueError("labels need a ground test or shadow pictures")
    height, width = scene.shadow.shape[1:]
    has_mask = scene.mask is not None
    return Labels(
        visibility=scene.shadow,
        confidence=not_isolated(scene.shadow),
        mask=torch.ones(height, width) if scene.mask is None else scene.mask,
        mask_confidence=torch.full((height, width), float(has_mask)),
        normals=torch.zeros(height, width, 3),
        normal_confidence=torch.zeros(height, width),
        albedo=torch.full((height, width, 3), NEUTRAL_ALBEDO),
    )


def not_isolated(shadow: Float[Tensor, "photos height width"]) -> Float[Tensor, "photos height width"]:
    """Return 0 for isolated pixels (fewer than LIKE_NEIGHBOURS of 8 neighbours equally lit or dark), else 1.

    A single wrong lit pixel would carve a tunnel through the shadow hull, all the way to its light.
    """
    lit = (shadow > 0.5).float()
    padded = torch.nn.functional.pad(lit[:, None], (1, 1, 1, 1), mode="replicate")
    around = torch.nn.functional.avg_pool2d(padded, 3, stride=1)[:, 0] * 9 - lit
    alike = torch.where(lit > 0, around, 8 - around)
    return (alike > LIKE_NEIGHBOURS - 0.5).float()
