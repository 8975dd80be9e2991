"""Stage "solve": build the scene and fit a surface to it, on a schedule that visitors of the page can change.

Carry out requests from visitors of a run's page: pause, next level, stop, another resolution.

Of an object that was laid anew, each pose is solved small on its own, then all are laid together.
"""

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import count

import msgspec
import torch

from calibration.calibrated_views import CalibratedViews, save_views
from calibration.calibration import Calibration
from capture.errors import ReconstructionError, Remedy
from capture.files.atomic import atomic_file, read_json
from capture.files.regular import why
from capture.files.schema import read_kept
from reconstruct.config import FitConfig
from reconstruct.fields import SolvedScene, load_fields, save_fields
from reconstruct.mesh.mesh import extract_mesh, preview_mesh
from reconstruct.mesh.texture import PhotoColours
from reconstruct.object_poses.confirmed import confirmed, withheld
from reconstruct.object_poses.together import PlacedObjectPose, SolvedObjectPose, Together, lay_together
from reconstruct.run.machine import within_budget, work_of
from reconstruct.run.presets import continued, preset, solver_config, training
from reconstruct.run_folder.folder import KEPT, PLAN, RunFolder
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
from reconstruct.scene import Scene, build_scene, reduced
from reconstruct.sdf.grid import SdfGrid
from reconstruct.shadowneus.config import TrainConfig
from reconstruct.shadowneus.trainer import train
from reconstruct.solve.backend import solver_device, training_device
from reconstruct.solve.checkpoint import SolveState, load_state, save_state
from reconstruct.solve.level import Rescheduled
from reconstruct.solve.solver import SolveReporter, begun, fit, fit_steered, fit_surface
from reconstruct.source.photos import Photos, Plan, memory_plan, read_photos, within_plan
from reconstruct.source.source import LONG_SIDES, RunOptions, Source
from reconstruct.stored_run.stored_run import CALIBRATION
from reconstruct.views import Scenes

SMALL = "draft"  # preset of the poses' own solves: enough for how the object was turned
KEPT_OBJECT_POSE = "checkpoint_object_pose"  # file of a pose's own solve, while the run needs it
NOT_JOINED = "mesh.ply"  # of a pose that could not be laid on the others, in a folder of its name

ObjectPoses = tuple[tuple[str, Scenes], ...]  # name and scenes of each further pose, in its own world
# Of torch: sums depend on it, and a kernel that numba ran in parallel before would leave OpenMP as many as cores.
THREADS = torch.get_num_threads()
LOOK_EVERY_S = 0.25  # while paused
Continued = Callable[[FitConfig, int, str], FitConfig | None]  # schedule, levels done, preset: see presets.continued
EARLIER = "checkpoint_earlier.safetensors"  # state of a solve when a visitor of the page chose another resolution
RESOLUTION = "resolution"  # key of config.json: the preset that was chosen then


def joined_object_poses(
    scenes: Scenes,
    object_poses: ObjectPoses,
    config: FitConfig,
    run: RunFolder,
    report: SolveReporter,
    device: torch.device | None,
) -> tuple[Scenes, SolveState | None, tuple[str, ...]]:
    """Return the scenes of all poses that can be laid together, the state that their solve begins with, and doubts.

    Raises:
        ReconstructionError: the first pose cannot be solved.
    """
    if not (object_poses and scenes[0].ground_known):
        return scenes, None, ()
    together = _SmallSolves(run, report, device, config.seed).laid_together(scenes, object_poses)
    scenes, doubts = joined_scenes(scenes, object_poses, together.placed), tuple(text for _, text in together.refused)
    start = begun(together.start, min(1, len(config.levels) - 1)) if together.placed else None
    return scenes, start, doubts


def joined_scenes(scenes: Scenes, object_poses: ObjectPoses, placed: tuple[PlacedObjectPose, ...]) -> Scenes:
    """Return the scenes of the first pose and of all that were placed, these with the motion to the first."""
    motions = {one.name: one.motion for one in placed}
    moved = [replace(s, object_from_world=motions[name]) for name, own in object_poses if name in motions for s in own]
    return (*scenes, *moved)


