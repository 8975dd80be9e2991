"""From labels to a surface: move an SDF grid until every shadow ray agrees with its pixel's label."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import torch

from capture.errors import ReconstructionError, Remedy
from reconstruct.config import FitConfig, Level
from reconstruct.fields import SolvedScene, as_stored
from reconstruct.initialization.choose_start import HULL, Start, choose_start
from reconstruct.initialization.shadow_mask import with_object_mask
from reconstruct.labels.held_out import ValidationRays, draw_blocks, hold_out
from reconstruct.labels.labels import Labels
from reconstruct.labels.observer import Observer
from reconstruct.labels.supervision import Supervision, normal_rays, placed_rays, restricted, supervise
from reconstruct.render.joined import join_views
from reconstruct.scene import Scene
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.level_set import LevelSet, resampled
from reconstruct.sdf.normal_fusion import combine_with_normals
from reconstruct.solve.checkpoint import CheckpointWriter, SolveState, fingerprint, load_state, save_state
from reconstruct.solve.early_stopping import EarlyStopping, NotFiniteError
from reconstruct.solve.level import LevelFit, NoSteering, Rescheduled, Steering, is_rest
from reconstruct.solve.ray_counts import ray_counts
from reconstruct.solve.trials import hull_is_better, shadow_doubts
from reconstruct.solve.unseen import without_unsupported_matter
from reconstruct.torch_sdf.rays import BATCHES
from reconstruct.views import Scenes, check_common, each, first_photos, photo_names, placed

SHOW_EVERY_S = 2.0  # between surfaces handed to the report
SHARE_OF_SHOWING = 0.02  # of a core's time
SAVE_EVERY_S = 5.0  # between checkpoints: what a kill may cost
NO_STEERING = NoSteering()
FEWEST_PHOTOS = 4  # below, shadows leave most of the shape open
SEED_OF_VIEWS = 1000  # of the rays held out from further views, beside the seed


@runtime_checkable
class SolveReporter(Protocol):
    """Callback for progress: stage name, n of m, error values, and from time to time the current surface."""

    def __call__(
        self, *, stage: str, done: int, total: int, message: str, numbers: dict[str, float], surface: SdfGrid | None
    ) -> None: ...


def fit(
    scene: Scene | Scenes,
    config: FitConfig,
    report: SolveReporter,
    checkpoint: Path | None = None,
    device: torch.device | None = None,
    earlier: SolveState | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> SolvedScene:
    """Fit the surface and albedo that explain the shadows and shading of a scene, or of several views of one object.

    1. Every pixel is tested against the known ground. 2. Lit ground carves the shadow hull. 3. On finer and finer
    grids, labels are recomputed with the current surface, and the surface moves until its shadow rays agree. 4. Its
    unevenness follows the normals of the last level's labels, see `combine_with_normals`. Lights stay as calibrated.

    Args:
        scene: what one camera sees, or what each of several does: one surface is solved from all.
        checkpoint: a file that is written every few seconds and resumed from.
        device: the torch device of the surface; None for the CPU kernels, see reconstruct.solve.backend.
        earlier: the state reached with another schedule, at the beginning of a level of this one.
        say: is told what is done between two reports.

    Raises:
        ReconstructionError: no object, no shadow, light positions that contradict each other, views without a common
            ground, or no memory on the device.
    """
    solved = fit_steered(scene, config, report, checkpoint, device, NO_STEERING, earlier, say)
    assert isinstance(solved, SolvedScene)  # nobody asks for another schedule
    return solved


def fit_steered(
    scene: Scene | Scenes,
    config: FitConfig,
    report: SolveReporter,
    checkpoint: Path | None,
    device: torch.device | None,
    steering: Steering,
    earlier: SolveState | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> SolvedScene | Rescheduled:
    """Fit as `fit` does, while `steering` may pause the solve, end a level or all of it, or change the schedule.

    Raises:
        ReconstructionError: as of `fit`.
    """
    solved = _solved(each(scene), config, report, checkpoint, device, steering, earlier, say)
    if isinstance(solved, Rescheduled):
        return solved
    say("reading albedo and gloss from the photos, and comparing each light with the shadows under the others")
    return as_stored(_fields(solved))


def fit_surface(
    scene: Scene | Scenes,
    config: FitConfig,
    report: SolveReporter,
    checkpoint: Path | None = None,
    device: torch.device | None = None,
    earlier: SolveState | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> SdfGrid:
    """Fit the surface alone, as `fit` does, without material and evidence.

    Raises:
        ReconstructionError: as of `fit`.
    """
    solved = _solved(each(scene), config, report, checkpoint, device, NO_STEERING, earlier, say)
    assert isinstance(solved, _Solved)  # nobody asks for another schedule
    return solved.surface


@dataclass(frozen=True)
class _Solved:
    """The end of a solve's last level."""

    observers: tuple[Observer, ...]
    scenes: Scenes  # with the ground that the first surface stands on
    rays: tuple[Supervision, ...]  # of the last level
    begin: Start
    surface: SdfGrid


