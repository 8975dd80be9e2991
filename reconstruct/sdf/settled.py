"""Find the rays that may leave a gradient. Others agree with their label, and will until the surface moves by a margin.

Neighbouring rays differ by little. So a march along one ray, with the distance that the SDF keeps from 0 on it, settles
a whole tile of pixels, see reconstruct.sdf.settled_kernels.find_unsettled.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8

from reconstruct.sdf import kernels, settled_kernels
from reconstruct.sdf.blocks import Blocks
from reconstruct.sdf.rays import first_surfaces, run

SIDES = (8, 4, 2)  # px of tiles: of the coarsest one only a few are not settled, the finest saves three marches of four


@dataclass(frozen=True)
class Views:
    """Pixels and their rays from one point, grid frame, voxels."""

    eye: Float[np.ndarray, "3"]
    directions: Float[np.ndarray, "pixels 3"]  # unit length
    ground_t: Float[np.ndarray, " pixels"]  # beyond kernels.FAR: no ground
    width: float  # of a pixel per unit length
    role: UInt8[np.ndarray, " pixels"]


class Tiles:
    """The pixels of a picture that count, in square tiles of three sizes, one within the other."""

    def __init__(self, pixels: Int[np.ndarray, " n"], width: int, chosen: Int[np.ndarray, " m"]):
        """Sort the `chosen` of the pixels, which are flat indices into a picture of `width` px."""
        row, column = np.divmod(pixels[chosen], width)
        keys = [(row // side) * (width // side + 1) + column // side for side in SIDES]
        sorting = np.lexsort((chosen, *keys[::-1]))
        starts = [np.flatnonzero(np.diff(key[sorting], prepend=-1)) for key in keys]
        self.order, self.edges = chosen[sorting], [np.append(first, len(chosen)) for first in starts]
        every = [*starts[1:], np.arange(len(chosen))]
        self.children = [np.searchsorted(finer, edges) for finer, edges in zip(every, self.edges, strict=True)]

    def measured(self, starts: np.ndarray, kinds: np.ndarray, normals: np.ndarray) -> tuple:
        """Return settled_kernels.find_unsettled's argument `tiles` for where the pixels' rays start now."""
        sizes = []
        for edges, children in zip(self.edges, self.children, strict=True):
            reach, middle = np.empty(len(edges) - 1), np.empty(len(edges) - 1, np.int64)
            run(settled_kernels.tile_reach, len(reach), self.order, edges, starts, kinds, normals, reach, middle)
            sizes.append((edges, children, reach, middle))
        return (self.order, *sizes)


def unsettled_rays(
    field: Blocks,
    tiles: Tiles,
    views: Views,
    lights: Float[np.ndarray, "photos 4"],
    label: Float[np.ndarray, "photos pixels"],
    confidence: Float[np.ndarray, "photos pixels"],
    need: float,
) -> Int[np.ndarray, "rays 2"]:
    """Return photo and pixel of the shadow rays that may differ from their label, in order.

    Left out are rays without weight, and those that agree with a label of 0 or 1: the SDF is at least `need` all along
    a lit ray, and falls below -need on a dark one. If NeuS s needs a distance of 6 / s, such a ray stays within 0.0025
    of its label until the SDF has changed by need - 6 / s somewhere on it. For rays of the ground this is a bound. Rays
    that start on the surface begin at an SDF of 0: it must rise by settled_kernels.RISE there, and a small change of
    the surface's slope at a grazing ray can escape.

    Args:
        field: a distance function, voxels.
        lights: homogeneous, grid frame.
        label: visibility.
        need: voxels.
    """
    n = len(views.directions)
    hit, part_t, part_f = np.full(n, kernels.NEVER), np.full(n, -1.0), np.zeros(n)
    own = np.flatnonzero(views.role != kernels.GROUND)  # the others' rays start on the ground, wherever the surface is
    eyes = np.broadcast_to(views.eye, (len(own), 3))
    seen = first_surfaces(field, eyes, views.directions[own], views.ground_t[own], views.width)
    hit[own], part_t[own], part_f[own] = seen
    around = (views.eye, views.directions, views.ground_t)
    starts, kinds, normals = np.empty((n, 3)), np.empty(n, np.uint8), np.empty((n, 3))
    run(settled_kernels.ray_starts, n, field, *around, hit, part_t, views.role, starts, kinds, normals)
    measured, found = tiles.measured(starts, kinds, normals), np.zeros(label.shape, np.bool_)
    count = len(lights) * (len(tiles.edges[0]) - 1)
    rays = ((starts, kinds, normals), lights, label, confidence, float(need))
    run(settled_kernels.find_unsettled, count, field, wide_field(field), measured, *rays, found)
    return np.stack(np.divmod(np.flatnonzero(found), n), 1)


def wide_field(field: Blocks) -> Float[np.ndarray, "nx ny nz"]:
    """Return the SDF at every settled_kernels.WIDE-th node, float32, voxels: beyond the band a bound, see `widen`."""
    shape = [-(-(n - 1) // settled_kernels.WIDE) + 2 for n in field.nodes]
    out = np.empty(shape, np.float32)
    settled_kernels.widen(field, out, np.empty(shape, np.bool_))
    return out


def unsettled_views(
    field: Blocks,
    views: Views,
    mask: Float[np.ndarray, " pixels"],
    confidence: Float[np.ndarray, " pixels"],
    need: float,
) -> Int[np.ndarray, " rays"]:
    """Return the pixels whose camera ray may differ from the object mask, see unsettled_rays."""
    found = np.empty(len(mask), np.bool_)
    around = (views.eye, views.directions, views.ground_t)
    run(
        settled_kernels.find_unsettled_views,
        len(mask),
        field,
        wide_field(field),
        *around,
        mask,
        confidence,
        float(need),
        found,
    )
    return np.flatnonzero(found)