@dataclass(frozen=True)
class _SmallSolves:
    """Small solves of poses, kept in the run folder, so that a run that was stopped does not repeat them."""

    run: RunFolder
    report: SolveReporter
    device: torch.device | None
    seed: int

    def laid_together(self, scenes: Scenes, object_poses: ObjectPoses) -> Together:
        """Solve the first pose's scenes and each further pose's, and find how these lie in the world of the first.

        A pose that cannot be solved or placed is named in the result's `refused`; if it was solved, its own mesh is
        written.

        Raises:
            ReconstructionError: the first pose cannot be solved.
            OSError: a file cannot be written.
        """
        solved, refused = [], []
        for number, (name, own) in enumerate((("", scenes), *object_poses)):
            small = tuple(reduced(scene, LONG_SIDES[SMALL]) for scene in own)
            try:
                solved.append(SolvedObjectPose(name, small, self._alone(withheld(small, self.seed), name, number)))
            except ReconstructionError as error:
                if not name:
                    raise
                refused.append((name, f"{name} is left out: {error}"))
        together = lay_together(tuple(solved), self.seed, self.run.activity)
        for one in together.placed:
            self.run.progress(message=one.sentence())
        known = tuple((one.name, withheld(one.scenes, self.seed)) for one in solved)
        attempts = count()

        def solve(placed: tuple[PlacedObjectPose, ...], start: SdfGrid) -> SdfGrid:
            return self._all(joined_scenes(known[0][1], known[1:], placed), start, next(attempts))

        together = confirmed(solved, together, solve, self.seed, lambda text: self.run.progress(message=text))
        for name, sentence in together.refused:
            refused.append((name, f"{sentence} What it shows is left out; its own surface is in {name}/{NOT_JOINED}."))
            alone = next(one.fields for one in solved if one.name == name)
            with atomic_file(self.run.file(f"{name}/{NOT_JOINED}")) as mesh:
                extract_mesh(alone).export(mesh, file_type="ply")
        for _, sentence in refused:
            self.run.progress(message=sentence)
        return replace(together, refused=tuple(refused))

    def _alone(self, scenes: Scenes, name: str, number: int) -> SolvedScene:
        """Return a pose's own solve, from its file if there is one."""
        path = self.run.file(f"{KEPT_OBJECT_POSE}_{number}.safetensors")
        if path.is_file():
            return load_fields(path)
        _, config = preset(SMALL, self.seed)
        called = f"{name or 'the first object pose'}, small"
        say = lambda text: self.run.activity(f"{called}: {text}")  # noqa: E731
        found = fit(scenes, config, _part(called, self.report), device=self.device, say=say)
        save_fields(found, path)
        return found

    def _all(self, scenes: Scenes, start: SdfGrid, attempt: int) -> SdfGrid:
        """Return the small surface of the first pose and those that were placed."""
        _, config = preset(SMALL, self.seed)
        path = self.run.file(f"{KEPT_OBJECT_POSE}_all_{attempt}.safetensors")
        earlier, part = begun(start, len(config.levels) - 1), _part("all object poses, small", self.report)
        return fit_surface(scenes, config, part, path, self.device, earlier, self.run.activity)


def _part(called: str, report: SolveReporter) -> SolveReporter:
    """Return a callback that reports a small solve as a part of what precedes the solve of all."""
    return lambda *, message, **step: report(
        **step | {"stage": "hull", "message": f"{called}: {message}", "numbers": {}, "surface": None}
    )


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