def _solved(
    scenes: Scenes,
    config: FitConfig,
    report: SolveReporter,
    checkpoint: Path | None,
    device: torch.device | None,
    steering: Steering,
    earlier: SolveState | None,
    say: Callable[[str], None],
) -> _Solved | Rescheduled:
    """Run all levels of a solve, see `fit`."""
    scenes = tuple(with_object_mask(one) for one in scenes)
    check_common(scenes)
    observers = tuple(Observer(one) for one in scenes)
    mark = fingerprint(scenes, config)  # without the device: either backend goes on where the other was stopped
    state = (load_state(checkpoint, mark, _log_to(report, "hull")) if checkpoint else None) or earlier
    begin = choose_start(scenes, observers, config, say, hull_is_better, state.began_with if state else "")
    state = state or _first_state(begin, mark, checkpoint, report)
    origin, scenes = state.start, begin.standing(scenes, state.start)
    task = _Task(scenes, begin, device, report, _log_to(report, "solve"), say, _Timer(SHOW_EVERY_S), steering)
    with CheckpointWriter(state, checkpoint, mark, SAVE_EVERY_S) as writer:
        while True:
            rays = None  # a level's rays and the labels of the next one need not be in memory together
            try:
                state, rays = _after_level(task, writer)
            except (NotFiniteError, torch.OutOfMemoryError) as fault:
                writer.state = _last_good_state(writer.state, fault, task)
                continue
            end = steering.ends_solve(state, begin.config)
            if isinstance(end, Rescheduled):
                writer.write()
                return end
            if end:
                writer.write()
                break
            if state.level == len(begin.config.levels):
                break
            writer.keep(state)
    assert rays is not None  # the loop ends after a level
    normals = [normal_rays(scene, own) for scene, own in zip(placed(scenes), rays, strict=True)]
    surface = combine_with_normals(begin.better(origin, state.start, scenes), normals)
    return _Solved(observers, scenes, rays, begin, surface)


def _fields(end: _Solved) -> SolvedScene:
    """Return the solved scene: a surface, its material as all views show it, and the rays that hold it."""
    views = zip(end.observers, end.scenes, strict=True)
    solved = join_views([observer.fields(end.surface, scene) for observer, scene in views])
    evidence = ray_counts(placed(end.scenes), end.rays, solved.grid, end.begin.config)
    doubts = shadow_doubts(end.scenes, end.observers, end.rays, solved.grid)
    return replace(solved, evidence=evidence, doubts=(*end.begin.doubts(), *doubts))


@dataclass(frozen=True)
class _Task:
    """The constants of a solve."""

    scenes: Scenes
    begin: Start
    device: torch.device | None
    report: SolveReporter
    log: Callable[[str], None]
    say: Callable[[str], None]
    show: "_Timer"
    steering: Steering


