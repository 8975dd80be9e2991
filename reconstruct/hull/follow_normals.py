"""A surface moved to the integral of the normals that one camera sees."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from reconstruct.hull.normal_integration import MOST_PIXELS
from reconstruct.labels.labels import Labels
from reconstruct.scene import Scene, ground_points
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.rays import find_surface

FEWEST_PIXELS = 9
SEEN = 0.3  # of the pixels about a node's must show the object for it to move
ABOUT = 4.0  # voxels before and behind the surface in which nodes move
MOST_OF_DEPTH = 0.8  # of the matter along a ray may be taken from its front

Integrate = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]  # as integrate_normals


def follow_normals(
    grid: SdfGrid,
    scene: Scene,
    points: Float[Tensor, "height width 3"],
    own: Float[Tensor, "height width 3"],
    labels: Labels,
    integrate: Integrate,
) -> SdfGrid:
    """Move the grid's visible side to the integral of the labels' normals.

    Args:
        points: world, where each pixel's ray meets the grid's surface or the ground.
        own: world, the surface's normals there; 0 on the ground.
        integrate: what is known of the surface so far: `integrate_normals`, or that it is a shadow hull, which the
            object is never in front of.

    Returns:
        The grid. Where it was moved, only its sign is right: it is no longer a distance.
    """
    some = _some_pixels(scene, points, own, labels)
    if some is None:
        return grid
    before, rays, seen = some.before, some.rays, np.isfinite(some.before)
    after = integrate(rays, before, some.own, some.normals, some.trust).copy()  # it may be the caller's state
    part = (slice(None, None, some.step), slice(None, None, some.step))
    shown = torch.from_numpy(seen)
    to_ground = (ground_points(scene) - points).norm(dim=-1)[part][shown]
    matter = _matter_behind(grid, points[part][shown], scene.directions[part][shown], to_ground)
    after[seen] = np.minimum(after[seen], before[seen] + MOST_OF_DEPTH * matter)
    return _with_front(grid, scene, before, after, some.step)


@dataclass(frozen=True)
class _SomePixels:
    """Every step-th pixel along each axis of a picture, and what is known there."""

    step: int
    rays: Float[np.ndarray, "height width 3"]  # unit, world
    before: Float[np.ndarray, "height width"]  # world length of the ray to the surface so far; nan beside the object
    own: Float[np.ndarray, "height width 3"]  # world, that surface's normals
    normals: Float[np.ndarray, "height width 3"]  # world, of shading
    trust: Float[np.ndarray, "height width"]  # in them, 0 to 1


def _some_pixels(
    scene: Scene, points: Float[Tensor, "height width 3"], own: Float[Tensor, "height width 3"], labels: Labels
) -> _SomePixels | None:
    """Return as many evenly spaced pixels as are integrated at once; None without an object or normals of shading."""
    on_object = (labels.mask > 0.5) & (own != 0).any(-1)
    step = 1 + int((float(on_object.sum()) / MOST_PIXELS) ** 0.5)
    part = (slice(None, None, step), slice(None, None, step))
    seen = on_object[part].numpy()
    if seen.sum() < FEWEST_PIXELS or not labels.normal_confidence.any():
        return None
    t = (points - scene.eye).norm(dim=-1)[part].numpy().astype(np.float64)
    read = (labels.normals, labels.normal_confidence)
    normals, trust = (image[part].numpy().astype(np.float64) for image in read)
    return _SomePixels(
        step, scene.directions[part].numpy(), np.where(seen, t, np.nan), own[part].numpy(), normals, trust
    )


def _matter_behind(
    grid: SdfGrid, points: Float[Tensor, "n 3"], rays: Float[Tensor, "n 3"], to_ground: Float[Tensor, " n"]
) -> Float[np.ndarray, " n"]:
    """Return the world length of matter along rays behind points on the surface: to its end, or to the ground."""
    hollow = SdfGrid(-grid.values, grid.origin, grid.spacing)
    inside = points + 0.5 * grid.spacing * rays
    ends = find_surface(hollow, inside.contiguous(), rays.contiguous())
    return torch.where(ends.isfinite(), ends, to_ground).nan_to_num(nan=0.0).double().numpy()


def _with_front(
    grid: SdfGrid,
    scene: Scene,
    before: Float[np.ndarray, "height width"],
    after: Float[np.ndarray, "height width"],
    step: int,
) -> SdfGrid:
    """Move the visible side along the camera's rays: a node takes the value at the surface's old position.

    The far side does not move: where the front moves back, only inside nodes change, and where it comes forward, only
    outside nodes.
    """
    there = np.isfinite(before)
    share = cv2.blur(there.astype(np.float32), (3, 3))
    maps = [np.where(there, m, 0).astype(np.float32) for m in (before, after - before)]
    old, shift = (np.where(there, m, cv2.blur(m, (3, 3)) / share.clip(1e-6)) for m in maps)
    eye = scene.eye.numpy().astype(np.float64)
    values = grid.values.numpy().copy()
    across = np.indices(values.shape[1:])
    for i, slab in enumerate(values):
        nodes = grid.origin.numpy() + grid.spacing * np.stack([np.full(slab.shape, i), *across], -1)
        uv = (scene.posed_camera.project(nodes) / step).astype(np.float32)
        front, by, seen = (cv2.remap(m, uv[..., 0], uv[..., 1], cv2.INTER_LINEAR) for m in (old, shift, share))
        t = np.linalg.norm(nodes - eye, axis=-1)
        change = (seen > SEEN) & (np.abs(t - front - by / 2) < np.abs(by) / 2 + ABOUT * grid.spacing)
        if change.any():
            back = nodes[change] - (by[change] / t[change])[:, None] * (nodes[change] - eye)
            moved = grid.sdf(torch.from_numpy(back).float()).numpy()
            slab[change] = np.where(by[change] > 0, np.maximum(slab[change], moved), np.minimum(slab[change], moved))
    return SdfGrid(torch.from_numpy(values), grid.origin, grid.spacing)
