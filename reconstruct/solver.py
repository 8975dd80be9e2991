"""From labels to a surface: an SDF grid moved until every shadow ray agrees with what its pixel saw."""

import hashlib
import json
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from reconstruct import kernels
from reconstruct.checkpoint import SolveState, load_state, save_state
from reconstruct.fields import Fields
from reconstruct.grid import SdfGrid
from reconstruct.hull import shadow_hull
from reconstruct.march import PerPart, lights_to_grid, run, thread_count, to_grid
from reconstruct.observe import Labels
from reconstruct.observer import Observer
from reconstruct.scene import Scene
from reconstruct.supervision import Supervision, supervise
from reconstruct.surface import BAND, LevelSet, resampled

REDISTANCE_EVERY = 10  # iterations: steps of at most 0.5 voxel stay well inside the band
FEWEST_RAYS = 20_000  # per iteration: averages over fewer are too rough to step on
LIGHTS_PER_VOTE = 8  # a second vote costs completeness: it must be affordable
SHOW_EVERY_S = 2.0  # between surfaces handed to the report
SAVE_EVERY_S = 5.0  # between checkpoints: what a kill may cost


@dataclass(frozen=True)
class Level:
    """One stage of coarse to fine."""

    nodes: int  # along the longest side of the object's box
    iterations: int
    rate: tuple[float, float]  # largest step, voxels, first and last iteration
    blur: int  # passes of gradient averaging at the first iteration, falling to one
    shrink: float = 0.0  # pull on nodes without evidence: unseen matter that no ray needs goes


@dataclass(frozen=True)
class FitConfig:
    """The solver's settings. Lengths in voxels."""

    seed: int = 0
    rays: int = 150_000  # shadow rays per iteration, at most
    rays_per_pixel: float = 1.3  # of the supervised pixels: what an iteration needs to see most edges
    levels: tuple[Level, ...] = (
        Level(48, 70, (0.5, 0.4), 4, 5e-4),
        Level(96, 80, (0.4, 0.25), 3, 5e-4),
        Level(160, 90, (0.25, 0.08), 2),
    )
    sharpness: tuple[float, float] = (4.0, 25.0)  # NeuS s per voxel, first and last iteration of every level
    stiffness: int = 4  # passes per iteration against bending where no ray passes
    curvature: float = 0.25  # of the step size: curvature flow
    mask_share: float = 0.25  # camera rays per shadow ray
    mask_weight: float = 1.0
    normal_weight: float = 0.3
    votes: int | None = None  # lights that must prove a node empty for the hull; None: by the kind of labels
    use_boundary: bool = True
    use_start_gradient: bool = True


class _Step:
    """One level's rays in the grid frame, ready for the kernels."""

    def __init__(self, state: LevelSet, scene: Scene, rays: Supervision, config: FitConfig):
        grid = state.grid()
        n = len(rays.pixels)
        self.state, self.rays, self.config = state, rays, config
        self.eye, self.lights = to_grid(grid, scene.eye), lights_to_grid(grid, scene.lights)
        self.ground_t = np.where(np.isfinite(rays.ground_t), rays.ground_t / state.spacing, 1e9)
        self.width = float(scene.pixel_angle)
        self.hit, self.part_t, self.part_f = np.empty(n), np.empty(n), np.empty(n)
        self.light_g = PerPart(np.zeros((len(self.lights), 4)) for _ in range(thread_count()))
        self.n_rays = min(config.rays, max(FEWEST_RAYS, int(config.rays_per_pixel * n)))
        self.batch = (np.empty((self.n_rays, 2), np.int64), np.empty(self.n_rays), np.empty(self.n_rays))
        self.mask_confidence = np.float32(config.mask_weight) * rays.mask_confidence
        self.normal_confidence = np.float32(config.normal_weight) * rays.normal_confidence

    def __call__(self, iteration: int, sharpness: float) -> dict[str, float]:
        """Find the surface, shoot the rays, leave their gradients in the level set; the mean errors by name."""
        state, rays, config, n = self.state, self.rays, self.config, len(self.rays.pixels)
        ends = (self.hit, self.part_t, self.part_f)
        run(kernels.camera_pass, n, state.phi, self.eye, rays.directions, self.ground_t, self.width, *ends)
        grad = (state.phi, state.g, state.c)
        view = (self.eye, rays.directions, self.ground_t, self.width, *ends, rays.role)
        setting = (config.seed, iteration, config.use_boundary, config.use_start_gradient)
        tables, (drawn, weights, misses) = (rays.error, rays.wrong), self.batch
        run(kernels.draw_rays, self.n_rays, rays.confidence, *tables, *setting[:2], drawn, weights)
        shadow = run(
            kernels.shadow_pass,
            self.n_rays,
            *(*grad, self.light_g, BAND, sharpness, view, self.lights, rays.label, self.batch, setting),
        )
        kernels.record(drawn, weights, misses, *tables)
        n_mask = int(self.n_rays * config.mask_share)
        mask = run(
            kernels.mask_pass, n_mask, *grad, BAND, sharpness, view[:3], rays.mask, self.mask_confidence, setting[:2]
        )
        normal_view = (self.eye, rays.directions, self.hit)
        normal = run(kernels.normal_pass, n, *grad, BAND, normal_view, rays.normals, self.normal_confidence)
        return {
            name: sum(p[0] for p in parts) / max(sum(p[1] for p in parts), 1e-9)
            for name, parts in (("shadow", shadow), ("mask", mask), ("normal", normal))
        }


def _between(ends: tuple[float, float], share: float) -> float:
    """Geometric interpolation."""
    return ends[0] * (ends[1] / ends[0]) ** share


