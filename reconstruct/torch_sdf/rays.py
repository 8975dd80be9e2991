"""March many rays at once in torch, on any device: the extrema of reconstruct/sdf/kernels.py.

All rays advance together by one sample per step, and every few steps those that have ended are dropped; there is no
loop over rays. The samples are then searched for minima and maxima without any loop.

All quantities are in the grid frame, as in the kernels: nodes have integer coordinates, lengths and SDF values are in
voxels. Tensors of one call share a device and a floating type: float32 suffices for positions accurate to 1e-4 voxel.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from reconstruct.sdf.kernels import DARK, MAX_MINIMA, REFRACTORY
from reconstruct.torch_sdf.march import State, Volume, forget_blocks, marched

MISSED = 1e9  # the parameter of a ray that meets nothing
MOST_RAYS = 2**17  # at once; on 240 nodes 1.2 GiB for camera rays, 0.4 GiB for shadow rays
FEWEST_RAYS = 2**11  # at once: where these do not fit into memory, the grid hardly does
PARALLEL = 1e-9  # direction component below which a ray never meets the faces of that axis


class Batches:
    """The number of rays to march at once, reduced when memory does not suffice."""

    def __init__(self):
        self.rays = MOST_RAYS

    def halve(self) -> bool:
        """Halve the number of rays; return False if that would be too few."""
        if self.rays <= FEWEST_RAYS:
            return False
        self.rays //= 2
        forget_blocks()
        return True


BATCHES = Batches()  # of this process, which uses one device's memory


@dataclass(frozen=True)
class Extrema:
    """The significant minima of the SDF along each ray and the maximum before each, in order; n rays."""

    count: Int[Tensor, " n"]  # minima kept, at most MAX_MINIMA
    low_t: Float[Tensor, "n k"]
    low_f: Float[Tensor, "n k"]
    high_t: Float[Tensor, "n k"]
    high_f: Float[Tensor, "n k"]
    best_t: Float[Tensor, " n"]  # of the global minimum, known where count = 0; value MISSED where the ray misses
    best_f: Float[Tensor, " n"]

    def is_used(self) -> Bool[Tensor, "n k"]:
        """Return which entries of the tables hold a minimum."""
        return torch.arange(self.low_t.shape[1], device=self.count.device) < self.count[:, None]


def towards(
    points: Float[Tensor, "n 3"], lights: Float[Tensor, "n 4"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]]:
    """Return the unit direction from each point to its homogeneous light, and the distance (MISSED if directional)."""
    offset = lights[:, :3] - lights[:, 3:] * points
    length = torch.linalg.vector_norm(offset, dim=-1)
    return offset / length[:, None], torch.where(lights[:, 3] > 0, length, MISSED)


def clip(
    volume: Volume, origins: Float[Tensor, "n 3"], directions: Float[Tensor, "n 3"], far: Float[Tensor, " n"]
) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
    """Return the part of each ray from 0 to far that is inside the box, voxels; near > far if there is none."""
    parallel = directions.abs() < PARALLEL
    safe = torch.where(parallel, torch.ones_like(directions), directions)
    a, b = -origins / safe, (volume.last - origins) / safe
    beside = ((origins < 0) | (origins > volume.last)) & parallel
    lower = torch.where(parallel, torch.where(beside, 1.0, -MISSED), torch.minimum(a, b))
    upper = torch.where(parallel, torch.where(beside, 0.0, MISSED), torch.maximum(a, b))
    return lower.amax(-1).clamp(min=0), torch.minimum(far, upper.amin(-1))


def extrema(
    volume: Volume,
    origins: Float[Tensor, "n 3"],
    directions: Float[Tensor, "n 3"],
    far: Float[Tensor, " n"],
    sharpness: float,
    jitter: Float[Tensor, " n"] | float = 1.0,
) -> Extrema:
    """Find the extrema of each ray's T = prod_k Phi(s low_k) / Phi(s high_k), see reconstruct/sdf/kernels.py.

    Args:
        directions: unit.
        far: length at which each ray ends.
        sharpness: NeuS s per voxel.
        jitter: share of the first step that is taken, so that samples differ between calls.
    """
    near, end = clip(volume, origins, directions, far)
    crossing = (near < end).nonzero()[:, 0]
    o, d, near, end = origins[crossing], directions[crossing], near[crossing], end[crossing]
    band = 5.0 / sharpness + 1.0
    first = jitter[crossing] if isinstance(jitter, Tensor) else torch.full_like(near, jitter)
    state = State(o, d, end, near, volume.sample(o + near[:, None] * d), first)
    # After a ray's end its last sample is repeated, once at least.
    times, values = (torch.cat([x, x[-1:]]) for x in marched(volume, state, near.new_full((), band)))
    found = _extrema_of(volume, (o, d), end, sharpness, times, values)
    full = []
    for part, blank in zip(found, (0, 0, 0, 0, 0, 0, MISSED), strict=True):
        whole = part.new_full((len(origins), *part.shape[1:]), blank)
        whole[crossing] = part
        full.append(whole)
    return Extrema(*full)


def _refined(
    volume: Volume, rays: tuple[Tensor, Tensor], times: Tensor, values: Tensor, k: Tensor, ray: Tensor
) -> tuple[Tensor, Tensor]:
    """Find the minimum near sample k of each ray, by the parabola through it and its two neighbours."""
    before, after = (k - 1).clamp(min=0), k + 1
    ta, tb, tc = times[before, ray], times[k, ray], times[after, ray]
    fa, fb, fc = values[before, ray], values[k, ray], values[after, ray]
    has_both = (tb > ta) & (tc > tb)
    left, right = torch.where(has_both, tb - ta, 1.0), torch.where(has_both, tc - tb, 1.0)
    d1, d2 = (fb - fa) / left, (fc - fb) / right
    bend = 2 * (d2 - d1) / (left + right)
    slope = (d1 * right + d2 * left) / (left + right)
    usable = has_both & (bend > 1e-6)
    t = torch.where(usable, tb - slope / bend.clamp(min=1e-6), tb)
    t = torch.minimum(torch.maximum(t, ta), torch.maximum(tc, tb))
    f = volume.sample(rays[0][ray] + t[:, None] * rays[1][ray])
    better = usable & (f < fb)
    return torch.where(better, t, tb), torch.where(better, f, fb)


def _extrema_of(
    volume: Volume, rays: tuple[Tensor, Tensor], end: Tensor, s: float, times: Tensor, values: Tensor
) -> tuple[Tensor, ...]:
    """Find the fields of Extrema in recorded samples."""
    n = len(end)
    falls = values[1:] < values[:-1]
    fell = torch.cat([torch.zeros_like(falls[:1]), falls[:-1]])
    # Listed ray by ray, the falling runs' first and last samples pair up in order.
    top = (falls & ~fell).T.nonzero()[:, 1]
    ray, k = (fell & ~falls).T.nonzero().unbind(1)
    t, f = _refined(volume, rays, times, values, k, ray)
    best_f = values[0].scatter_reduce(0, ray, f, "amin")
    is_best = ((f == best_f[ray]) & (f < values[0][ray])).nonzero()[:, 0]
    best_t = torch.full_like(best_f, MISSED).scatter_reduce(0, ray[is_best], t[is_best], "amin")
    best_t = torch.where(best_t < MISSED, best_t, times[0])

    counts = s * f < REFRACTORY
    per_ray = torch.zeros(n, dtype=torch.long, device=end.device).index_add(0, ray, counts.long())
    place = counts.cumsum(0) - 1 - (per_ray.cumsum(0) - per_ray)[ray]
    kept = (counts & (place < MAX_MINIMA)).nonzero()[:, 0]
    slot = (ray[kept], place[kept])
    tables = [t.new_zeros(n, MAX_MINIMA) for _ in range(4)]
    for table, entries in zip(tables, (t, f, times[top, ray], values[top, ray]), strict=True):
        table[slot] = entries[kept]
    loss = F.logsigmoid(s * tables[1]) - F.logsigmoid(s * tables[3])
    is_lit = (loss.cumsum(1) - loss) >= DARK  # before this minimum; beyond DARK the rest has no influence
    used = is_lit & (torch.arange(MAX_MINIMA, device=end.device) < per_ray[:, None])
    return used.sum(1), *tables, best_t, best_f
