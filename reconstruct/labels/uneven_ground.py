"""Uneven ground: its height over the world's x and y, its normals, and the shadows that it casts on itself."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from scipy.ndimage import map_coordinates
from torch import Tensor
from torch.nn.functional import normalize

from reconstruct.scene import Scene, ground_points
from reconstruct.sdf import carve_kernels as carve
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.rays import run

FARTHEST = 4.0  # camera heights: ground beyond is not mapped
CELLS = 400  # along the longer side
MOST_SAMPLES = 60_000  # pixels that are triangulated, about 1 s
SKIP = 1.5  # cells from its start within which a ray cannot meet the ground: less is interpolation error
RIM = 2  # px beside a predicted shadow whose labels are also unused: its edge is known to about a pixel


@dataclass(frozen=True)
class Relief:
    """World z of the ground at origin + cell * (i, j)."""

    heights: Float[np.ndarray, "gx gy"]  # float32
    origin: Float[np.ndarray, "2"]
    cell: float

    def at(self, x: Float[np.ndarray, "*batch"], y: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
        """Return world z at world x, y; outside the map, that of its nearest edge."""
        places = [(x - self.origin[0]) / self.cell, (y - self.origin[1]) / self.cell]
        return map_coordinates(self.heights.astype(float), places, order=1, mode="nearest")

    def lowest(self, lower: Float[np.ndarray, "3"], upper: Float[np.ndarray, "3"]) -> float:
        """Return the world z of the lowest ground inside a box's x and y."""
        xs, ys = (np.linspace(lower[a], upper[a], CELLS) for a in range(2))
        return float(self.at(*np.broadcast_arrays(xs[:, None], ys[None, :])).min())


def ground_relief(scene: Scene) -> Relief | None:
    """Interpolate the height map of an uneven ground between its pixels; None if the ground is a plane."""
    if scene.ground_depth is None:
        return None
    points = near_ground(scene)
    points = points[np.isfinite(points[..., 0])]
    points = points[:: max(1, len(points) // MOST_SAMPLES)]
    lower, upper = points[:, :2].min(0), points[:, :2].max(0)
    cell = float((upper - lower).max() / CELLS)
    xs, ys = (np.arange(lower[a], upper[a] + cell, cell) for a in range(2))
    nodes = np.stack(np.meshgrid(xs, ys, indexing="ij"), -1)
    heights = LinearNDInterpolator(points[:, :2], points[:, 2])(nodes)
    missing = ~np.isfinite(heights)
    heights[missing] = NearestNDInterpolator(points[:, :2], points[:, 2])(nodes[missing])
    return Relief(np.ascontiguousarray(heights, np.float32), lower, cell)


def near_ground(scene: Scene) -> Float[np.ndarray, "height width 3"]:
    """Return where every pixel's ray meets the ground, world; nan above the horizon or too far away."""
    points = ground_points(scene).double().numpy()
    away = np.linalg.norm(points[..., :2] - scene.eye[:2].numpy(), axis=-1)
    height = float(scene.eye[2]) - scene.ground_height
    return np.where((away < FARTHEST * height)[..., None], points, np.nan)


def ground_normals(scene: Scene) -> Float[Tensor, "height width 3"]:
    """Return unit upward normals of an uneven ground, world, from neighbouring pixels; nan without ground."""
    along_v, along_u = torch.gradient(ground_points(scene), dim=(0, 1))
    normals = normalize(torch.linalg.cross(along_u, along_v), dim=-1)
    return torch.where(normals[..., 2:] < 0, -normals, normals)


def ground_visibility(
    scene: Scene, relief: Relief, points: Float[Tensor, "height width 3"]
) -> Float[Tensor, "photos height width"]:
    """Return 1 where the bare ground does not block the ray from a pixel's point to the light, 0 if it does or unknown.

    Args:
        points: world, where each pixel's ray meets the ground; nan if nowhere.
    """
    flat = np.ascontiguousarray(points.reshape(-1, 3).double().numpy())
    lit = np.zeros((len(scene.lights), len(flat)), np.uint8)
    lights = scene.lights.double().numpy()
    top = float(relief.heights.max())
    run(carve.above_ground, len(flat), lit, flat, lights, relief.heights, relief.origin, relief.cell, top, SKIP)
    size = 2 * RIM + 1
    pictures = [cv2.erode(picture, np.ones((size, size), np.uint8)) for picture in lit.reshape(-1, *points.shape[:2])]
    return torch.from_numpy(np.stack(pictures)).float()


def cut_at_relief(grid: SdfGrid, relief: Relief) -> SdfGrid:
    """Cut a surface at an uneven ground, keeping the part above: max of the SDF and the distance below the ground.

    The height is converted to a distance by the ground's slope; the rim of the base is bevelled by up to a voxel.
    """
    nx, ny, nz = grid.values.shape
    xs, ys, zs = (float(grid.origin[a]) + grid.spacing * np.arange(n) for a, n in enumerate((nx, ny, nz)))
    heights = relief.at(*np.broadcast_arrays(xs[:, None], ys[None, :]))
    slopes = np.hypot(*np.gradient(heights, grid.spacing))
    under = (heights[..., None] - zs) / np.sqrt(1 + slopes**2)[..., None]
    values = torch.maximum(grid.values, torch.from_numpy(under).to(grid.values.dtype))
    return SdfGrid(values, grid.origin, grid.spacing)
