"""Stage "solve": build the scene and fit a surface to it, on a schedule that visitors of the page can change.

Carry out requests from visitors of a run's page: pause, next level, stop, another resolution.
"""

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace

import msgspec

from calibration.calibrated_views import CalibratedViews
from calibration.calibration import Calibration
from capture.errors import ReconstructionError, Remedy
from capture.files.atomic import atomic_file, read_json
from capture.files.regular import why
from reconstruct.config import FitConfig
from reconstruct.fields import SolvedScene
from reconstruct.mesh.mesh import preview_mesh
from reconstruct.mesh.texture import PhotoColours
from reconstruct.run.machine import within_budget, work_of
from reconstruct.run.object_poses_stage import forget_object_poses, joined_object_poses
from reconstruct.run.presets import continued, solver_config, training
from reconstruct.run_folder.folder import KEPT, RunFolder
from reconstruct.run_folder.progress import Lazy
from reconstruct.run_folder.requests import (
    NEXT_LEVEL,
    ON_REQUEST,
    PAUSE,
    PAUSED,
    RESOLUTIONS,
    STOP,
    open_requests,
    withdraw,
)
from reconstruct.scene import Scene, build_scene
from reconstruct.sdf.grid import SdfGrid
from reconstruct.shadowneus.config import TrainConfig
from reconstruct.shadowneus.trainer import train
from reconstruct.solve.backend import solver_device, training_device
from reconstruct.solve.checkpoint import SolveState, load_state, save_state
from reconstruct.solve.level import Rescheduled
from reconstruct.solve.solver import SolveReporter, fit_steered
from reconstruct.source.photos import Photos, read_photos
from reconstruct.source.source import LONG_SIDES, RunOptions, Source
from reconstruct.views import Scenes

LOOK_EVERY_S = 0.25  # while paused
Continued = Callable[[FitConfig, int, str], FitConfig | None]  # schedule, levels done, preset: see presets.continued
EARLIER = "checkpoint_earlier.safetensors"  # state of a solve when a visitor of the page chose another resolution
RESOLUTION = "resolution"  # key of config.json: the preset that was chosen then


class RequestSteering:
    """A solve in a run folder, with the open requests of its folder."""

    def __init__(self, run: RunFolder, config: FitConfig | None = None, continued: Continued = lambda *_: None):
        """Set the requested schedule `config`; None: the solve has no schedule that can be changed."""
        self._run, self._config, self._continued = run, config, continued
        self.was_stopped = False  # before its schedule ended

    def wait(self, save: Callable[[], None]) -> None:
        """Wait until no pause is requested; the waiting is not counted as the run's time."""
        if PAUSE not in open_requests(self._run.path):
            return
        save()
        start = time.monotonic()
        self._run.remark(f"{PAUSED}press Go on on the page, or start it again")
        self._run.activity("")
        while PAUSE in (asked := open_requests(self._run.path)) and STOP not in asked:
            time.sleep(LOOK_EVERY_S)
        self._run.idle_s += time.monotonic() - start
        self._run.remark("going on")

    def is_stopped(self) -> bool:
        """Return True if a visitor asked to stop and save."""
        if not self.was_stopped and STOP in open_requests(self._run.path):
            self._stop("stopped and saved")
        return self.was_stopped

    def ends_level(self) -> bool:
        """Return True if a visitor asked to end this level, or to stop."""
        if NEXT_LEVEL in open_requests(self._run.path):
            withdraw(self._run.path, NEXT_LEVEL)
            self._run.remark(f"{ON_REQUEST}this round ends here")
            return True
        return self.is_stopped()

    def ends_solve(self, state: SolveState, config: FitConfig) -> bool | Rescheduled:
        """After a level, follow the requested resolution: continue with its finer levels, or stop if it adds none.

        Args:
            config: the schedule of the solve, which differs from the requested one if the scene has its own.
        """
        asked = [name for name in RESOLUTIONS if name in open_requests(self._run.path)]
        if self.was_stopped or not asked:
            return self.was_stopped
        withdraw(self._run.path, *RESOLUTIONS)
        if self._config is None or config != self._config:
            self._run.remark("the resolution stays: this kind of scene is solved in one piece")
            return False
        new = self._continued(config, state.level, asked[-1])
        if new is not None and new != config:
            self._run.remark(f"{ON_REQUEST}going on as {asked[-1]} after round {state.level}")
            return Rescheduled(state, new, asked[-1])
        if new is None and state.level < len(config.levels):
            self._stop(f"ended after round {state.level}, as fine as {asked[-1]}")
        return self.was_stopped

    def _stop(self, how: str) -> None:
        self.was_stopped = True
        withdraw(self._run.path, STOP, PAUSE)
        self._run.remark(f"{ON_REQUEST}{how}; started again, it goes on from here")


def seen_views(photos: Sequence[Photos], calibrated: CalibratedViews) -> tuple[tuple[Photos, Calibration], ...]:
    """Return photos and calibration of each calibrated view; photos as read_photos reads them."""
    by_name = {one.view: one for one in photos}
    return tuple((by_name[view.name], view.calibration) for view in calibrated.views)


