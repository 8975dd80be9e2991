"""Convert a height field to a signed distance function on a grid."""

import cv2
import numpy as np

from reconstruct.initialization.height_field import HeightField
from reconstruct.scene import Scene
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.level_set import LevelSet

BELOW = 3.0  # voxels of the grid under the ground, so that the surface crosses the ground plane instead of ending on it
ABOVE = 3.0  # voxels of air over the highest point
RIM = 3.0  # px beyond the picture where the solid ends, so that its wall is not in view
LIFT = 0.75  # px: less than this above the ground is ground, unless a mask says otherwise
SURE = 0.5  # confidence from which the mask counts
SHELL = 6.0  # px: matter that hangs is at least so thick, or the grid would lose it
THICKNESS = 0.05  # of its extent: the solid below the lowest point where no ground is known


def height_grid(field: HeightField, scene: Scene, nodes: int) -> SdfGrid:
    """Return the solid under a height field, down to the ground, as an SDF in the world frame.

    Without a known ground, the solid ends in a flat base slightly below its lowest point.

    Args:
        nodes: along the longest side of the box.
    """
    view = field.view
    maps = (field.heights, _undersides(field), _bare(field))
    corners = _world(field, scene)
    corners = corners[_inner(field, maps[2]) < 0.5] if field.empty is not None else corners.reshape(-1, 3)
    lower, upper = corners.min(0), corners.max(0)
    base = scene.ground_height if view.ground_known else float(lower[2] - THICKNESS * (upper - lower).max())
    lower[2], spacing = base, float((upper - lower).max() / (nodes - 1))
    lower[2] -= BELOW * spacing
    upper[2] += ABOVE * spacing
    shape = np.ceil((upper - lower) / spacing).astype(int) + 1
    phi = np.empty(shape, np.float32)
    axes = [lower[a] + spacing * np.arange(shape[a]) for a in range(3)]
    for k, z in enumerate(axes[2]):
        world = np.stack(np.broadcast_arrays(axes[0][:, None], axes[1][None, :], z), -1)
        phi[:, :, k] = _outside(world, field, maps, scene) / spacing
    return LevelSet(phi, lower, spacing).grid()


def base_of(grid: SdfGrid) -> float:
    """Return the world z of the ground, known or not, that a height_grid stands on."""
    return float(grid.origin[2]) + BELOW * grid.spacing


def _bare(field: HeightField) -> np.ndarray:
    """Return the share of each pixel that is bare ground, or nothing: by the mask, or by its height over the ground."""
    view = field.view
    if field.empty is not None:
        return field.empty
    if not view.ground_known:
        return np.zeros(view.shape, np.float32)
    bare, confidence = (np.pad(x, view.padding, mode="edge") for x in (view.bare, view.ground_confidence))
    flat = (field.heights - view.ground_heights() < LIFT) & (confidence < SURE)
    return np.maximum(bare, flat.astype(np.float32))


def _undersides(field: HeightField) -> np.ndarray:
    """Return the lower end of the matter: far below the ground where it stands on it."""
    ground = field.view.ground_heights()
    hanging = field.undersides - ground > LIFT
    lowest = np.minimum(field.undersides, field.heights - SHELL)
    return np.where(hanging, lowest, ground - np.float32(0.5 * field.view.focal)).astype(np.float32)


def _inner(field: HeightField, image: np.ndarray) -> np.ndarray:
    """Crop a padded image to the picture and its rim."""
    edge = field.view.padding - int(np.ceil(RIM))
    inner = slice(edge, -edge if edge else None)
    return image[inner, inner]


def _world(field: HeightField, scene: Scene) -> np.ndarray:
    """Return the world points of the pixels in the picture and its rim."""
    view = field.view
    rows, columns = view.shape
    v, u = (_inner(field, x) for x in np.mgrid[:rows, :columns] - float(view.padding))
    depth = view.depth(_inner(field, field.heights).astype(float))
    through = np.stack([(u - view.centre[0]) / view.focal, (v - view.centre[1]) / view.focal, np.ones_like(u)], -1)
    return scene.world_from_camera.apply(depth[..., None] * through)


def _outside(world: np.ndarray, field: HeightField, maps: tuple[np.ndarray, ...], scene: Scene) -> np.ndarray:
    """Return how far world points lie before, behind or beside the matter, or beyond the picture's rim; world length.

    This is not yet a distance function, but its zero set is the surface.

    Args:
        maps: heights, undersides, share of a pixel that is bare ground.
    """
    view = field.view
    points = scene.world_from_camera.inverse().apply(world)
    z = np.maximum(points[..., 2], 1e-6 * view.reference)
    pixel = z / view.focal
    u, v = (points[..., a] / pixel + view.centre[a] for a in range(2))
    at = [(x + view.padding).astype(np.float32) for x in (u, v)]
    tops, undersides, bare = (
        cv2.remap(x, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(float) for x in maps
    )
    height, width = view.bare.shape
    beyond = np.maximum(np.abs(u - (width - 1) / 2) - width / 2, np.abs(v - (height - 1) / 2) - height / 2) - RIM
    beside = np.maximum(bare - 0.5, beyond) * pixel
    return np.maximum(np.maximum(view.depth(tops) - z, z - view.depth(undersides)), beside)
