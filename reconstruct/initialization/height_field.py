"""Fit a height field to shadows and normals: one depth per pixel, for scenes without bare ground to carve with."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import maximum_filter
from torch import Tensor
from torch.nn.functional import interpolate

from reconstruct.initialization import height_kernels
from reconstruct.initialization.height_view import HeightView
from reconstruct.sdf.rays import PerThread, run, thread_count

SMALLEST_LAYER = 8  # pixels along the shorter side of the pyramid's top: below, a layer is a tilt and a bend
FAR_BELOW = -1e6  # px: undersides that no ray reaches
BESIDE = 1  # px about a ray that are as empty as its way
MOMENTS = (0.9, 0.99)  # of Adam: a shorter memory than usual, for some hundred steps


@dataclass(frozen=True)
class HeightConfig:
    """Settings of the height field. Lengths in pixels of the level at hand."""

    longest: int = 256  # px of the finest level: the cost grows with the third power
    shortest: int = 24  # px below which no further level is started
    iterations: tuple[int, ...] = (60, 100, 150)  # of the finest level, the next, and all the coarser ones
    rate: tuple[float, float] = (0.5, 0.05)  # of Adam, first and last iteration of every level
    sharpness: tuple[float, float] = (1.0, 4.0)  # per px along the field: at 4 a shadow's edge is a pixel wide
    gamma: float = 0.5  # px along the field: scale beyond which a lit ray through matter counts as an outlier
    stiffness: float = 0.002  # against second differences, per px, where a ray's full error is 1 / photos
    smooth: float = 0.1  # px of second difference up to which bending costs its square; beyond, only its size
    floor: float = 0.3  # against the square of what lies below a known ground
    solid_levels: int = 1  # coarse levels in which all matter stands on the ground
    root: float = 2.0  # px below the ground where matter that stands on it ends
    bendable: float = 0.3  # stiffness of undersides, of that of heights: they follow no picture
    weight: float = 0.0005  # pull of undersides towards the ground: matter that no ray passes beneath stands on it
    start: float = 0.9  # of the ground's distance: a slab that can sink as well as rise
    shading: float = 0.2  # against slopes that differ from those of shading, where a ray's full error is 1 / photos
    slope_error: float = 0.2  # px per px from which such a difference is a break in depth, that costs ever less
    mean_share: float = 0.3  # of the last iterations, whose mean is the result: Adam's own noise averages out

    def levels(self, long_side: int) -> list[tuple[int, int]]:
        """Longer side and iterations of every level, coarse to fine."""
        side, out = min(long_side, self.longest), []
        while side >= self.shortest or not out:
            out.append((side, self.iterations[min(len(out), len(self.iterations) - 1)]))
            side = round(side / 2)
        return out[::-1]


@dataclass(frozen=True)
class HeightField:
    """The visible surface as heights over the padded pixels of a view, and the undersides of the matter below."""

    view: HeightView
    heights: Float[np.ndarray, "rows columns"]
    undersides: Float[np.ndarray, "rows columns"]  # below the ground: the matter stands on it
    empty: Float[np.ndarray, "rows columns"] | None = (
        None  # how much of a pixel shows nothing, where no ground is known
    )


def fit_heights(view: HeightView, config: HeightConfig) -> HeightField:
    """Fit the height field to the shadows of the view, coarse to fine.

    Every label is the target of one ray's NeuS transmittance, reduced to its smallest margin (see height_kernels); grey
    labels are soft targets. Penalties apply to bending, heights below a known ground, and slopes that differ from
    the labels' normals. From the second level on, light may pass beneath the matter, which then ends at an underside.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # its tensors are small: a second thread costs more than it helps
    try:
        return _coarse_to_fine(view, config)
    finally:
        torch.set_num_threads(threads)


def beside_nothing(field: HeightField) -> HeightField:
    """Return the same field for an unknown ground, with nothing beside the object."""
    view = field.view
    return replace(field, empty=np.pad(view.bare, view.padding, mode="edge")) if view.bare.any() else field


def _coarse_to_fine(view: HeightView, config: HeightConfig) -> HeightField:
    field = None
    for number, (long_side, iterations) in enumerate(config.levels(max(view.bare.shape))):
        level = view.reduced(long_side)
        start = _slab(level, config) if field is None else _enlarged(field, level)
        field = _fit_level(start, iterations, config, number >= config.solid_levels and view.ground_known)
    assert field is not None
    return _filled(field) if view.ground_known else field