def prepare_scene(source: Source, photos: Sequence[Photos], calibrated: CalibratedViews, options: RunOptions) -> Scenes:
    """Return the photos and calibration of each calibrated view as torch tensors.

    They have the preset's size, or the largest that fits into memory.

    Raises:
        ReconstructionError: no photo has a usable light, the photos differ in size from the calibrated camera's, or the
            uneven ground is above the camera.
    """
    scenes, long_side = [], LONG_SIDES[options.preset]
    for own, calibration in seen_views(photos, calibrated):
        side = long_side if own.plan is None else min(long_side, own.plan.long_side)
        scene = build_scene(own.stack, calibration, side, own.shadow, own.mask, own.ground_depth)
        name = own.view if len(calibrated.views) > 1 or calibrated.name else ""
        scenes.append(replace(scene, ground_known=source.ground_is_known(options), view=name))
    return tuple(scenes)


def solve(
    source: Source, options: RunOptions, run: RunFolder, photos: Lazy[tuple[Photos, ...]], calibrated: CalibratedViews
) -> SolvedScene:
    """Build the scenes of all views and fit the surface, or train a field; repeat for another chosen resolution.

    If a visitor stopped the solve before the end of its schedule, the stage stays open: the same command continues it.

    Raises:
        UserError: as `fit` and `train`, or a photo cannot be read.
    """
    device = (training_device if options.is_trained() else solver_device)(options.device)
    checkpoint, doubts = run.file("checkpoint.safetensors"), ()
    while True:
        resolution, config = schedule(options, run, source)
        chosen = replace(options, preset=resolution)
        read = _photos_for(chosen, source, options, run, photos)
        scenes = prepare_scene(source, read, calibrated, chosen)
        report = _reporter(run, scenes[0])
        if isinstance(config, TrainConfig):
            steering = RequestSteering(run)
            solved = train(scenes[0], config, report, checkpoint, device, steering)
        else:
            object_poses = [(one.name, prepare_scene(source, read, one, chosen)) for one in calibrated.object_poses]
            scenes, start, doubts = joined_object_poses(scenes, tuple(object_poses), config, run, report, device)
            steering = RequestSteering(run, config, continued)
            earlier = load_state(run.file(EARLIER), json.dumps(asdict(config))) or start
            solved = fit_steered(scenes, config, report, checkpoint, device, steering, earlier, run.activity)
        if not isinstance(solved, Rescheduled):
            break
        save_state(solved.state, json.dumps(asdict(solved.config)), run.file(EARLIER))  # the change takes effect
        run.write_json("config.json", asdict(solved.config) | {RESOLUTION: solved.resolution})  # with this file
    if steering.was_stopped:
        run.is_left_open = True
    else:
        forget_object_poses(run)
    run.reopen("mesh", "detail")  # of a surface that was stopped earlier
    return replace(solved, doubts=(*solved.doubts, *doubts))


def _photos_for(
    chosen: RunOptions, source: Source, options: RunOptions, run: RunFolder, photos: Lazy[tuple[Photos, ...]]
) -> tuple[Photos, ...]:
    """Return the photos at the chosen resolution's size; only those stored in the run folder stay in memory."""
    kept, read = run.file(KEPT), photos.get()
    if chosen.long_side() != options.long_side():
        plan = next((one.plan for one in read if one.error is None), None)
        return read_photos(source, chosen, kept if kept.is_dir() else None, plan)
    if not kept.is_dir():
        photos.forget()
    return read


def schedule(options: RunOptions, run: RunFolder, source: Source) -> tuple[str, FitConfig | TrainConfig]:
    """Return the preset that sets the working size, and the solver's settings.

    Both are kept in config.json, so that a resumed run keeps the choice of a time budget or a visitor of the page.
    """
    if options.is_trained():
        _, trained = training(options.preset, options.field, options.ablate, options.seed)
        run.write_json("config.json", asdict(trained))
        return options.preset, trained
    path = run.file("config.json")
    try:
        kept = read_json(path) if path.exists() else {}
        resolution = kept.pop(RESOLUTION, options.preset)
        if kept and (options.time_budget is not None or resolution != options.preset):
            if resolution not in LONG_SIDES:
                raise ValueError(f"the resolution {resolution!r}")
            return resolution, msgspec.convert(kept, FitConfig)
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise ReconstructionError(
            f"{path} holds no settings of a solver ({why(error)}).", Remedy.START_AGAIN, Remedy.OTHER_FOLDER
        ) from error
    config = solver_config(options)
    if options.time_budget is not None:
        config = within_budget(config, options.time_budget, work_of(source, options))
    run.write_json("config.json", asdict(config))
    return options.preset, config


def _reporter(run: RunFolder, scene: Scene) -> SolveReporter:
    """Return a callback that writes the reports of `fit` to the run folder: log lines, and sometimes a coarse mesh."""
    colours = Lazy(lambda: PhotoColours(scene.posed_camera, scene.rgb))

    def report(
        *, stage: str, done: int, total: int, message: str, numbers: dict[str, float], surface: SdfGrid | None
    ) -> None:
        losses = {f"loss_{name}": value for name, value in numbers.items()}
        mesh = None if surface is None else preview_mesh(surface, scene.ground_height)
        mesh = None if mesh is None else colours.get().coloured(mesh)
        if mesh is not None and stage == "hull":
            with atomic_file(run.file("hull.ply")) as path:
                mesh.export(path)
        run.progress(stage, done, total, message, losses, mesh)

    return report
