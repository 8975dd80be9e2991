"""One surface from those of several lies: where a lie's cameras saw the object, its surface counts."""

from collections.abc import Sequence

import numpy as np
import torch
from scipy.spatial import KDTree

from calibration.pose import Pose
from reconstruct.lies.alignment import SeenSurface
from reconstruct.sdf.carried import values_on
from reconstruct.sdf.grid import SdfGrid

NEAR = 3.0  # voxels from a seen point, within which its lie's surface is trusted
LEAST = 1e-3  # weight of a surface far from what its lie saw: a guess, but all there is where no lie sees
MARGIN = 6.0  # voxels of empty space about the object, as a solve leaves


def merged_surface(lies: Sequence[tuple[SeenSurface, Pose]]) -> SdfGrid:
    """Return the mean of the lies' signed distances, weighted by nearness to what each saw, above every lie's table.

    Args:
        lies: each with first_from_lie; the first lie's motion is the identity, and its world that of the result.
    """
    first = lies[0][0].grid
    places = np.concatenate([motion.apply(_inside(lie)) for lie, motion in lies])
    margin = MARGIN * first.spacing
    lower, upper = places.min(0) - margin, places.max(0) + margin
    shape = np.ceil((upper - lower) / first.spacing).astype(int) + 1
    origin = lower.astype(np.float32)
    nodes = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 3)
    nodes = origin.astype(float) + first.spacing * nodes
    total, weights = np.zeros(len(nodes)), np.zeros(len(nodes))
    floor = np.full(len(nodes), -np.inf)
    for lie, motion in lies:
        phi = values_on(lie.grid, motion, origin, first.spacing, shape).reshape(-1).astype(float)
        away = KDTree(motion.apply(lie.points)).query(nodes)[0] / (NEAR * first.spacing)
        weight = LEAST + 1 / (1 + away**2) ** 2
        total, weights = total + weight * phi, weights + weight
        floor = np.maximum(floor, lie.ground_height - motion.inverse().apply(nodes)[:, 2])
    values = np.maximum(total / weights, floor).reshape(shape)
    return SdfGrid(torch.from_numpy(values.astype(np.float32)), torch.from_numpy(origin), first.spacing)


def _inside(lie: SeenSurface) -> np.ndarray:
    """Return the nodes inside a lie's surface, above its table."""
    places = torch.nonzero(lie.grid.values < 0).double().numpy()
    places = lie.grid.origin.double().numpy() + lie.grid.spacing * places
    return places[places[:, 2] >= lie.ground_height]
