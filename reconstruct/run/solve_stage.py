"""Stage "solve": build the scene and fit a surface to it, on a schedule that visitors of the page can change."""

import json
from collections.abc import Sequence
from dataclasses import asdict, replace

from calibration.calibrated_views import CalibratedViews
from calibration.calibration import Calibration
from capture.errors import ReconstructionError, Remedy
from capture.files.atomic import read_json
from capture.files.regular import why
from reconstruct.config import FitConfig
from reconstruct.fields import Fields
from reconstruct.mesh.mesh import preview_mesh
from reconstruct.mesh.photo_colours import PhotoColours
from reconstruct.run.lies_stage import forget_lies, joined_lies
from reconstruct.run.machine import within_budget, work_of
from reconstruct.run.presets import config_from_json, continued, solver_config, training
from reconstruct.run.request_steering import RequestSteering
from reconstruct.run_folder.folder import KEPT, RunFolder
from reconstruct.run_folder.once import Lazy
from reconstruct.scene import Scene, build_scene
from reconstruct.sdf.grid import SdfGrid
from reconstruct.shadowneus.config import TrainConfig
from reconstruct.shadowneus.trainer import train
from reconstruct.solve.backend import solver_device, training_device
from reconstruct.solve.checkpoint import load_state, save_state
from reconstruct.solve.solver import SolveReporter, fit_steered
from reconstruct.solve.steering import Rescheduled
from reconstruct.source.options import LONG_SIDES, RunOptions
from reconstruct.source.photos import Photos, read_photos
from reconstruct.source.source import Source
from reconstruct.views import Scenes

EARLIER = "checkpoint_earlier.safetensors"  # state of a solve when a visitor of the page chose another resolution
RESOLUTION = "resolution"  # key of config.json: the preset that was chosen then


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
) -> Fields:
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
            lies = [(lie.name, prepare_scene(source, read, lie, chosen)) for lie in calibrated.lies]
            scenes, start, doubts = joined_lies(scenes, tuple(lies), config, run, report, device)
            steering = RequestSteering(run, config, continued)
            earlier = load_state(run.file(EARLIER), json.dumps(asdict(config))) or start
            solved = fit_steered(scenes, config, report, checkpoint, device, steering, earlier, run.activity)
        if not isinstance(solved, Rescheduled):
            break
        _keep_schedule(solved, run)
    if steering.was_stopped:
        run.leave_open()
    else:
        forget_lies(run)
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
            return resolution, config_from_json(kept)
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise ReconstructionError(
            f"{path} holds no settings of a solver ({why(error)}).", Remedy.START_AGAIN, Remedy.OTHER_FOLDER
        ) from error
    config = solver_config(options)
    if options.time_budget is not None:
        config = within_budget(config, options.time_budget, work_of(source, options))
    run.write_json("config.json", asdict(config))
    return options.preset, config


def _keep_schedule(change: Rescheduled, run: RunFolder) -> None:
    """Store the current state and the new schedule; the change takes effect with the second file, config.json."""
    save_state(change.state, json.dumps(asdict(change.config)), run.file(EARLIER))
    run.write_json("config.json", asdict(change.config) | {RESOLUTION: change.resolution})


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
            with run.writing("hull.ply") as path:
                mesh.export(path)
        run.progress(stage, done, total, message, losses, mesh)

    return report
