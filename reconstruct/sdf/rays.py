"""Cast many rays through an SdfGrid: run the kernels on all cores, with tensors in the world frame as arguments.

Visibility of lights from points of a solved scene whose object casts shadows.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reconstruct.scene import lights_in_frame
from reconstruct.sdf import kernels
from reconstruct.sdf.blocks import Blocks
from reconstruct.sdf.grid import SdfGrid

T = TypeVar("T")
MAX_THREADS = 8  # each holds its own gradient grids; beyond this, memory grows faster than speed
LIFT_VOXELS = 1.0  # shadow rays start this far above the object: its own roughness casts no shadow
SHARPNESS_PER_VOXEL = 8.0  # NeuS s of a shadow's edge: 10 % to 90 % within half a voxel
RAYS_PER_BATCH = 2**20  # about 80 MB of rays at a time


@cache
def thread_count() -> int:
    """Return the number of cores to use, at most MAX_THREADS and the environment's NUMBA_NUM_THREADS.

    Results are the same bit for bit only at the same count.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    allowed = os.environ.get("NUMBA_NUM_THREADS", "")
    return max(1, min(cores, MAX_THREADS, int(allowed) if allowed.isdecimal() else cores))


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(thread_count(), "shadowgraph")


class PerThread(tuple):
    """One value for each part of a parallel run, such as a thread's own accumulator."""


def run(kernel: Callable[..., T], count: int, *arguments: Any) -> list[T]:
    """Call kernel(*arguments, start, stop) on equal parts of range(count), one per core; return the results in order.

    The kernels release the GIL. The division is fixed, so sums taken in the order of the parts are reproducible.

    Args:
        arguments: passed on unchanged; of a PerThread, each part gets its own element.
    """
    n = thread_count()
    edges = [count * i // n for i in range(n + 1)]

    def work(part: int) -> T:
        own = (a[part] if isinstance(a, PerThread) else a for a in arguments)
        return kernel(*own, edges[part], edges[part + 1])

    return list(_pool().map(work, range(n)))


def first_surfaces(
    field: Blocks,
    origins: Float[np.ndarray, "n 3"],
    directions: Float[np.ndarray, "n 3"],
    far: Float[np.ndarray, " n"],
    width: float = 0.0,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return where rays meet the surface, and t and value of the partial minimum before; grid frame, voxels.

    See kernels.first_surfaces.
    """
    rays = (np.ascontiguousarray(x) for x in (origins, directions, far))
    hit, part_t, part_f = (np.empty(len(far)) for _ in range(3))
    run(kernels.first_surfaces, len(far), field, *rays, width, hit, part_t, part_f)
    return hit, part_t, part_f


def to_grid(grid: SdfGrid, points: Float[Tensor, "*batch 3"]) -> np.ndarray:
    """Convert world points to the grid frame, as contiguous float64 for the kernels."""
    return np.ascontiguousarray(((points.double() - grid.origin.double()) / grid.spacing).numpy())


def lights_to_grid(grid: SdfGrid, lights: Float[Tensor, "n 4"]) -> np.ndarray:
    """Convert homogeneous world lights to the grid frame, as contiguous float64 for the kernels."""
    return np.ascontiguousarray(lights_in_frame(lights.double(), grid.origin.double(), grid.spacing).numpy())


def find_surface(grid: SdfGrid, origins: Float[Tensor, "n 3"], directions: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Return the distance along each ray to the first zero of the SDF, world length; inf if there is none.

    Args:
        origins: world.
        directions: world, unit length.
    """
    far = np.full(len(origins), kernels.FAR)
    hit, _, _ = first_surfaces(grid.blocks, to_grid(grid, origins), directions.double().numpy(), far)
    return torch.from_numpy(np.where(hit > kernels.FAR, np.inf, hit * grid.spacing)).float()


@dataclass(frozen=True)
class FirstHits:
    """The first intersection of each ray."""

    distance: Float[Tensor, " n"]  # world length; inf where it meets nothing
    on_object: Bool[Tensor, " n"]  # else the ground, or nothing


def first_hits(
    grid: SdfGrid, eye: Float[Tensor, "3"], directions: Float[Tensor, "n 3"], to_ground: Float[Tensor, " n"]
) -> FirstHits:
    """Find the first intersection of rays from one point: the object, or the ground behind it.

    Args:
        eye: world.
        directions: world, unit length.
        to_ground: distance along each ray to the ground, world length; inf where it meets none.
    """
    to_object = find_surface(grid, eye.expand_as(directions), directions)
    return FirstHits(torch.minimum(to_object, to_ground), to_object < to_ground)


def in_line_of_sight(
    grid: SdfGrid, eye: Float[Tensor, "3"], points: Float[Tensor, "n 3"], tolerance: float
) -> Bool[Tensor, " n"]:
    """Return which points of the object are the first intersection of their ray from the eye.

    Args:
        eye, points: world.
        tolerance: world length by which a point may lie off the surface.
    """
    offset = points - eye
    distance = offset.norm(dim=-1)
    nothing = torch.full_like(distance, torch.inf)
    first = first_hits(grid, eye, offset / distance[:, None], nothing)
    return (first.distance - distance).abs() < tolerance


def visibility(
    grid: SdfGrid, points: Float[Tensor, "n 3"], lights: Float[Tensor, "n 4"], sharpness: float
) -> Float[Tensor, " n"]:
    """Return the transmittance from each point to its light, in [0, 1] [ShadowNeuS eq:shadow_ray_render, telescoped].

    Args:
        points: world, on or outside the surface.
        lights: one per point, homogeneous, world.
        sharpness: NeuS s in 1 / world length.
    """
    out = np.empty(len(points))
    for first in range(0, len(out), RAYS_PER_BATCH):
        some = slice(first, first + RAYS_PER_BATCH)
        ends, part = (to_grid(grid, points[some]), lights_to_grid(grid, lights[some])), out[some]
        run(kernels.transmittances, len(part), grid.blocks, *ends, sharpness * grid.spacing, part)
    return torch.from_numpy(out).float()


def shadow_starts(
    grid: SdfGrid, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], is_object: Bool[Tensor, " n"]
) -> Float[Tensor, "n 3"]:
    """Return the starts of shadow rays, world: slightly above the object, and on the ground itself, which is exact.

    Args:
        points: world.
        normals: unit, world.
    """
    return points + (LIFT_VOXELS * grid.spacing * is_object)[:, None] * normals


def unshadowed(
    grid: SdfGrid, starts: Float[Tensor, "n 3"], lights: Float[Tensor, "lights 4"]
) -> Float[Tensor, "lights n"]:
    """Return the share of each homogeneous world light that reaches each point, in [0, 1]."""
    s = SHARPNESS_PER_VOXEL / grid.spacing
    return torch.stack([visibility(grid, starts, light.expand(len(starts), 4), s) for light in lights])
