"""A level set: it accumulates the rays' gradient, takes bounded steps along it, and is redistanced to stay an SDF."""

import numpy as np
import torch
from jaxtyping import Float, Int

from reconstruct.sdf import level_set_kernels as levelset
from reconstruct.sdf.blocks import Blocks, index_of, near_surface, pack, touching
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.kernels import SIDE
from reconstruct.sdf.rays import PerThread, run, thread_count

STABLE_BENDING = 1 / 80  # explicit steps of the biharmonic flow are stable below 2 / 12^2
BAND = 6.0  # voxels about the surface in which the SDF is kept and may move
WHOLE = BAND - 1e-3  # voxels: a node at the band itself does not move
SAME = 1e-3  # voxels: a box whose size is a whole number of them but for rounding
BLOCKS_AT_ONCE = 4096  # of a resampling: 100 MB of points


class LevelSet:
    """phi in voxels on the blocks of a box that are near the surface, and a pair of accumulators for each core.

    Rays add d loss / d phi to the `g` of a core and its absolute value to its `c`. `step` averages both and moves every
    node by rate * g / (c + floor), so that no node moves by more than `rate` voxels or without evidence.

    The surface must move by less than BAND between two redistancings, so that the stored blocks contain all changes.
    """

    def __init__(self, phi: np.ndarray | Blocks, origin: np.ndarray, spacing: float, is_distance: bool = False):
        self.origin, self.spacing = origin, spacing
        given = phi if isinstance(phi, Blocks) else pack(phi)
        self._keep(near_surface(given, BAND) if is_distance else redistanced(given))

    def _keep(self, field: Blocks) -> None:
        """Replace the field: find the nodes that may move, and set the gradient to zero."""
        self.field = field
        self._active, self._around = active_nodes(field)
        self.g, self.c = (PerThread(np.zeros_like(field.pool) for _ in range(thread_count())) for _ in range(2))
        self._totals = [np.zeros_like(field.pool) for _ in range(2)]  # 0 on all nodes that do not move
        self._spare = np.zeros_like(field.pool)
        self._next = field.pool.copy()

    @property
    def phi(self) -> Float[np.ndarray, "nx ny nz"]:
        """A dense copy of phi, float32, voxels."""
        return self.field.dense()

    def sums(self) -> Float[np.ndarray, "2 nx ny nz"]:
        """Return dense copies of the accumulated d loss / d phi, and of the sum of its absolute values over rays."""
        return np.stack([self.field._replace(pool=np.sum(p, axis=0), far=0.0).dense() for p in (self.g, self.c)])

    def is_finite(self) -> bool:
        """Return whether the accumulated gradient is finite: a sum is not finite if one of its terms is not."""
        return bool(np.isfinite([part.sum() for parts in (self.g, self.c) for part in parts]).all())

    def forget(self) -> None:
        """Clear the gradient, without a step."""
        for part in (*self.g, *self.c):
            part[...] = 0

    def redistance(self) -> None:
        """Make |grad phi| = 1 within BAND of the same surface, +-BAND beyond; update the nodes that may move."""
        self._keep(redistanced(self.field))

    def step(self, passes: int, rate: float, shrink: float, curvature: float, stiffness: int, smoothing: float) -> None:
        """Apply the gradient of the rays and clear it.

        Args:
            passes: of averaging; rate: bound of the step, voxels; shrink: pull on nodes without evidence; curvature: of
                the flow, in units of rate; stiffness: passes against bending where there is no evidence; smoothing:
                their weight where there is all evidence, in units of rate.
        """
        n, nodes, phi = len(self._active), (self._active, self._around), self.field.pool
        for place, parts in enumerate((self.g, self.c)):
            flat = tuple(part.reshape(-1) for part in parts)
            run(levelset.merge, n, flat, self._totals[place].reshape(-1), self._active)
            for _ in range(passes):
                run(levelset.smooth, n, self._totals[place], self._spare, *nodes)
                self._totals[place], self._spare = self._spare, self._totals[place]
        run(levelset.level_set_step, n, phi, self._next, *self._totals, *nodes, (rate, shrink, curvature * rate))
        self.field, self._next = self.field._replace(pool=self._next), phi
        setting = (STABLE_BENDING, smoothing * rate)
        for _ in range(stiffness):
            run(levelset.laplacian, n, self.field.pool, self._spare, *nodes)
            run(levelset.stiffen, n, self.field.pool, self._spare, self._totals[1], *nodes, *setting)

    def grid(self) -> SdfGrid:
        """Return a copy as an SdfGrid in the world frame."""
        values = self.phi
        values *= np.float32(self.spacing)
        return SdfGrid(torch.from_numpy(values), torch.from_numpy(self.origin.astype(np.float32)), self.spacing)