def _first_state(begin: Start, mark: str, checkpoint: Path | None, report: SolveReporter) -> SolveState:
    """Return the state that a solve begins with, stored at once: a hull under many lights takes minutes."""
    state = _fresh(0, _first_surface(begin, report), begin.name)
    if checkpoint is not None:
        save_state(state, mark, checkpoint)
    return state


def _first_surface(begin: Start, report: SolveReporter) -> SdfGrid:
    """Return the surface that a solve begins with, and report the first one that there is as soon as it is made."""
    report(stage="hull", done=0, total=2, message=f"making the {begin.name}", numbers={}, surface=None)
    message = f"the first surface of the {begin.name}"
    surface = begin.surface(
        lambda first: report(stage="hull", done=1, total=2, message=message, numbers={}, surface=first)
    )
    report(stage="hull", done=2, total=2, message=begin.name, numbers={}, surface=None)
    return surface


def _log_to(report: SolveReporter, stage: str) -> Callable[[str], None]:
    return lambda text: report(stage=stage, done=0, total=0, message=text, numbers={}, surface=None)


def _after_level(task: _Task, writer: CheckpointWriter) -> tuple[SolveState, tuple[Supervision, ...]]:
    """Continue to the end of the current level of the state in `writer`; it keeps every resumable state."""
    state, scenes, begin, config = writer.state, task.scenes, task.begin, task.begin.config
    level = config.levels[state.level]
    first, total = (sum(x.iterations for x in levels) for levels in (config.levels[: state.level], config.levels))
    task.say(f"reading shadows and slopes from the photos for round {state.level + 1} of {len(config.levels)}")
    labels = begin.labels(state.start, scenes)
    start, rays = _resumed(state, scenes, labels, level)
    rays, held_out = _held_out(scenes, rays, config)
    _leave_out(state.left_out, scenes, rays)
    surface, stopping = start.on(task.device), state.stopping
    level_fit = LevelFit(scenes, rays, held_out, level, config, first, task.log)
    for i, losses, stopping in level_fit.steps(surface, state.iteration, state.stopping):
        began, shown = time.thread_time(), surface.grid() if task.show.is_due() else None
        message = f"round {state.level + 1} of {len(config.levels)}, {level.nodes} steps along the object"
        task.report(stage="solve", done=first + i + 1, total=total, message=message, numbers=losses, surface=shown)
        if shown is not None:
            task.show.shown(time.thread_time() - began)
        if is_rest(i, level):
            tables = {"phi": surface.phi, "wrong": np.concatenate([own.wrong.ravel() for own in rays])}
            place = {"origin": surface.origin, "spacing": surface.spacing}
            writer.keep(replace(state, iteration=i + 1, **tables, **place, stopping=stopping))
            if task.steering.ends_level():
                break
        task.steering.wait(writer.write)
    found = stopping.chosen(surface.grid())
    if state.level == 0 and len(config.levels) > 1:
        found = without_unsupported_matter(found, placed(scenes), rays)
    return replace(_fresh(state.level + 1, found, state.began_with), left_out=state.left_out), rays


def _last_good_state(state: SolveState, fault: NotFiniteError | torch.OutOfMemoryError, task: _Task) -> SolveState:
    """Return the last good state: with fewer rays at once if memory was short, else see _without_faulty_photos."""
    if isinstance(fault, NotFiniteError):
        return _without_faulty_photos(state, fault, task)
    _use_fewer_rays(fault, task)
    return state