def _filled(field: HeightField) -> HeightField:
    """Fill hollows that no ray enters: raise undersides only as far as light passes beneath them."""
    view, root = field.view, field.undersides.min()
    labels = tuple(np.ascontiguousarray(x, np.float32) for x in (view.visibility, view.confidence))
    tops = np.empty([-(-n // height_kernels.TILE) for n in view.shape], np.float32)
    height_kernels.tile_tops(field.heights, tops)
    parts = PerThread(np.full(view.shape, root, np.float32) for _ in range(thread_count()))
    sides = (field.heights, field.undersides, tops)
    run(height_kernels.passing_heights, view.bare.shape[0], sides, labels, view.lights, view.frame(), parts)
    passing = maximum_filter(np.max(parts, axis=0), 2 * BESIDE + 1)
    return HeightField(view, field.heights, np.minimum(field.undersides, passing))


def _slab(view: HeightView, config: HeightConfig) -> HeightField:
    ground = view.ground_heights()
    share = config.start if view.ground_known else 1.0
    inverse = (1 + ground / view.focal) / share
    return HeightField(view, (view.focal * (inverse - 1)).astype(np.float32), ground - np.float32(config.root))


def _enlarged(field: HeightField, view: HeightView) -> HeightField:
    """Resample a coarser level's field on the pixels of a finer view."""
    rows, columns = view.shape
    scale = view.focal / field.view.focal
    v, u = np.mgrid[:rows, :columns]
    at = [((x - view.padding + 0.5) / scale - 0.5 + field.view.padding).astype(np.float32) for x in (u, v)]
    heights, undersides = (
        cv2.remap(x, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) * np.float32(scale)
        for x in (field.heights, field.undersides)
    )
    return HeightField(view, heights, undersides)


class _Pyramid:
    """A field as a sum of layers, each half as fine as the previous: low frequencies converge as fast as high ones."""

    def __init__(self, shape: tuple[int, int]):
        self._shape, sizes = shape, [shape]
        while min(sizes[-1]) >= 2 * SMALLEST_LAYER:
            sizes.append(((sizes[-1][0] + 1) // 2, (sizes[-1][1] + 1) // 2))
        self.layers = [torch.zeros(1, 1, *size, requires_grad=True) for size in sizes]

    def total(self) -> Tensor:
        """Return the sum of the layers."""
        fine = [interpolate(layer, size=self._shape, mode="bilinear", align_corners=False) for layer in self.layers]
        return torch.stack(fine).sum(0)[0, 0]


class _Sheet:
    """One side of the matter: a field that can move except where it is fixed."""

    def __init__(self, start: np.ndarray, rest: np.ndarray, fixed: np.ndarray):
        self._base = torch.from_numpy(np.where(fixed, rest, start))
        self._free, self.rest = torch.from_numpy(~fixed), torch.from_numpy(rest)
        self.pyramid = _Pyramid(start.shape)

    def now(self) -> Tensor:
        """Return the current field."""
        return self._base + self._free * self.pyramid.total()


def _fit_level(start: HeightField, iterations: int, config: HeightConfig, with_undersides: bool) -> HeightField:
    view = start.view
    fixed, ground = view.is_ground(), view.ground_heights()
    tops = _Sheet(start.heights, ground, fixed)
    roots = _Sheet(start.undersides, ground - np.float32(config.root), fixed)
    adam = torch.optim.Adam([*tops.pyramid.layers, *(roots.pyramid.layers if with_undersides else ())], betas=MOMENTS)
    slopes = _Slopes(view) if view.trust.any() else None
    shoot, mean = _Shadows(view, config.gamma), _Mean()
    for i in range(iterations):
        share = i / max(1, iterations - 1)
        heights, undersides = tops.now(), roots.now()
        if i >= iterations * (1 - config.mean_share):
            mean.add(heights, undersides)
        pull, pull_roots = shoot(heights, undersides, with_undersides, _between(config.sharpness, share))
        loss = (heights * pull).sum() + config.stiffness * _bending(heights, config.smooth)
        if slopes is not None:
            loss = loss + config.shading * slopes.disagreement(heights, config.slope_error)
        if view.ground_known:
            loss = loss + 0.5 * config.floor * (heights - tops.rest).clamp(max=0).square().sum()
        if with_undersides:
            depth = undersides - roots.rest
            loss = loss + (undersides * pull_roots).sum()
            loss = loss + config.bendable * config.stiffness * _bending(undersides, config.smooth)
            loss = loss + config.weight * depth.clamp(min=0).sum()
            loss = loss + 0.5 * config.floor * depth.clamp(max=0).square().sum()
        adam.zero_grad()
        loss.backward()
        for group in adam.param_groups:
            group["lr"] = _between(config.rate, share)
        adam.step()
    return HeightField(view, *mean.values())


class _Mean:
    """Mean of fields over the last iterations."""

    def __init__(self):
        self._sums, self._count = [], 0

    def add(self, *fields: Tensor) -> None:
        """Add one iteration's fields."""
        now = [field.detach() for field in fields]
        self._sums = [a + b for a, b in zip(self._sums, now, strict=True)] if self._count else now
        self._count += 1

    def values(self) -> list[np.ndarray]:
        """Return the means."""
        return [(total / self._count).numpy() for total in self._sums]


def _between(ends: tuple[float, float], share: float) -> float:
    return ends[0] * (ends[1] / ends[0]) ** share


class _Shadows:
    """The shadow rays of a view."""

    def __init__(self, view: HeightView, gamma: float):
        self._view, self._gamma = view, gamma
        self._labels = tuple(np.ascontiguousarray(x, np.float32) for x in (view.visibility, view.confidence))
        self._tops = np.empty([-(-n // height_kernels.TILE) for n in view.shape], np.float32)
        self._solid = np.full(view.shape, FAR_BELOW, np.float32)
        self._pulls = [PerThread(np.zeros(view.shape) for _ in range(thread_count())) for _ in range(2)]

    def __call__(
        self, heights: Tensor, undersides: Tensor, with_undersides: bool, sharpness: float
    ) -> tuple[Tensor, Tensor]:
        """Return the gradients of the mean error over the photos by heights and undersides."""
        view, tops = self._view, heights.detach().numpy()
        height_kernels.tile_tops(tops, self._tops)
        for part in (*self._pulls[0], *self._pulls[1]):
            part.fill(0)
        field = (tops, undersides.detach().numpy() if with_undersides else self._solid, self._tops)
        setting = (sharpness, self._gamma)
        rows = view.bare.shape[0]
        run(height_kernels.height_pass, rows, field, self._labels, view.lights, view.frame(), setting, *self._pulls)
        above, below = (torch.from_numpy((sum(p) / len(view.lights)).astype(np.float32)) for p in self._pulls)
        return above, below


class _Slopes:
    """A view's slopes from shading, between neighbouring pixels."""

    def __init__(self, view: HeightView):
        self._focal = view.focal
        pad = ((view.padding, view.padding), (view.padding, view.padding))
        trust = np.pad(view.trust, pad)
        self._pairs = []
        for axis, slope in ((1, view.slopes[0]), (0, view.slopes[1])):
            both = np.stack([np.delete(trust, end, axis) for end in (-1, 0)])
            of_both = np.stack([np.delete(np.pad(slope, pad), end, axis) for end in (-1, 0)])
            target, weight = of_both.mean(0), both.min(0)
            self._pairs.append((axis, *(torch.from_numpy(x.astype(np.float32)) for x in (target, weight))))

    def disagreement(self, heights: Float[Tensor, "rows columns"], scale: float) -> Tensor:
        """Sum Cauchy's function of the slope differences: a depth discontinuity costs little."""
        level = (heights + self._focal).clamp(min=1e-3)
        logs, total = level.log(), heights.new_zeros(())
        for axis, target, weight in self._pairs:
            size = level.detach()
            mean = (size[:, 1:] + size[:, :-1]) / 2 if axis else (size[1:] + size[:-1]) / 2
            apart = (torch.diff(logs, dim=axis) - target) * mean
            total = total + (weight * 0.5 * scale * torch.log1p((apart / scale).square())).sum()
        return total


def _bending(heights: Float[Tensor, "rows columns"], smooth: float) -> Tensor:
    """Sum Charbonnier's function of the second differences."""
    across = heights[:, 2:] - 2 * heights[:, 1:-1] + heights[:, :-2]
    down = heights[2:] - 2 * heights[1:-1] + heights[:-2]
    mixed = heights[1:, 1:] - heights[1:, :-1] - heights[:-1, 1:] + heights[:-1, :-1]
    sizes = [(second.square() + smooth**2).sqrt().sum() for second in (across, down, mixed)]
    return sizes[0] + sizes[1] + 2 * sizes[2]