def active_nodes(field: Blocks) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, "n 6"]]:
    """Return flat pool indices of the nodes within BAND, except on faces of the box, and of their six neighbours."""
    places = field.places()
    counts = np.zeros(len(places), np.int64)
    run(levelset.count_active, len(places), field, places, WHOLE, counts)
    ends = np.cumsum(counts)
    total = int(ends[-1]) if len(ends) else 0
    active, around = np.empty(total, np.int32), np.empty((total, 6), np.int32)
    run(levelset.list_active, len(places), field, places, WHOLE, ends - counts, active, around)
    return active, around


def redistanced(field: Blocks) -> Blocks:
    """Return the same surface as a distance function within BAND of it and +-BAND beyond. Voxels."""
    field = near_surface(field, BAND)
    out, fixed, places = np.empty_like(field.pool), np.empty(field.pool.shape, np.uint8), field.places()
    run(levelset.interface, len(places), field, places, BAND, out, fixed)
    for order in range(8):
        levelset.sweep(field.layout, out, field.nodes, fixed, BAND, order)
    return field._replace(pool=np.where(field.pool < 0, -out, out))


def as_distance(phi: Float[np.ndarray, "nx ny nz"]) -> Float[np.ndarray, "nx ny nz"]:
    """Return the same of a dense array."""
    return redistanced(pack(phi)).dense()


def resampled(grid: SdfGrid, nodes: int) -> LevelSet:
    """Return a grid's surface as a level set with `nodes` nodes along the longest side of the same box."""
    lower, upper = grid.origin.double().numpy(), grid.upper().double().numpy()
    spacing = float((upper - lower).max() / (nodes - 1))
    shape = [int(n) + 1 for n in np.ceil((upper - lower) / spacing - SAME)]  # never smaller: the object must fit in
    index = _near_blocks(grid.values.numpy() < 0, shape, spacing / grid.spacing)
    pool = np.zeros((int(index.max(initial=-1)) + 1, SIDE, SIDE, SIDE), np.float32)
    places, within = np.argwhere(index >= 0), np.indices((SIDE,) * 3).reshape(3, -1).T
    for part in np.split(np.arange(len(places)), range(BLOCKS_AT_ONCE, len(places), BLOCKS_AT_ONCE)):
        at = (places[part, None] * SIDE + within).reshape(-1, 3)
        points = torch.from_numpy(at).float() * spacing + torch.from_numpy(lower).float()
        pool[part] = (grid.sdf(points).numpy() / spacing).reshape(-1, SIDE, SIDE, SIDE)
    return LevelSet(Blocks(index, pool, (shape[0], shape[1], shape[2]), BAND), lower, spacing)


def _near_blocks(inside: np.ndarray, shape: list[int], ratio: float) -> Int[np.ndarray, "bx by bz"]:
    """Return the index, see `index_of`, of the blocks of a finer grid about those that a coarse surface may cross.

    A block and the nodes beside it lie in cells of the coarse grid; the surface crosses none of these cells if their
    corners are all inside or all outside.

    Args:
        ratio: spacing of the finer grid over that of the coarse one.
    """
    every = some = inside
    for axis, n in enumerate(shape):
        starts = np.arange(0, n, SIDE)
        low = np.floor((starts - 1) * ratio).astype(int).clip(0)
        high = np.ceil((starts + SIDE) * ratio).astype(int) + 1
        spans = [slice(a, max(b, a + 1)) for a, b in zip(low, high, strict=True)]
        every = np.stack([np.moveaxis(every, axis, 0)[span].all(0) for span in spans], axis)
        some = np.stack([np.moveaxis(some, axis, 0)[span].any(0) for span in spans], axis)
    return index_of(touching(some & ~every), every)
