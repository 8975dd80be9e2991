"""A hull behind the integral of normals: the start where few lights leave the depth of what the camera sees open.

Five lights prove little of the space along a ray empty, and ground that is dark by chance makes wrong places on it as
likely as the right one: an ear became a fan of shreds, in front of its place and behind it. What a camera sees is, for
the most part, one surface, though. Its depth is integrated from the normals of shading, over what is no break in
shading, and the hull is made anew behind it. How thick it is there, nothing says: it is taken to be as thick as wide.
"""

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from reconstruct.hull.follow_normals import SomePixels, some_pixels
from reconstruct.hull.hull_parts import without_specks
from reconstruct.hull.normal_integration import integrate_normals
from reconstruct.labels.labels import Labels
from reconstruct.scene import Scene
from reconstruct.sdf.grid import SdfGrid

THINNEST = 2.0  # nodes: of matter behind the front
SPECK = 0.05  # of the largest part: smaller ones were shreds of what is now elsewhere


def on_front(
    hull: SdfGrid,
    space: SdfGrid,
    scene: Scene,
    seen: tuple[Float[Tensor, "height width 3"], Float[Tensor, "height width 3"]],
    first: Float[Tensor, "height width 3"],
    labels: Labels,
) -> SdfGrid:
    """Return the hull behind the integral of the labels' normals.

    Args:
        hull: as it was carved.
        space: that nothing proves empty.
        seen: world points and normals of the present surface, where each pixel's ray meets it; normals 0 on ground.
        first: world, where each pixel's ray meets that space.

    Returns:
        The grid is no distance function, only its sign is valid.
    """
    some = some_pixels(scene, *seen, labels)
    if some is None:
        return hull
    front = (first - scene.eye).norm(dim=-1)[:: some.step, :: some.step].numpy().astype(np.float64)
    depth = integrate_normals(some.rays, some.before, some.own, some.normals, some.trust, True, front)
    return _behind(depth, some, hull, space, scene)


def _behind(
    depth: Float[np.ndarray, "height width"], some: SomePixels, hull: SdfGrid, space: SdfGrid, scene: Scene
) -> SdfGrid:
    """Return the part of a hull behind a front of given ray lengths, with matter of that space right behind it."""
    there = np.isfinite(depth).astype(np.uint8)
    kind = cv2.DIST_LABEL_PIXEL
    _, number = cv2.distanceTransformWithLabels(1 - there, cv2.DIST_L2, 5, labelType=kind)
    nearest = np.zeros(number.max() + 1)
    nearest[number[there > 0]] = depth[there > 0]
    front = nearest[number]
    pixel = float(np.median(np.linalg.norm(np.diff(some.rays, axis=1), axis=-1)))
    thick = 2 * cv2.distanceTransform(there, cv2.DIST_L2, 5) * pixel * front
    shape = space.values.shape
    nodes = space.origin.numpy() + space.spacing * np.moveaxis(np.indices(shape), 0, -1).reshape(-1, 3)
    uv = (scene.posed_camera.project(nodes) / some.step).astype(np.float32).reshape(shape[0], -1, 2)
    edge = cv2.BORDER_REPLICATE
    begins, lasts = (
        cv2.remap(image.astype(np.float32), uv, None, cv2.INTER_LINEAR, borderMode=edge).reshape(shape)
        for image in (front, thick)
    )
    away = np.linalg.norm(nodes - scene.eye.numpy(), axis=-1).reshape(shape)
    behind = away - begins - np.maximum(lasts, THINNEST * space.spacing)
    behind = np.where(lasts > 0, np.maximum(space.values.numpy(), behind), space.spacing)
    own = hull.sdf(torch.from_numpy(nodes).float()).numpy().reshape(shape)
    values = np.maximum(np.minimum(own, behind), begins - away)
    values[(values < 0) & ~without_specks(values < 0, SPECK)] = space.spacing
    return SdfGrid(torch.from_numpy(values.astype(np.float32)), space.origin, space.spacing)
