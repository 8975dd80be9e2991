"""A level set on a torch device, with the steps, smoothing and redistancing of sdf/level_set.py: LevelSet.

Autograd computes the gradients of rays. They are multiples of QUANTUM and summed in float64. This is exact, so the sums
do not depend on a device's order of addition and are reproducible bit for bit. Redistancing solves the same equation as
the CPU's sweeps, at all nodes at once, until nothing changes.
"""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.level_set import BAND, STABLE_BENDING
from reconstruct.sdf.level_set_kernels import CURVATURE_BAND, EVIDENCE_FLOOR
from reconstruct.torch_sdf.autograd import DifferentiableSdf
from reconstruct.torch_sdf.volume import Volume

QUANTUM = 2.0**-28  # of the gradients: 4e-9, far below the smallest one that counts (1e-6)
FACE_BAND = 2.5  # voxels: beyond this a node has no neighbour on the other side, as in level_set_kernels.interface
SPREAD = int(BAND) + 1  # nodes on either side of the surface that get a distance
ROUNDS = math.ceil(BAND * math.sqrt(3)) + 2  # the distance reaches a node BAND away along the diagonal after this many
LEAST_SLOPE = 1e-3


class TorchLevelSet:
    """phi in voxels on a device, and the rays' gradient with respect to it; methods as of sdf.level_set.LevelSet."""

    def __init__(self, field: Float[Tensor, "nx ny nz"], origin: np.ndarray, spacing: float, is_distance: bool = False):
        self.field, self.origin, self.spacing = field.contiguous(), origin, spacing
        # Leaves of autograd, both 0: a change of phi, and a tensor that receives the absolute values of its gradients.
        self.change, self.evidence = (torch.zeros_like(field, dtype=torch.float64).requires_grad_() for _ in range(2))
        self._active = _active(self.field)
        self._around = neighbours(self._active, self.field.shape)
        if not is_distance:
            self.redistance()

    def differentiable(self, real: torch.dtype) -> DifferentiableSdf:
        """Return the current SDF in a floating type; its samples accumulate their gradients here."""
        return DifferentiableSdf(Volume.of(self.field.to(real)), self.change, self.evidence, QUANTUM)

    @property
    def phi(self) -> np.ndarray:
        """A copy of phi on the host, float32, voxels."""
        return self.field.cpu().numpy()

    def sums(self) -> Float[Tensor, "2 nx ny nz"]:
        """Return the accumulated d loss / d phi on nodes within BAND, and the sum of its absolute values over rays."""
        left = [torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for leaf in (self.change, self.evidence)]
        return torch.where(self.field.abs() < BAND, torch.stack(left), 0.0)

    def redistance(self) -> None:
        """Make |grad phi| = 1 within BAND of the same surface, +-BAND beyond; update the nodes that may move."""
        self.field = redistanced(self.field)
        self._active = _active(self.field)
        self._around = neighbours(self._active, self.field.shape)

    def is_finite(self) -> bool:
        """Return whether the accumulated gradient is finite."""
        return bool(self.sums().isfinite().all())

    def forget(self) -> None:
        """Clear the gradient, without a step."""
        self.change.grad = self.evidence.grad = None

    def step(self, passes: int, rate: float, shrink: float, curvature: float, stiffness: int, smoothing: float) -> None:
        """Apply the gradient of the rays and clear it, as LevelSet.step does."""
        gradient, count = (self._smoothed(total.reshape(-1), passes) for total in self.sums())
        self.forget()
        phi = self.field.view(-1)
        active, value = self._active, phi[self._active]
        bend = self._neighbour_sum(phi) - 6 * value
        flow = torch.where(value.abs() < CURVATURE_BAND, curvature * rate * bend.clamp(-0.5, 0.5), 0.0)
        moved = value - rate * (gradient[active] - shrink) / (count[active] + EVIDENCE_FLOOR + shrink) + flow
        phi[active] = moved
        soft = STABLE_BENDING * (EVIDENCE_FLOOR / (count[active] + EVIDENCE_FLOOR)).clamp(min=smoothing * rate)
        for _ in range(stiffness):
            value = phi[active]
            is_near = value.abs() < CURVATURE_BAND
            laplacians = torch.zeros_like(phi)
            laplacians[active] = torch.where(is_near, self._neighbour_sum(phi) - 6 * value, 0.0)
            bending = self._neighbour_sum(laplacians) - 6 * laplacians[active]
            phi[active] = torch.where(is_near, value - soft * bending, value)

    def grid(self) -> SdfGrid:
        """Return a copy as an SdfGrid in the world frame, on the host."""
        values = self.field.cpu() * self.spacing
        return SdfGrid(values, torch.from_numpy(self.origin.astype(np.float32)), self.spacing)

    def _smoothed(self, total: Float[Tensor, " nodes"], passes: int) -> Float[Tensor, " nodes"]:
        """Average a sum over 7 points `passes` times, on active nodes only."""
        values = torch.zeros_like(self.field).view(-1)
        values[self._active] = total[self._active].to(values.dtype)
        for _ in range(passes):
            new = torch.zeros_like(values)
            new[self._active] = 0.25 * values[self._active] + 0.125 * self._neighbour_sum(values)
            values = new
        return values

    def _neighbour_sum(self, values: Float[Tensor, " nodes"]) -> Float[Tensor, " active"]:
        return values[self._around].sum(0)


