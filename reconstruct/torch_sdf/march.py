"""March rays by blocks of samples. On a CUDA device a block is recorded once and replayed in one go, as a CUDA graph.

A recorded block is some 180 small operations, each of which takes a card longer to start than to compute. A replay runs
the same operations on the same numbers: its results are those of the block run one by one, to the bit.

An SDF on any torch device: trilinear samples, gradients, and the adjoint of sampling. Grid frame, voxels.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from reconstruct.sdf.kernels import STEP

FACE = 1e-3  # voxels that a sample stays away from the upper faces, so that its cell exists
BLOCK = 8  # samples between two checks of which rays have ended: each check waits for the device
RECORDED = 2 * BLOCK  # samples of a recorded block, whose rays all go on to the end of the last one
FEWEST = 2**10  # rays of a recorded block; its number of rays is a power of two
KEPT = 12  # recorded blocks: their memory is theirs
LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Volume:
    """SDF values on a device, with constants for sampling them."""

    phi: Float[Tensor, "nx ny nz"]
    last: Float[Tensor, "3"]  # node coordinates of the upper corner
    inside: tuple[Float[Tensor, "3"], Float[Tensor, "3"]]  # the corners that samples are moved between
    scale: Float[Tensor, "3"]  # from node coordinates to those of grid_sample, which end at -1 and 1
    offsets: Int[Tensor, "8"]  # from a cell's lower corner to its corners, in the flattened phi
    stored: Int[Tensor, " nodes"] | None = None  # where the sums of each node are kept; beyond their end: nowhere

    @classmethod
    def of(cls, phi: Float[Tensor, "nx ny nz"], stored: Int[Tensor, " nodes"] | None = None) -> "Volume":
        """Make a volume of contiguous SDF values."""
        _, ny, nz = phi.shape
        corners = [i * ny * nz + j * nz + k for i in (0, 1) for j in (0, 1) for k in (0, 1)]
        last = torch.tensor(phi.shape, dtype=phi.dtype, device=phi.device) - 1
        inside = (torch.zeros_like(last), last - FACE)
        return cls(phi, last, inside, 2 / last, torch.tensor(corners, device=phi.device), stored)

    def sample(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """Return the trilinear SDF at points; outside the box, that of the nearest point on it."""
        if self.phi.device.type == "mps":  # torch lacks grid_sample in three dimensions there
            index, weight = self.corners(points)
            return (self.phi.reshape(-1)[index] * weight).sum(-1)
        scaled = points.clamp(*self.inside) * self.scale - 1
        volume = self.phi.permute(2, 1, 0)[None, None]  # grid_sample counts its axes from the last one
        return F.grid_sample(volume, scaled[None, None, None], align_corners=True).reshape(-1)

    def gradient(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Return central differences of the trilinear SDF over one voxel; not normalised."""
        return central_differences(self.sample, points)

    def corners(self, points: Float[Tensor, "n 3"]) -> tuple[Int[Tensor, "n 8"], Float[Tensor, "n 8"]]:
        """Return the eight nodes around each point as flat indices, and their trilinear weights."""
        _, ny, nz = self.phi.shape
        inside = points.clamp(*self.inside)
        lower = inside.floor()
        share = inside - lower
        cell = lower.long()
        first = (cell[:, 0] * ny + cell[:, 1]) * nz + cell[:, 2]
        x, y, z = torch.stack([1 - share, share], -1).unbind(1)
        weight = x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]
        return first[:, None] + self.offsets, weight.reshape(-1, 8)

    def shares(
        self, points: Float[Tensor, "n 3"], amounts: Float[Tensor, " n"], quantum: float = 0.0
    ) -> tuple[Int[Tensor, "n 8"], Float[Tensor, "n 8"]]:
        """Return the eight nodes around each point as flat indices, and their trilinear shares of its amount.

        Args:
            quantum: shares are rounded to multiples of it, unless 0.
        """
        index, weight = self.corners(points)
        shares = weight.to(amounts.dtype) * amounts[:, None]
        return index, (shares / quantum).round() * quantum if quantum else shares

    def summed(self, index: Int[Tensor, "n 8"], shares: Float[Tensor, "n 8"], like: Tensor) -> Tensor:
        """Return the sum of shares at each node, in the shape of `like`: with `shares`, the adjoint of sampling."""
        places = index.reshape(-1) if self.stored is None else self.stored[index.reshape(-1)]
        sums = torch.zeros(like.numel() + 1, dtype=shares.dtype, device=shares.device)
        return sums.index_add_(0, places, shares.reshape(-1))[:-1].view(like.shape)


def central_differences(
    sample: Callable[[Tensor], Tensor], points: Float[Tensor, "n 3"], step: float = 0.5
) -> Float[Tensor, "n 3"]:
    """Return a function's gradient at points by differences over `step` each way; differentiable, not normalised."""
    offsets = step * torch.eye(3, dtype=points.dtype, device=points.device)
    both = torch.stack([points[:, None] + offsets, points[:, None] - offsets], 1)
    ahead, behind = sample(both.reshape(-1, 3)).reshape(-1, 2, 3).unbind(1)
    return (ahead - behind) / (2 * step)