def _without_faulty_photos(state: SolveState, fault: NotFiniteError, task: _Task) -> SolveState:
    """Return a state without the photos whose rays gave non-finite numbers.

    Raises:
        ReconstructionError: no such photo is known, or fewer than FEWEST_PHOTOS would remain.
    """
    names, left_out = photo_names(task.scenes), tuple(sorted({*state.left_out, *fault.photos}))
    if left_out == state.left_out or len(names) - len(left_out) < FEWEST_PHOTOS:
        raise ReconstructionError(
            f"{fault}; finite numbers were needed. What was found before is kept. If neither helps, the photos or "
            "their calibration hold such values.",
            "start it again",
            Remedy.OTHER_SEED,
        ) from fault
    task.log(f"{fault}: back to the last checkpoint, without {', '.join(names[photo] for photo in fault.photos)}")
    return replace(state, left_out=left_out)


def _use_fewer_rays(fault: torch.OutOfMemoryError, task: _Task) -> None:
    """Halve the number of rays processed at once, after they did not fit in memory.

    Raises:
        ReconstructionError: even the smallest number does not fit.
    """
    had = BATCHES.rays
    if not BATCHES.halve():
        raise ReconstructionError(
            f"the device has no memory for {had} rays at once, the fewest that are tried. What was found is kept.",
            "close other programs that use the card",
            "compute on the CPU",
            Remedy.COARSER,
        ) from fault
    task.log(f"no memory for {had} rays at once: back to the last checkpoint, with {BATCHES.rays}")


def _leave_out(photos: tuple[int, ...], scenes: Scenes, rays: tuple[Supervision, ...]) -> None:
    """Set the confidence of some photos' rays to 0, in place."""
    for first, own in zip(first_photos(scenes), rays, strict=True):
        own.confidence[[k - first for k in photos if 0 <= k - first < len(own.confidence)]] = 0


def begun(surface: SdfGrid, level: int) -> SolveState:
    """Return the state of a solve that begins with a known surface, at one of its levels."""
    return _fresh(level, surface, HULL)


def _fresh(level: int, start: SdfGrid, began_with: str) -> SolveState:
    nothing, origin = np.zeros(0, np.float32), start.origin.double().numpy()
    tables = (nothing, nothing.astype(np.uint8))
    return SolveState(level, 0, start, *tables, EarlyStopping(), origin, start.spacing, began_with)


def _resumed(
    state: SolveState, scenes: Scenes, labels: tuple[Labels, ...], level: Level
) -> tuple[LevelSet, tuple[Supervision, ...]]:
    """Return the surface and each view's rays of a level, at its beginning or from the checkpoint."""
    rays = tuple(placed_rays(supervise(scene, own), scene) for scene, own in zip(scenes, labels, strict=True))
    if state.iteration == 0:
        return resampled(state.start, level.nodes), rays
    surface = LevelSet(state.phi, state.origin, state.spacing, is_distance=True)
    parts = np.split(state.wrong, np.cumsum([own.wrong.size for own in rays])[:-1])
    return surface, tuple(replace(own, wrong=x.reshape(own.wrong.shape)) for own, x in zip(rays, parts, strict=True))


def _held_out(
    scenes: Scenes, rays: tuple[Supervision, ...], config: FitConfig
) -> tuple[tuple[Supervision, ...], ValidationRays]:
    """Return each view's rays of a level without those held out, and these."""
    parts = []
    for number, (scene, own) in enumerate(zip(scenes, rays, strict=True)):
        seed = (config.seed, SEED_OF_VIEWS + number) if number else config.seed
        drawn = draw_blocks(own.pixels, scene.camera.width, len(scene.lights), seed)
        parts.append(hold_out(restricted(own, config.supervised), drawn))
    kept, held = zip(*parts, strict=True)
    return kept, ValidationRays(held, tuple(first_photos(scenes)))


class _Timer:
    """Says when the next surface is shown: not too often, and rarer where showing one takes long."""

    def __init__(self, seconds: float):
        self._seconds, self._next = seconds, 0.0

    def is_due(self) -> bool:
        return time.monotonic() >= self._next

    def shown(self, cost: float) -> None:
        """Set the next time after a surface was shown, which took `cost` seconds of CPU time."""
        self._next = time.monotonic() + max(self._seconds, cost / SHARE_OF_SHOWING)
