"""The grid in motion: a level set that collects what rays ask for, takes bounded steps and stays an SDF."""

import numpy as np
import torch
from scipy.ndimage import maximum_filter1d

from reconstruct import levelset
from reconstruct.grid import SdfGrid
from reconstruct.march import PerPart, run, thread_count

STABLE_BENDING = 1 / 80  # explicit steps of the biharmonic flow are stable below 2 / 12^2
BAND = 6.0  # voxels about the surface in which the SDF is kept and may move


class LevelSet:
    """phi in voxels on the nodes of one box, and one pair of accumulators per core.

    Rays add d loss / d phi to a part's `g` and its size to `c`; `step` averages both and moves every node by
    rate * g / (c + floor): no node moves further than `rate` voxels, and none without evidence.
    """

    def __init__(self, phi: np.ndarray, origin: np.ndarray, spacing: float, is_distance: bool = False):
        self.phi, self.origin, self.spacing = phi, origin, spacing
        self.g = PerPart(np.zeros_like(phi) for _ in range(thread_count()))
        self.c = PerPart(np.zeros_like(phi) for _ in range(thread_count()))
        self._totals = [np.zeros_like(phi) for _ in range(2)]
        self._spare = phi.copy()
        self._active = active_nodes(phi)
        if not is_distance:
            self.redistance()

    def redistance(self) -> None:
        """The same surface with |grad phi| = 1 within BAND of it, +-BAND beyond; and the nodes that may move."""
        self.phi = redistanced(self.phi)
        self._active = active_nodes(self.phi)
        self._spare[...] = self.phi

    def step(self, passes: int, rate: float, shrink: float, curvature: float, stiffness: int, smoothing: float) -> None:
        """Apply what the rays left behind and clear it.

        Args:
            passes: of averaging; rate: bound of the step, voxels; shrink: pull on nodes without evidence; curvature: of
                the flow, in units of rate; stiffness: passes against bending where there is no evidence; smoothing:
                their weight where there is all evidence, in units of rate.
        """
        n = len(self._active)
        for place, parts in enumerate((self.g, self.c)):
            total = self._totals[place]
            total.fill(0)
            run(levelset.merge, n, tuple(parts), total, self._active)
            for _ in range(passes):
                smoothed = np.zeros_like(total)
                run(levelset.smooth, n, total, smoothed, self._active)
                total = smoothed
            self._totals[place] = total
        setting = (rate, shrink, curvature * rate)
        run(levelset.level_set_step, n, self.phi, self._spare, *self._totals, self._active, setting)
        self.phi, self._spare = self._spare, self.phi
        laplacians = np.zeros_like(self.phi)
        for _ in range(stiffness):
            run(levelset.laplacian, n, self.phi, laplacians, self._active)
            setting = (STABLE_BENDING, smoothing * rate)
            run(levelset.stiffen, n, self.phi, laplacians, self._totals[1], self._active, *setting)

    def grid(self) -> SdfGrid:
        """A copy as an SdfGrid in the world frame."""
        values = torch.from_numpy(self.phi * np.float32(self.spacing))
        return SdfGrid(values, torch.from_numpy(self.origin.astype(np.float32)), self.spacing)


def active_nodes(phi: np.ndarray) -> np.ndarray:
    """Flat indices of the nodes within BAND of the surface, without the faces of the box."""
    inner = np.zeros(phi.shape, bool)
    inner[1:-1, 1:-1, 1:-1] = np.abs(phi[1:-1, 1:-1, 1:-1]) < BAND - 1e-3
    return np.flatnonzero(inner)


def redistanced(phi: np.ndarray) -> np.ndarray:
    """The same surface as a distance function within BAND of it and +-BAND beyond. Voxels."""
    out, fixed = np.empty_like(phi), np.empty(phi.shape, np.uint8)
    levelset.interface(phi, BAND, out, fixed)
    near = fixed
    for axis in range(3):
        near = maximum_filter1d(near, 2 * int(BAND) + 3, axis)
    for order in range(8):
        levelset.sweep(phi, out, fixed, near, order)
    return np.where(phi < 0, -out, out)


def resampled(grid: SdfGrid, nodes: int) -> LevelSet:
    """A level set with `nodes` nodes along the longest side of the same box."""
    lower, upper = grid.origin.double().numpy(), grid.upper().double().numpy()
    spacing = float((upper - lower).max() / (nodes - 1))
    shape = np.floor((upper - lower) / spacing + 1e-6).astype(int) + 1
    x, y, z = (torch.arange(int(n)) * spacing + float(o) for n, o in zip(shape, lower, strict=True))
    slabs = [grid.sdf(torch.cartesian_prod(slab[None], y, z)) for slab in x]
    phi = torch.stack(slabs).reshape(*map(int, shape)).numpy() / spacing
    return LevelSet(np.ascontiguousarray(phi, np.float32), lower, spacing)
