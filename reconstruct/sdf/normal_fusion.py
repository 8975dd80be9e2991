"""Combine a surface, which knows where it is, with normals of pixels, which know how it faces.

Shadows hold a surface to a fraction of a voxel, and steps along the gradients of their rays leave it uneven at that
size: of a koala's pixels that several lights show well, its normals are 1.3 degrees off where those of photometric
stereo are .4. Positions are good at large distances, normals at small ones [Nehab, Rusinkiewicz, Davis and
Ramamoorthi, Efficiently combining positions and normals for precise 3D geometry, SIGGRAPH 2005]. There, the points of
one depth map move; here, the signed distances of a grid, because several cameras see one surface.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_matrix, diags, vstack
from scipy.sparse.linalg import cg
from torch import Tensor

from capture.checks.robust import geman_mcclure
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.level_set import as_distance
from reconstruct.sdf.rays import first_hits

BAND = 3.0  # voxels about the surface in which nodes move: differences are taken within 2.4 of it
ON_SURFACE = 1.0  # voxels: nodes that are held to where they are
HELD = 0.1  # weight of that, beside a sure normal's 1: positions decide beyond some 2 pi / HELD voxels
AT_REST = 1.0  # the same where no normal is near; a tenth of it moves a hidden side by .001 voxels more
AT_OUTLINE = 1.0  # the same for the points of pixels at an outline, whose place is seen itself
ALIKE = 0.1  # weight of the differences of neighbours' moves: what no normal tells moves with what is near
OUTLIER = np.radians(10.0)  # angle to a normal beyond which it is rather wrong than the surface
LEAST_TRUST = 0.02  # normals of less say nothing
ROUNDS = 2  # of weights for outliers
ACCURATE, MOST_STEPS = 1e-4, 300  # of conjugate gradients: relative residual, iterations


@dataclass(frozen=True)
class NormalRays:
    """The rays of one camera's pixels, and the normals of what they see. World frame, or the surface's."""

    eye: Float[Tensor, "3"]
    directions: Float[Tensor, "n 3"]  # unit
    to_ground: Float[Tensor, " n"]  # world length; inf where there is none
    normals: Float[np.ndarray, "n 3"]  # unit
    trust: Float[np.ndarray, " n"]  # in [0, 1]
    at_outline: Bool[np.ndarray, " n"]


class _Seen(NamedTuple):
    """Points of the surface that pixels see."""

    points: Float[np.ndarray, "n 3"]  # voxels
    normals: Float[np.ndarray, "n 3"]
    trust: Float[np.ndarray, " n"]
    at_outline: Bool[np.ndarray, " n"]


def combine_with_normals(surface: SdfGrid, cameras: Sequence[NormalRays]) -> SdfGrid:
    """Return the surface after its distances phi moved by the d that minimises, in voxels,

        sum over pixels of trust rho |grad (phi + d) - n|^2  +  AT_OUTLINE^2 sum over pixels at outlines of d^2
        +  HELD^2 sum over nodes near the surface of d^2  +  ALIKE^2 sum over neighbours p, q of (d_p - d_q)^2,

    with rho the weights of Geman and McClure, and AT_REST for HELD where no normal is near. The gradient is that of
    `SdfGrid.gradient`, at the points of the surface that the pixels see. To find these again on the moved surface and
    to move it once more gains nothing. Without normals the surface stays as it is.
    """
    seen = _Seen(*map(np.concatenate, zip(*(_seen(surface, camera) for camera in cameras), strict=True)))
    return _moved(surface, seen) if seen.trust.any() else surface


def _seen(surface: SdfGrid, camera: NormalRays) -> _Seen:
    """Return where the rays of pixels that say something meet the surface."""
    trust = np.where(camera.trust > LEAST_TRUST, camera.trust, 0)
    told = np.flatnonzero((trust > 0) | camera.at_outline)
    rays, some = camera.directions[told], torch.from_numpy(told)
    first = first_hits(surface, camera.eye, rays, camera.to_ground[some])
    points = (camera.eye + first.distance[:, None] * rays).double()
    voxels = ((points - surface.origin) / surface.spacing).numpy()
    most = np.array(surface.values.shape) - 2  # differences on both sides of a point are inside the box
    use = first.on_object.numpy() & ((voxels > 1) & (voxels < most)).all(1)
    told = told[use]
    return _Seen(voxels[use], camera.normals[told].astype(np.float64), trust[told], camera.at_outline[told])


def _moved(surface: SdfGrid, seen: _Seen) -> SdfGrid:
    """Return the surface of the least squares, redistanced."""
    phi = surface.in_voxels()
    moving = np.abs(phi) < BAND
    number = np.full(phi.shape, -1, np.int32)  # of the unknown at each node
    number[moving] = np.arange(moving.sum(), dtype=np.int32)
    slopes = [_differences(number, seen.points, axis) for axis in range(3)]
    now, near = phi[moving].astype(np.float64), np.abs(phi[moving]) < ON_SURFACE
    wanted = [seen.normals[:, axis] - slope @ now for axis, slope in enumerate(slopes)]
    alike = ALIKE * _neighbours(number)
    still = AT_OUTLINE * _interpolation(number, seen.points[seen.at_outline])
    told = sum(np.asarray(abs(slope).T @ seen.trust) for slope in slopes) > 0
    prior = csr_matrix(alike.T @ alike + still.T @ still + diags(near * np.where(told, HELD, AT_REST) ** 2))
    move = np.zeros(len(now))
    for _ in range(ROUNDS):
        left = np.stack([want - slope @ move for want, slope in zip(wanted, slopes, strict=True)], 1)
        across = left - (left * seen.normals).sum(1, keepdims=True) * seen.normals
        weight = seen.trust * geman_mcclure((across**2).sum(1) / OUTLIER**2)
        matrix = prior + sum((slope.T @ diags(weight) @ slope for slope in slopes), csr_matrix(prior.shape))
        right = sum(slope.T @ (weight * want) for slope, want in zip(slopes, wanted, strict=True))
        scale = diags(1 / np.maximum(matrix.diagonal(), 1e-9))
        move, _ = cg(matrix, right, x0=move, rtol=ACCURATE, maxiter=MOST_STEPS, M=scale)
    phi[moving] += move.astype(np.float32)
    return surface.with_voxels(as_distance(phi))


def _differences(number: Int[np.ndarray, "nx ny nz"], points: Float[np.ndarray, "n 3"], axis: int) -> csr_matrix:
    """Return the matrix of derivatives along an axis at points, per voxel: half a voxel forward less half backward."""
    half = 0.5 * np.eye(3)[axis]
    return _interpolation(number, points + half) - _interpolation(number, points - half)


def _interpolation(number: Int[np.ndarray, "nx ny nz"], points: Float[np.ndarray, "n 3"]) -> csr_matrix:
    """Return the matrix of trilinear interpolation at points, voxels; nodes without an unknown count as 0."""
    low = np.floor(points).astype(np.int64)
    share = points - low
    columns, values = [], []
    for corner in np.ndindex(2, 2, 2):
        columns.append(number[tuple((low + corner).T)])
        values.append(np.where(corner, share, 1 - share).prod(1))
    column, value, row = np.stack(columns, 1), np.stack(values, 1), np.arange(len(points))[:, None]
    known = column >= 0
    at = (np.broadcast_to(row, column.shape)[known], column[known])
    return csr_matrix((value[known], at), shape=(len(points), int(number.max()) + 1))


def _neighbours(number: Int[np.ndarray, "nx ny nz"]) -> csr_matrix:
    """Return the matrix of differences between moving nodes that are next to each other."""
    parts = []
    for axis in range(3):
        first = np.moveaxis(number, axis, 0)[:-1].ravel()
        second = np.moveaxis(number, axis, 0)[1:].ravel()
        both: Bool[np.ndarray, " pairs"] = (first >= 0) & (second >= 0)
        pairs = np.stack([first[both], second[both]], 1)
        values = np.tile([1.0, -1.0], len(pairs))
        rows = np.repeat(np.arange(len(pairs)), 2)
        parts.append(csr_matrix((values, (rows, pairs.ravel())), shape=(len(pairs), int(number.max()) + 1)))
    return csr_matrix(vstack(parts))