def fit_level(
    surface: LevelSet, scene: Scene, rays: Supervision, level: Level, config: FitConfig, done: int, first: int
) -> Iterator[tuple[int, dict[str, float]]]:
    """Move the surface through iterations done .. level.iterations - 1; yields after each its number and mean errors.

    Args:
        first: iterations of the whole solve before this level; with the seed it decides the rays, so any step repeats.
    """
    step = _Step(surface, scene, rays, config)
    for i in range(done, level.iterations):
        share = i / max(1, level.iterations - 1)
        losses = step(first + i, _between(config.sharpness, share))
        passes = max(1, round(level.blur * (1 - share) + share))
        surface.step(passes, _between(level.rate, share), level.shrink, config.curvature, config.stiffness)
        if is_rest(i, level):
            surface.redistance()
        yield i, losses


def is_rest(i: int, level: Level) -> bool:
    """Whether iteration i ends with a redistanced surface: the only moments a solve can be resumed from exactly."""
    return (i + 1) % REDISTANCE_EVERY == 0 or i + 1 == level.iterations


# --- the whole solve -------------------------------------------------------------------------------------------------


@runtime_checkable
class Report(Protocol):
    """Told where the solve is: stage name, n of m, error values, and now and then the surface so far."""

    def __call__(
        self, *, stage: str, done: int, total: int, message: str, numbers: dict[str, float], surface: SdfGrid | None
    ) -> None: ...


def fit(scene: Scene, config: FitConfig, report: Report, checkpoint: Path | None = None) -> Fields:
    """The surface and albedo that explain a scene's shadows and shading.

    1. Every pixel is tested against the known ground. 2. Lit ground carves the shadow hull. 3. On finer and finer
    grids, labels are read again with the surface known so far, and the surface moves until its shadow rays agree.

    Args:
        checkpoint: a file that is written every few seconds and resumed from.

    Raises:
        ReconstructionError: no object, no shadow, or light positions that contradict each other.
    """
    observer = Observer(scene)
    fingerprint = _fingerprint(scene, config)
    state = load_state(checkpoint, fingerprint) if checkpoint else None
    if state is None:
        report(stage="hull", done=0, total=1, message="carving the shadow hull", numbers={}, surface=None)
        state = _hull_state(scene, observer, config)
        report(stage="hull", done=1, total=1, message="shadow hull", numbers={}, surface=state.start)
    total = sum(level.iterations for level in config.levels)
    show, save = _Timer(SHOW_EVERY_S), _Timer(SAVE_EVERY_S)
    for number in range(state.level, len(config.levels)):
        level = config.levels[number]
        first = sum(earlier.iterations for earlier in config.levels[:number])
        surface, rays = _resumed(state, scene, observer.labels(state.start), level)
        for i, losses in fit_level(surface, scene, rays, level, config, state.iteration, first):
            shown = surface.grid() if show.is_due() else None
            message = f"level {number + 1} of {len(config.levels)}, {level.nodes} nodes"
            report(stage="solve", done=first + i + 1, total=total, message=message, numbers=losses, surface=shown)
            if checkpoint and is_rest(i, level) and save.is_due():
                now = SolveState(number, i + 1, state.start, surface.phi, rays.error, rays.wrong)
                save_state(now, fingerprint, checkpoint)
        state = _fresh(number + 1, surface.grid())
    return observer.fields(state.start)


def _hull_state(scene: Scene, observer: Observer, config: FitConfig) -> SolveState:
    nodes = config.levels[0].nodes
    hull = shadow_hull(scene, observer.ground_labels(), config.votes or _votes(scene), nodes)
    return _fresh(0, resampled(hull, nodes).grid())


def _votes(scene: Scene) -> int:
    """1 for given shadow pictures, 2 for labels read from photos, 3 if the lights are estimates too; fewer of few."""
    wanted = 1 if scene.rgb is None else 2
    wanted += bool(scene.light_sigma.any())
    return min(wanted, max(1, len(scene.lights) // LIGHTS_PER_VOTE))


def _fresh(level: int, start: SdfGrid) -> SolveState:
    nothing = np.zeros(0, np.float32)
    return SolveState(level, 0, start, nothing, nothing, nothing.astype(np.uint8))


def _resumed(state: SolveState, scene: Scene, labels: Labels, level: Level) -> tuple[LevelSet, Supervision]:
    """The surface and rays of a level, at its beginning or as the checkpoint left them."""
    surface, rays = resampled(state.start, level.nodes), supervise(scene, labels)
    if state.iteration == 0:
        return surface, rays
    surface = LevelSet(state.phi, surface.origin, surface.spacing, is_distance=True)
    return surface, replace(rays, error=state.error, wrong=state.wrong)


class _Timer:
    """True at most once every so many seconds."""

    def __init__(self, seconds: float):
        self._seconds, self._next = seconds, 0.0

    def is_due(self) -> bool:
        now = time.monotonic()
        if now < self._next:
            return False
        self._next = now + self._seconds
        return True


def _fingerprint(scene: Scene, config: FitConfig) -> str:
    """Of everything the surface depends on: settings, pictures, lights, camera."""
    digest = hashlib.sha256(json.dumps(asdict(config), sort_keys=True).encode())
    for name in (
        "rgb",
        "shadow",
        "mask",
        "usable",
        "directions",
        "eye",
        "lights",
        "power",
        "axis",
        "lobe",
        "ambient",
        "light_sigma",
    ):
        value = getattr(scene, name)
        if value is not None:
            digest.update(value.contiguous().numpy().tobytes())
    digest.update(f"{scene.ground_height} {thread_count()}".encode())
    return digest.hexdigest()
