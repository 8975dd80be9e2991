"""March many rays at once in torch, on any device: the extrema and first surfaces of reconstruct/sdf/kernels.py.

All rays advance together by one sample per step, and every few steps those that have ended are dropped; there is no
loop over rays. The samples are then searched for minima, maxima and sign changes without any loop.

All quantities are in the grid frame, as in the kernels: nodes have integer coordinates, lengths and SDF values are in
voxels. Tensors of one call share a device and a floating type: float32 suffices for positions accurate to 1e-4 voxel.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from reconstruct.sdf.kernels import DARK, MAX_MINIMA, REFRACTORY
from reconstruct.torch_sdf.march import State, Stride, forget_blocks, marched
from reconstruct.torch_sdf.volume import Volume

MISSED = 1e9  # the parameter of a ray that meets nothing
MOST_RAYS = 2**17  # at once; on 240 nodes 1.2 GiB for camera rays, 0.4 GiB for shadow rays
FEWEST_RAYS = 2**11  # at once: where these do not fit into memory, the grid hardly does
PARALLEL = 1e-9  # direction component below which a ray never meets the faces of that axis
ROOT_STEPS, ROOT_ACCURACY = 4, 1e-3  # regula falsi, the last step a bisection; voxels


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
    log_transmittance: Float[Tensor, " n"]
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
    times, values = _recorded(volume, (o, d), near, end, Stride(near.new_full((), band)), first)
    found = _extrema_of(volume, (o, d), end, sharpness, times, values)
    full = []
    for part, blank in zip(found, (0, 0, 0, 0, 0, 0, 0, MISSED), strict=True):
        whole = part.new_full((len(origins), *part.shape[1:]), blank)
        whole[crossing] = part
        full.append(whole)
    return Extrema(*full)


def first_surface(
    volume: Volume,
    origins: Float[Tensor, "n 3"],
    directions: Float[Tensor, "n 3"],
    far: Float[Tensor, " n"],
    width: float = 0.0,
) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"], Float[Tensor, " n"]]:
    """Find the first full hit of each ray, and the first silhouette before it that covers only a part of the pixel.

    A pixel spans width * t / 2 to either side of its ray.

    Args:
        directions: unit.
        far: length at which each ray ends.
        width: of a pixel per unit of t.

    Returns:
        t of the full hit (MISSED if none), t (-1 if none) and SDF of the partial minimum before it.
    """
    near, end = clip(volume, origins, directions, far)
    crossing = (near < end).nonzero()[:, 0]
    rays = (origins[crossing], directions[crossing])
    near, end = near[crossing], end[crossing]
    stride = Stride(near.new_ones(()), near.new_full((), 0.5 * width))
    times, values = _recorded(volume, rays, near, end, stride, torch.ones_like(near))
    hit, part_t, part_f = torch.full_like(far, MISSED), torch.full_like(far, -1.0), torch.zeros_like(far)
    hit[crossing], part_t[crossing], part_f[crossing] = _surface_of(volume, rays, width, times, values)
    return hit, part_t, part_f


def _recorded(
    volume: Volume, rays: tuple[Tensor, Tensor], near: Tensor, end: Tensor, stride: Stride, factor: Tensor
) -> tuple[Float[Tensor, "samples n"], Float[Tensor, "samples n"]]:
    """Return parameter and SDF of every sample from near to end; after a ray's end its last sample is repeated.

    Args:
        factor: of the first step.
    """
    first = volume.sample(rays[0] + near[:, None] * rays[1])
    times, values = marched(volume, State(*rays, end, near, first, factor), stride)
    return torch.cat([times, times[-1:]]), torch.cat([values, values[-1:]])


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
    return used.sum(1), *tables, torch.where(used, loss, 0.0).sum(1), best_t, best_f


def _surface_of(
    volume: Volume, rays: tuple[Tensor, Tensor], width: float, times: Tensor, values: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Find the result of first_surface in recorded samples."""
    n_samples, n = values.shape
    half = 0.5 * width * times
    previous = torch.cat([values[:1], values[:-1]])
    following = torch.cat([values[1:], values[-1:]])
    is_low = (values <= previous) & (values < following) & (values < half + 0.5)
    ray, k = is_low.T.nonzero().unbind(1)
    t, f = _refined(volume, rays, times, values, k, ray)
    is_full, is_part = f < -half[k, ray], (f >= -half[k, ray]) & (f < half[k, ray])
    entered, index = _entries(values, is_low)

    # A moment is 2 k at sample k, 2 k + 1 at the minimum beside it, and `never` at the end of the ray.
    never = 2 * n_samples
    deep = (values < -half) & entered
    moment = torch.where(deep.any(0), 2 * deep.int().argmax(0), never)
    moment = moment.scatter_reduce(0, ray[is_full], 2 * k[is_full] + 1, "amin")
    is_part &= 2 * k + 1 < moment[ray]
    first = torch.full_like(moment, never).scatter_reduce(0, ray[is_part], k[is_part], "amin")
    chosen = is_part & (k == first[ray])
    part_t, part_f = t.new_full((n,), -1.0), t.new_zeros(n)
    part_t[ray[chosen]], part_f[ray[chosen]] = t[chosen], f[chosen]

    at, column = (moment // 2).clamp(max=n_samples - 1), torch.arange(n, device=moment.device)
    hit = torch.full_like(part_t, MISSED)
    grazed = is_full & (2 * k + 1 == moment[ray])
    hit[ray[grazed]] = t[grazed]
    root = _root(volume, rays, times, values, index[at, column])
    return torch.where(entered[at, column], root, hit), part_t, part_f


def _entries(values: Tensor, is_low: Tensor) -> tuple[Bool[Tensor, "samples n"], Int[Tensor, "samples n"]]:
    """Return, per sample, whether its ray has entered the object without a minimum since, and the sample of its entry.

    The entry is the first sample inside; 0 if a ray starts inside.
    """
    number = torch.arange(1, len(values) + 1, device=values.device)[:, None]
    enters = torch.cat([values[:1] < 0, (values[:-1] >= 0) & (values[1:] < 0)])
    entry = torch.where(enters, number, 0).cummax(0).values
    lows = torch.where(is_low, number, 0).cummax(0).values
    before = torch.cat([torch.zeros_like(lows[:1]), lows[:-1]])
    return entry > before, (entry - 1).clamp(min=0)


def _root(
    volume: Volume, rays: tuple[Tensor, Tensor], times: Tensor, values: Tensor, index: Tensor
) -> Float[Tensor, " n"]:
    """Find the sign change before sample `index` of each ray by regula falsi; the ray's start if that is inside."""
    column = torch.arange(len(index), device=index.device)
    before = (index - 1).clamp(min=0)
    ta, tb = times[before, column], times[index, column]
    fa, fb = values[before, column], values[index, column]
    found, is_found = ta, index == 0
    for step in range(ROOT_STEPS):
        difference = torch.where(fa > fb, fa - fb, 1.0)
        t = ta + (tb - ta) * fa / difference if step + 1 < ROOT_STEPS else 0.5 * (ta + tb)
        f = volume.sample(rays[0] + t[:, None] * rays[1])
        found = torch.where(~is_found & (f.abs() < ROOT_ACCURACY), t, found)
        is_found = is_found | (f.abs() < ROOT_ACCURACY)
        ta, fa = torch.where(f > 0, t, ta), torch.where(f > 0, f, fa)
        tb, fb = torch.where(f > 0, tb, t), torch.where(f > 0, fb, f)
    closest = ta + (tb - ta) * fa / torch.where(fa > fb, fa - fb, 1.0)
    return torch.where(is_found, found, closest)
