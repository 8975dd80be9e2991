"""A signed distance grid in another frame: the same surface, turned and shifted."""

import numpy as np
import torch
from jaxtyping import Float
from scipy import ndimage

from calibration.pose import Pose
from reconstruct.sdf.grid import SdfGrid

MARGIN = 3.0  # voxels of empty space about the surface
NEAR = 1.0  # voxels: nodes that may lie inside or beside the surface


def carried(grid: SdfGrid, frame_from_grid: Pose) -> SdfGrid:
    """Return a surface in another frame, on a grid along that frame's axes with the same spacing.

    Values between nodes come from cubic splines, which leave a smooth surface where it was: to 0.01 voxels for a ball
    of ten.

    Args:
        grid: of the frame that `frame_from_grid` starts from.
    """
    inside = torch.nonzero(grid.values < NEAR * grid.spacing).double().numpy()
    origin = grid.origin.double().numpy()
    places = frame_from_grid.apply(origin + grid.spacing * inside) if len(inside) else origin[None]
    lower, upper = places.min(0) - MARGIN * grid.spacing, places.max(0) + MARGIN * grid.spacing
    shape = np.ceil((upper - lower) / grid.spacing).astype(int) + 1
    start = lower.astype(np.float32)
    return SdfGrid(
        torch.from_numpy(values_on(grid, frame_from_grid, start, grid.spacing, shape)),
        torch.from_numpy(start),
        grid.spacing,
    )


def values_on(
    grid: SdfGrid, frame_from_grid: Pose, origin: Float[np.ndarray, "3"], spacing: float, shape: np.ndarray
) -> Float[np.ndarray, "nx ny nz"]:
    """Return a grid's SDF at the nodes of another grid, of another frame; outside its box as SdfGrid.sdf."""
    last = np.array(grid.values.shape) - 1
    coefficients = ndimage.spline_filter(grid.values.numpy().astype(np.float64), order=3, mode="nearest")
    back, out = frame_from_grid.inverse(), np.empty(tuple(int(n) for n in shape), np.float32)
    along = [float(origin[axis]) + spacing * np.arange(out.shape[axis]) for axis in range(3)]
    for i, x in enumerate(along[0]):  # by layers: a fine grid has 14 million nodes
        nodes = np.stack(np.broadcast_arrays(x, along[1][:, None], along[2][None]), -1).reshape(-1, 3)
        at = (back.apply(nodes) - grid.origin.double().numpy()) / grid.spacing
        near = np.clip(at, 0, last)
        found = ndimage.map_coordinates(coefficients, near.T, order=3, mode="nearest", prefilter=False)
        found += grid.spacing * np.linalg.norm(at - near, axis=1)
        out[i] = found.reshape(out.shape[1:])
    return out