class State(NamedTuple):
    """Rays under way."""

    origins: Float[Tensor, "n 3"]
    directions: Float[Tensor, "n 3"]
    end: Float[Tensor, " n"]
    t: Float[Tensor, " n"]  # of the last sample
    f: Float[Tensor, " n"]
    factor: Float[Tensor, " n"]  # of the next step

    def block(
        self, volume: Volume, margin: Float[Tensor, ""], samples: int
    ) -> tuple[Float[Tensor, "samples n"], Float[Tensor, "samples n"]]:
        """Return parameter and SDF of the next samples; at a ray's end its last one is repeated.

        A ray goes by 0.95 (|SDF| - margin) voxels from a sample, at least STEP.
        """
        t, f, times, values = self.t, self.f, [], []
        for number in range(samples):
            step = (0.95 * (f.abs() - margin)).clamp(min=STEP)
            t = torch.minimum(t + (self.factor * step if number == 0 else step), self.end)
            f = volume.sample(torch.addcmul(self.origins, t[:, None], self.directions))
            times.append(t)
            values.append(f)
        return torch.stack(times), torch.stack(values)


def marched(
    volume: Volume, rays: State, margin: Float[Tensor, ""]
) -> tuple[Float[Tensor, "samples n"], Float[Tensor, "samples n"]]:
    """Return parameter and SDF of every sample after the first; after a ray's end its last sample is repeated."""
    recorded = _recorded_block(volume, margin, len(rays.t))
    rows = _one_by_one(volume, rays, margin) if recorded is None else recorded.march(volume, rays, margin)
    times, values = zip(*rows, strict=True)
    return torch.cat(times), torch.cat(values)


def _one_by_one(volume: Volume, rays: State, margin: Float[Tensor, ""]) -> list[tuple[Tensor, Tensor]]:
    alive, rows = torch.arange(len(rays.t), device=rays.t.device), [(rays.t[None], rays.f[None])]
    while len(alive):
        block = rays.block(volume, margin, BLOCK)
        whole = tuple(row[-1].expand(BLOCK, -1).clone() for row in rows[-1])
        for all_rays, some in zip(whole, block, strict=True):
            all_rays[:, alive] = some
        rows.append((whole[0], whole[1]))
        t, f = block[0][-1], block[1][-1]
        goes_on = (t < rays.end).nonzero()[:, 0]
        alive = alive[goes_on]
        rays = State(
            *(x[goes_on] for x in (rays.origins, rays.directions, rays.end, t, f)), torch.ones_like(t[goes_on])
        )
    return rows


class RecordedBlock:
    """A block of one number of rays, of volumes of one shape, in memory of its own."""

    def __init__(self, volume: Volume, margin: Float[Tensor, ""], count: int):
        """Make the memory of a block of `count` rays; until `record`, it runs operation by operation."""
        self.volume = replace(volume, phi=volume.phi.clone())
        self.margin = margin.clone()
        empty = volume.phi.new_zeros
        self.rays = State(empty(count, 3), empty(count, 3), empty(count), empty(count), empty(count), empty(count))
        self.replay = self._run

    def record(self) -> None:
        """Record the block as a CUDA graph.

        Raises:
            RuntimeError: the device records nothing.
        """
        device = self.rays.t.device
        graph, stream = torch.cuda.CUDAGraph(), torch.cuda.Stream(device)
        stream.wait_stream(torch.cuda.current_stream(device))
        with torch.cuda.stream(stream):
            self._run()  # what only a first run sets up must not be recorded
            graph.capture_begin(capture_error_mode="thread_local")
            try:
                self._run()
            finally:
                graph.capture_end()
        torch.cuda.current_stream(device).wait_stream(stream)
        self.replay = graph.replay

    def _run(self) -> None:
        self.times, self.values = self.rays.block(self.volume, self.margin, RECORDED)
        self.rays.t.copy_(self.times[-1])
        self.rays.f.copy_(self.values[-1])
        self.rays.factor.fill_(1.0)
        self.goes_on = (self.rays.t < self.rays.end).any()

    def march(self, volume: Volume, rays: State, margin: Float[Tensor, ""]) -> list[tuple[Tensor, Tensor]]:
        """Return what `marched` does, by blocks."""
        count, rows = len(rays.t), [(rays.t[None], rays.f[None])]
        self.volume.phi.copy_(volume.phi)
        self.margin.copy_(margin)
        for mine, given in zip(self.rays, rays, strict=True):
            mine[:count].copy_(given)
        self.rays.end[count:] = self.rays.t[count:] = 0.0
        goes_on = True
        while goes_on:
            self.replay()
            rows.append((self.times[:, :count].clone(), self.values[:, :count].clone()))
            goes_on = bool(self.goes_on)
        return rows


_blocks: dict[tuple, RecordedBlock | None] = {}  # of this process, which uses one device; None: nothing can be recorded


def _recorded_block(volume: Volume, margin: Float[Tensor, ""], count: int) -> RecordedBlock | None:
    """Return the block for so many rays on a CUDA device; None elsewhere, and where none can be recorded."""
    if not volume.phi.is_cuda or not count:
        return None
    size = max(FEWEST, 1 << (count - 1).bit_length())
    key = (volume.phi.shape, volume.phi.dtype, size)
    if key in _blocks:
        _blocks[key] = _blocks.pop(key)  # now the one used last
        return _blocks[key]
    while len(_blocks) >= KEPT:
        del _blocks[next(iter(_blocks))]
    try:
        block = RecordedBlock(volume, margin, size)
        block.record()
        _blocks[key] = block
    except torch.OutOfMemoryError:
        raise
    except RuntimeError as error:
        LOG.info("no CUDA graph on this card (%s): operations are started one by one", error)
        _blocks[key] = None
    return _blocks[key]


def forget_blocks() -> None:
    """Give the memory of all recorded blocks back."""
    _blocks.clear()
