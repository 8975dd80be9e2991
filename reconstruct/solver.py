"""From labels to a surface: an SDF grid moved until every shadow ray agrees with what its pixel saw."""

import hashlib
import json
import time
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch

from reconstruct.backend import MovingSurface, ray_passes, surface_on
from reconstruct.checkpoint import SolveState, load_state, save_state
from reconstruct.course import REST, Course, Watched, watch
from reconstruct.evidence import ray_counts
from reconstruct.fields import Fields
from reconstruct.fit_config import FitConfig, Level
from reconstruct.grid import SdfGrid
from reconstruct.light_refine import LightShift, MovingLights, lit_from, no_shift
from reconstruct.march import thread_count
from reconstruct.observe import Labels
from reconstruct.observer import Observer
from reconstruct.peel import peeled
from reconstruct.scene import Scene
from reconstruct.shadow_mask import with_object_mask
from reconstruct.start import choose_start
from reconstruct.supervision import Supervision, restricted, supervise
from reconstruct.surface import LevelSet, resampled

REDISTANCE_EVERY = REST  # iterations: steps of at most 0.5 voxel stay well inside the band
SHOW_EVERY_S = 2.0  # between surfaces handed to the report
SAVE_EVERY_S = 5.0  # between checkpoints: what a kill may cost


def _between(ends: tuple[float, float], share: float) -> float:
    """Geometric interpolation."""
    return ends[0] * (ends[1] / ends[0]) ** share


def fit_level(
    surface: MovingSurface,
    scene: Scene,
    rays: Supervision,
    level: Level,
    config: FitConfig,
    done: int,
    first: int,
    lights: MovingLights,
    watched: Watched,
    course: Course,
) -> Iterator[tuple[int, dict[str, float], Course]]:
    """Move the surface through iterations done .. level.iterations - 1; yields after each its number and mean errors.

    Args:
        first: iterations of the whole solve before this level; with the seed it decides the rays, so any step repeats.
        lights: uncertain ones move with the surface.
        watched, course: rays that do not train, and what they said so far; they may end the level early.
    """
    shoot = ray_passes(surface, scene, rays, config)
    if lights.are_uncertain:
        shoot.aim(lights.in_grid(surface.origin, surface.spacing))
    for i in range(done, level.iterations):
        share = course.share(i, level.iterations)
        if share > 1 + 1e-9:
            return
        losses = shoot(first + i, _between(config.sharpness, share))
        passes = max(1, round(level.blur * (1 - share) + share))
        rate = _between(level.rate, share)
        surface.step(passes, rate, level.shrink, config.curvature, config.stiffness, config.smoothing)
        if lights.are_uncertain:
            lights.follow(shoot.light_gradient(), rate, first + i)
            shoot.aim(lights.in_grid(surface.origin, surface.spacing))
        if is_rest(i, level):
            surface.redistance()
            shoot.settle()
            now = surface.grid()
            losses |= {"held_out": watched.error(now, lit_from(scene, lights.shift))}
            course = course.after(losses["held_out"], now)
        yield i, losses, course


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


def fit(
    scene: Scene,
    config: FitConfig,
    report: Report,
    checkpoint: Path | None = None,
    device: torch.device | None = None,
) -> Fields:
    """The surface and albedo that explain a scene's shadows and shading.

    1. Every pixel is tested against the known ground. 2. Lit ground carves the shadow hull. 3. On finer and finer
    grids, labels are read again with the surface known so far, and the surface moves until its shadow rays agree.
    Lights that the scene calls uncertain move with it; each level reads its labels under the lights found so far.

    Args:
        checkpoint: a file that is written every few seconds and resumed from.
        device: where torch moves the surface; None: the CPU kernels do, see reconstruct.backend.

    Raises:
        ReconstructionError: no object, no shadow, or light positions that contradict each other.
    """
    scene = with_object_mask(scene)
    observer = Observer(scene)
    begin = choose_start(scene, observer, config)
    config = begin.config
    mark = f"{fingerprint(scene, config)} {device}"
    state = load_state(checkpoint, mark) if checkpoint else None
    if state is None:
        report(stage="hull", done=0, total=1, message=f"making the {begin.name}", numbers={}, surface=None)
        state = _fresh(0, begin.surface(), no_shift(scene))
        report(stage="hull", done=1, total=1, message=begin.name, numbers={}, surface=state.start)
    origin, scene = state.start, begin.standing(scene, state.start)
    total = sum(level.iterations for level in config.levels)
    show, save, rays = _Timer(SHOW_EVERY_S), _Timer(SAVE_EVERY_S), None
    for number in range(state.level, len(config.levels)):
        level = config.levels[number]
        first = sum(earlier.iterations for earlier in config.levels[:number])
        labels = begin.labels(state.start, lit_from(scene, state.start_shift))
        start, rays = _resumed(state, scene, labels, level)
        if number == 1 and state.iteration == 0:  # later ones are nearer to the truth than any integral
            start = resampled(begin.shaped(start.grid(), scene, labels), level.nodes)
        rays, watched = watch(restricted(rays, config.supervised), scene.camera.width, config.seed)
        surface = surface_on(device, start)
        lights = MovingLights(scene, state.shift)
        course = state.course
        where = (state.iteration, first, lights, watched, course)
        for i, losses, course in fit_level(surface, scene, rays, level, config, *where):
            shown = surface.grid() if show.is_due() else None
            message = f"level {number + 1} of {len(config.levels)}, {level.nodes} nodes"
            report(stage="solve", done=first + i + 1, total=total, message=message, numbers=losses, surface=shown)
            if checkpoint and is_rest(i, level) and save.is_due():
                tables = (surface.phi, rays.error, rays.wrong)
                now = SolveState(number, i + 1, state.start, *tables, state.start_shift, lights.shift, course)
                save_state(now, mark, checkpoint)
        found = course.chosen(surface.grid())
        if number == 0 and len(config.levels) > 1:
            found = peeled(found, lit_from(scene, lights.shift), rays, config)
        state = _fresh(number + 1, found, lights.shift)
    lit = lit_from(scene, state.shift)
    solved = observer.fields(begin.better(origin, state.start, lit), lit)
    return solved if rays is None else replace(solved, evidence=ray_counts(lit, rays, solved.grid, config))


def _fresh(level: int, start: SdfGrid, shift: LightShift) -> SolveState:
    nothing = np.zeros(0, np.float32)
    return SolveState(level, 0, start, nothing, nothing, nothing.astype(np.uint8), shift, shift, Course())


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


def fingerprint(scene: Scene, config: Any) -> str:
    """Of everything a surface depends on: settings (a dataclass), pictures, lights, camera."""
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
        "photo_of_light",
        "ground_depth",
    ):
        value = getattr(scene, name)
        if value is not None:
            digest.update(value.contiguous().numpy().tobytes())
    digest.update(f"{scene.ground_height} {scene.ground_known} {thread_count()}".encode())
    return digest.hexdigest()