def prepare_scene(
    source: Source, photos: Sequence[Photos], calibrated: CalibratedViews, options: RunOptions, plan: Plan | None = None
) -> Scenes:
    """Return the photos and calibration of each calibrated view as torch tensors.

    They have the preset's size, or the largest that fits into memory.

    Args:
        plan: what fits, where that was decided and `calibrated` keeps to it; decided now unless given.

    Raises:
        CaptureError: the first photo cannot be read.
        ReconstructionError: no photo has a usable light, the photos differ in size from the calibrated camera's, or the
            uneven ground is above the camera.
    """
    if plan is None and (plan := memory_plan(source, options)) is not None:
        calibrated = within_plan(calibrated, plan, len(source.photos()))
    scenes, long_side = [], LONG_SIDES[options.preset] if plan is None else plan.long_side
    for own, calibration in seen_views(photos, calibrated):
        scene = build_scene(own.stack, calibration, long_side, own.shadow, own.mask, own.ground_depth)
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
    torch.set_num_threads(THREADS)
    device = (training_device if options.is_trained() else solver_device)(options.device)
    checkpoint, doubts = run.file("checkpoint.safetensors"), ()
    while True:
        resolution, config = schedule(options, run, source)
        chosen = replace(options, preset=resolution)
        plan = kept_plan(source, chosen, run)
        calibrated = _within_memory(source, plan, run, calibrated)
        read = _photos_for(chosen, source, options, run, photos)
        scenes = prepare_scene(source, read, calibrated, chosen, plan)
        report = _reporter(run, scenes[0])
        if isinstance(config, TrainConfig):
            steering = RequestSteering(run)
            solved = train(scenes[0], config, report, checkpoint, device, steering)
        else:
            anew = calibrated.object_poses
            object_poses = [(one.name, prepare_scene(source, read, one, chosen, plan)) for one in anew]
            scenes, start, doubts = joined_object_poses(scenes, tuple(object_poses), config, run, report, device)
            steering = RequestSteering(run, config, continued)
            earlier = load_state(run.file(EARLIER), json.dumps(asdict(config))) or start
            solved = fit_steered(scenes, config, report, checkpoint, device, steering, earlier, run.activity)
        if not isinstance(solved, Rescheduled):
            break
        run.discard(PLAN)
        save_state(solved.state, json.dumps(asdict(solved.config)), run.file(EARLIER))  # the change takes effect
        run.write_json("config.json", asdict(solved.config) | {RESOLUTION: solved.resolution})  # with this file
    if steering.was_stopped:
        run.is_left_open = True
    else:
        run.discard(f"{KEPT_OBJECT_POSE}_*")
    run.reopen("mesh", "detail")  # of a surface that was stopped earlier
    return replace(solved, doubts=(*solved.doubts, *doubts))


def kept_plan(source: Source, options: RunOptions, run: RunFolder) -> Plan | None:
    """Return what fits into memory, decided and said once for all invocations of a run; None for a trained field."""
    plan = read_kept(run.file(PLAN), Plan)
    if plan is None and (plan := memory_plan(source, options)) is not None:
        run.write_json(PLAN, asdict(plan))
        run.progress(message=plan.sentence)
    return plan


def _within_memory(source: Source, plan: Plan | None, run: RunFolder, calibrated: CalibratedViews) -> CalibratedViews:
    """Return the calibrations with as many photos in use as the plan allows, and update calibration.json."""
    if plan is None:
        return calibrated
    thinned = within_plan(calibrated, plan, len(source.photos()))
    used = [[x.used for one in some.every() for x in one.calibration.lights] for some in (calibrated, thinned)]
    if used[0] != used[1]:
        save_views(thinned, run.file(CALIBRATION))
    return thinned


def _photos_for(
    chosen: RunOptions, source: Source, options: RunOptions, run: RunFolder, photos: Lazy[tuple[Photos, ...]]
) -> tuple[Photos, ...]:
    """Return the photos at the chosen resolution's size; only those stored in the run folder stay in memory."""
    kept, read = run.file(KEPT), photos.get()
    if chosen.long_side() != options.long_side():
        return read_photos(source, chosen, kept if kept.is_dir() else None)
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