def rounded(gradient: Tensor) -> Tensor:
    """Round a float64 gradient to a multiple of QUANTUM, so that its sums are exact."""
    return (gradient / QUANTUM).round() * QUANTUM


def redistanced(phi: Float[Tensor, "nx ny nz"]) -> Float[Tensor, "nx ny nz"]:
    """Return the same surface as a distance function within BAND of it and +-BAND beyond. Voxels; as sdf.level_set."""
    flat = phi.reshape(-1)
    faces, distance = _faces(phi)
    is_near = _dilated(faces, phi.shape)
    is_near[faces] = False
    free = is_near.nonzero()[:, 0]
    around = neighbours(free, phi.shape)
    out = torch.full_like(flat, BAND)
    out[faces] = distance
    for _ in range(ROUNDS):
        out[free] = torch.minimum(out[free], _eikonal(out[around]))
    return torch.where(flat < 0, -out, out).reshape(phi.shape)


def neighbours(nodes: Int[Tensor, " n"], shape: torch.Size) -> Int[Tensor, "6 n"]:
    """Return flat indices of the six neighbours along x, y, z; a node on a face is its own neighbour there."""
    _, ny, nz = shape
    place = (nodes // (ny * nz), nodes // nz % ny, nodes % nz)
    found = []
    for where, size, step in zip(place, shape, (ny * nz, nz, 1), strict=True):
        found += [nodes - step * (where > 0), nodes + step * (where < size - 1)]
    return torch.stack(found)


def _faces(phi: Float[Tensor, "nx ny nz"]) -> tuple[Int[Tensor, " n"], Float[Tensor, " n"]]:
    """Return the nodes beside the surface, and their distance |phi| / |grad phi|, as level_set_kernels.interface."""
    flat = phi.reshape(-1)
    candidates = (flat.abs() <= FACE_BAND).nonzero()[:, 0]
    beside = neighbours(candidates, phi.shape)
    changes = ((flat[beside] < 0) != (flat[candidates] < 0)).any(0)
    nodes, beside = candidates[changes], beside[:, changes]
    here, there = flat[nodes], flat[beside]
    is_face = (beside == nodes).reshape(3, 2, -1).any(1)
    central = (there[1::2] - there[0::2]) * torch.where(is_face, 1.0, 0.5)
    one_sided = (there - here).abs().amax(0)
    slope = torch.maximum(torch.linalg.vector_norm(central, dim=0), 0.5 * one_sided).clamp(min=LEAST_SLOPE)
    return nodes, (here.abs() / slope).clamp(max=1.0)


def _dilated(nodes: Int[Tensor, " n"], shape: torch.Size) -> Bool[Tensor, " nodes"]:
    """Return which nodes are within SPREAD of one of these along every axis."""
    marked = torch.zeros(shape, device=nodes.device)
    marked.view(-1)[nodes] = 1.0
    for axis in range(3):
        rows = marked.movedim(axis, -1)
        grown = torch.nn.functional.max_pool1d(rows.reshape(-1, 1, rows.shape[-1]), 2 * SPREAD + 1, 1, SPREAD)
        marked = grown.reshape(rows.shape).movedim(-1, axis)
    return marked.reshape(-1) > 0


def _eikonal(around: Float[Tensor, "6 n"]) -> Float[Tensor, " n"]:
    """Solve |grad d| = 1 with upwind differences (Zhao 2005), given the six neighbours' distances."""
    lo, mid, hi = torch.minimum(around[0::2], around[1::2]).sort(0).values
    one = lo + 1
    two = 0.5 * (lo + mid + (2 - (lo - mid) ** 2).clamp(min=0).sqrt())
    total = lo + mid + hi
    three = (total + (total**2 - 3 * (lo**2 + mid**2 + hi**2 - 1)).clamp(min=0).sqrt()) / 3
    return torch.where(one <= mid, one, torch.where(two <= hi, two, three))


def _active(field: Float[Tensor, "nx ny nz"]) -> Int[Tensor, " n"]:
    """Return flat indices of the nodes within BAND of the surface, except on faces of the box, as sdf.level_set."""
    inner = torch.zeros_like(field, dtype=torch.bool)
    inner[1:-1, 1:-1, 1:-1] = field[1:-1, 1:-1, 1:-1].abs() < BAND - 1e-3
    return inner.reshape(-1).nonzero()[:, 0]
