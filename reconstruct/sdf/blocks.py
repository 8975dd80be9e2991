"""A sparse SDF on the blocks of nodes near its surface: the solver's storage of fine grids, and the kernels' input.

Blocks have SIDE^3 nodes. Grid frame, voxels. Memory and time grow with the number of stored blocks.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from scipy import ndimage

from reconstruct.sdf.block_kernels import crossings, overlap
from reconstruct.sdf.kernels import SIDE


class Blocks(NamedTuple):
    """SDF values (voxels) on the stored blocks and +-far on all others; the argument phi of kernels.

    Those that cast rays want it `overlapping`.
    """

    layout: Int[np.ndarray, "bx by bz"]  # int32: place in the pool, or see `index_of`
    pool: Float[np.ndarray, "blocks n n n"]  # float32, 8 nodes, or 9; those beyond the grid's own have no meaning
    nodes: tuple[int, int, int]
    far: float

    def places(self) -> Int[np.ndarray, "blocks 3"]:
        """Return the block coordinates of the pool's blocks, in order."""
        return np.argwhere(self.layout >= 0).astype(np.int32, order="C")  # one layout: kernels are compiled once

    def dense(self) -> Shaped[np.ndarray, "nx ny nz"]:
        """Return the values of all nodes, of the pool's type."""
        beyond = np.empty((2, SIDE, SIDE, SIDE), self.pool.dtype)
        beyond[0], beyond[1] = self.far, -self.far
        index = np.where(self.layout < 0, len(self.pool) + (self.layout & 1), self.layout)
        blocks = np.concatenate([self.pool, beyond])[index].transpose(0, 3, 1, 4, 2, 5)
        whole = blocks.reshape(SIDE * np.array(self.layout.shape))
        return np.ascontiguousarray(whole[tuple(slice(n) for n in self.nodes)])


def pack(values: Float[np.ndarray, "nx ny nz"]) -> Blocks:
    """Convert a dense array (float32, voxels) to blocks, without loss.

    Blocks whose cells are all +far or all -far are not stored; far is the largest absolute value.
    """
    far = float(np.abs(values).max())
    low, high = values, values  # of the cells of each block: the least and the largest
    for axis, n in enumerate(values.shape):
        spans = [slice(first, first + SIDE + 1) for first in range(0, n, SIDE)]
        low = np.stack([np.moveaxis(low, axis, 0)[span].min(0) for span in spans], axis)
        high = np.stack([np.moveaxis(high, axis, 0)[span].max(0) for span in spans], axis)
    stored = (low < high) | (np.abs(low) < far)
    padded = np.pad(values, [(0, -n % SIDE) for n in values.shape])
    a, b, c = stored.shape
    blocks = padded.reshape(a, SIDE, b, SIDE, c, SIDE).transpose(0, 2, 4, 1, 3, 5)
    pool = np.ascontiguousarray(blocks[stored], np.float32)
    return Blocks(index_of(stored, high < 0), pool, (values.shape[0], values.shape[1], values.shape[2]), far)


def index_of(stored: Bool[np.ndarray, "bx by bz"], inside: Bool[np.ndarray, "bx by bz"]) -> Int[np.ndarray, "bx by bz"]:
    """Number the stored blocks from 0; others get -(2 d + inside), with d the Chebyshev distance to a stored block."""
    if stored.all():
        away = np.zeros(stored.shape, np.int32)
    elif stored.any():
        away = np.asarray(ndimage.distance_transform_cdt(~stored, "chessboard"), np.int32)
    else:
        away = np.full(stored.shape, max(stored.shape), np.int32)
    number = np.cumsum(stored, dtype=np.int32).reshape(stored.shape) - 1
    return np.where(stored, number, -(2 * away + inside)).astype(np.int32)


def near_surface(field: Blocks, far: float) -> Blocks:
    """Return the same field, stored only in blocks with a change of sign and those around them; elsewhere +-far.

    So every node within SIDE voxels of the surface along each axis is stored.
    """
    crossed = np.zeros(field.layout.shape, np.bool_)
    crossings(field, field.places(), crossed)
    inside = np.where(field.layout < 0, field.layout & 1, 0).astype(np.bool_)
    kept = field.layout >= 0
    inside[kept] = field.pool[:, 0, 0, 0] < 0
    index = index_of(touching(crossed), inside)
    there = field.layout[index >= 0][:, None, None, None]
    beyond = np.where(there & 1, np.float32(-far), np.float32(far))
    pool = np.where(there < 0, beyond, field.pool[there[:, 0, 0, 0].clip(0)])
    return Blocks(index, pool, field.nodes, far)


def overlapping(field: Blocks) -> Blocks:
    """Return the field as the kernels of rays read it: each block with the first nodes of those after it.

    Then no cell lies between blocks: a sample costs 0.4 times as much, where a third of the cells lay between them.
    """
    side = SIDE + 1
    pool = np.empty((len(field.pool), side, side, side), np.float32)
    overlap(field, field.places(), pool)
    return field._replace(pool=pool)


def touching(blocks: Bool[np.ndarray, "bx by bz"]) -> Bool[np.ndarray, "bx by bz"]:
    """Return these blocks and all blocks that touch them, also at a corner."""
    return np.asarray(ndimage.binary_dilation(blocks, np.ones((3, 3, 3), np.bool_)), np.bool_)
