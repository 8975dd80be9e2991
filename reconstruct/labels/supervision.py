"""The supervised pixels, flattened for the kernels, with a running count of each ray's contradictions."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from torch import Tensor

from reconstruct.labels.labels import Labels
from reconstruct.scene import Scene, ground_points
from reconstruct.sdf import kernels
from reconstruct.sdf.normal_fusion import NormalRays

DILATE = 7  # px: ground beside object and shadow is supervised too
DARK_ENOUGH = 0.5  # visibility below which a pixel counts as in shadow
NEARLY_ALL = 0.9  # of a pixel: it shows nothing else
SURE_ENOUGH = 0.3  # confidence from which that counts


@dataclass(frozen=True)
class Supervision:
    """Pixels p with their rays (world frame, or the surface's) and labels; photos k. float32 unless said."""

    pixels: np.ndarray  # (p,) flat indices into the picture
    directions: np.ndarray  # (p, 3) float64 unit rays
    ground_t: np.ndarray  # (p,) float64 world length to the ground, inf above the horizon
    label: np.ndarray  # (k, p) visibility
    confidence: np.ndarray  # (k, p)
    role: np.ndarray  # (p,) uint8 EDGE, GROUND or OBJECT of the kernels
    mask: np.ndarray  # (p,)
    mask_confidence: np.ndarray  # (p,)
    normals: np.ndarray  # (p, 3)
    normal_confidence: np.ndarray  # (p,)
    wrong: np.ndarray  # (k, p) uint8 looks in a row in which a ray contradicted its label, changed by the solver


def supervise(scene: Scene, labels: Labels) -> Supervision:
    """Select the pixels to supervise: the object, ground that is ever in shadow, and a rim around both."""
    dark = ((labels.visibility < DARK_ENOUGH) & (labels.confidence > SURE_ENOUGH)).any(0)
    wanted = (dark | (labels.mask > 0.02)).numpy().astype(np.uint8)
    pixels = np.flatnonzero(cv2.dilate(wanted, np.ones((DILATE, DILATE), np.uint8)))
    ground = ground_points(scene).reshape(-1, 3)[pixels]
    t = torch.linalg.vector_norm(ground - scene.eye, dim=-1).double().numpy()

    def pick(image: Tensor, leading: int = 0) -> np.ndarray:
        flat = image.flatten(leading, leading + 1)
        return np.ascontiguousarray(flat.index_select(leading, torch.from_numpy(pixels)).float().numpy())

    label = pick(labels.visibility, 1)
    return Supervision(
        pixels=pixels,
        directions=pick(scene.directions).astype(np.float64),
        ground_t=np.where(np.isfinite(t), t, np.inf),
        label=label,
        confidence=pick(labels.confidence, 1),
        role=_role(pick(labels.mask), pick(labels.mask_confidence)),
        mask=pick(labels.mask),
        mask_confidence=pick(labels.mask_confidence),
        normals=pick(labels.normals),
        normal_confidence=pick(labels.normal_confidence),
        wrong=np.zeros(label.shape, np.uint8),
    )


def placed_rays(rays: Supervision, scene: Scene) -> Supervision:
    """Return a scene's rays and normals in the frame of the surface, see reconstruct.views.placed."""
    motion = scene.object_from_world
    if motion is None:
        return rays
    normals = motion.rotate(rays.normals.astype(np.float64)).astype(rays.normals.dtype)
    return replace(rays, directions=np.ascontiguousarray(motion.rotate(rays.directions)), normals=normals)


def normal_rays(scene: Scene, rays: Supervision) -> NormalRays:
    """Return the normals of pixels that surely show the object, and which pixels are at outlines.

    Of shadow pictures alone, none: shadow edges are sharper than normals that are read from which lights reach a pixel.
    With these, the outlines of a chair and of a table had 2 % less in common with the true ones.

    Args:
        scene: placed, see reconstruct.views.
    """
    trust = rays.normal_confidence * (rays.role == kernels.OBJECT) * (scene.rgb is not None)
    directions, to_ground = (torch.from_numpy(x).float() for x in (rays.directions, rays.ground_t))
    return NormalRays(scene.eye, directions, to_ground, rays.normals, trust, rays.role == kernels.EDGE)


def restricted(rays: Supervision, supervised: str) -> Supervision:
    """Keep shadow rays of pixels that surely show object ("foreground") or ground ("background"), or all ("both")."""
    if supervised == "both":
        return rays
    wanted = kernels.OBJECT if supervised == "foreground" else kernels.GROUND
    return replace(rays, confidence=rays.confidence * (rays.role == wanted))


def _role(mask: np.ndarray, confidence: np.ndarray) -> np.ndarray:
    sure = confidence > SURE_ENOUGH
    role = np.full(mask.shape, kernels.EDGE, np.uint8)
    role[sure & (mask < 1 - NEARLY_ALL)] = kernels.GROUND
    role[sure & (mask > NEARLY_ALL)] = kernels.OBJECT
    return role
