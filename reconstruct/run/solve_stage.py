"""Stage "solve": build the scene and fit a surface to it, on a schedule that visitors of the page can change."""

import json
from collections.abc import Sequence
from dataclasses import asdict, replace

from calibration.calibrated_views import CalibratedViews
from calibration.calibration import Calibration
from capture.errors import CaptureError, ReconstructionError
from capture.files.atomic import read_json
from capture.files.regular import why
from reconstruct.config import FitConfig
from reconstruct.fields import Fields
from reconstruct.mesh.mesh import preview_mesh
from reconstruct.mesh.photo_colours import PhotoColours
from reconstruct.run.lies_stage import Lies, forget_lies, joined_scenes, lay_lies_together
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
from reconstruct.solve.solver import SolveReporter, begun, fit
from reconstruct.solve.steering import Rescheduled
from reconstruct.source.options import LONG_SIDES, RunOptions
from reconstruct.source.photos import Photos, read_views
from reconstruct.source.source import Source
from reconstruct.views import Scenes

EARLIER = "checkpoint_earlier.safetensors"  # state of a solve when a visitor of the page chose another resolution
AllPhotos = tuple[Photos | CaptureError, ...]  # of all views, see read_views
RESOLUTION = "resolution"  # key of config.json: the preset that was chosen then


SeenView = tuple[str, Photos, Calibration]  # of one camera: its view's name, "" where there is one


def seen_views(
    source: Source, photos: Sequence[Photos | CaptureError], calibrated: CalibratedViews
) -> tuple[SeenView, ...]:
    """Return what is known of each calibrated view of a source.

    Args:
        photos: as read_views reads them, in the order of source.views().
    """
    names = ["" if view.capture is None else view.capture.name for view in source.views()]
    if len(names) == 1:
        names = [calibrated.views[0].name]
    found = dict(zip(names, photos, strict=True))
    views = [(view.name, found[view.name], view.calibration) for view in calibrated.views]
    return tuple((name, own, calibration) for name, own, calibration in views if isinstance(own, Photos))


def prepare_views(source: Source, views: Sequence[SeenView], options: RunOptions) -> Scenes:
    """Return the scene of each view, see prepare_scene.

    Raises:
        ReconstructionError: as of prepare_scene.
    """
    names = [name if len(views) > 1 else "" for name, _, _ in views]
    scenes = [prepare_scene(source, photos, calibration, options) for _, photos, calibration in views]
    return tuple(replace(scene, view=name) for name, scene in zip(names, scenes, strict=True))


def _lies(source: Source, photos: AllPhotos, calibrated: CalibratedViews, options: RunOptions) -> Lies:
    """Return the scenes of each further lie, in its own world."""
    found = []
    for lie in calibrated.lies:
        views = seen_views(source, photos, lie)
        if views:
            scenes = zip(prepare_views(source, views, options), views, strict=True)
            found.append((lie.name, tuple(replace(scene, view=view[0]) for scene, view in scenes)))
    return tuple(found)


def prepare_scene(source: Source, photos: Photos, calibration: Calibration, options: RunOptions) -> Scene:
    """Return photos and calibration as torch tensors, at the preset's size or the largest that fits into memory.

    Raises:
        ReconstructionError: no photo has a usable light, the photos differ in size from the calibrated camera's, or the
            uneven ground is above the camera.
    """
    long_side = LONG_SIDES[options.preset]
    if photos.plan is not None:
        long_side = min(long_side, photos.plan.long_side)
    scene = build_scene(photos.stack, calibration, long_side, photos.shadow, photos.mask, photos.ground_depth)
    return replace(scene, ground_known=source.ground_is_known(options))


def solve(
    source: Source, options: RunOptions, run: RunFolder, photos: Lazy[AllPhotos], calibrated: CalibratedViews
) -> Fields:
    """Build the scenes of all views and fit the surface, or train a field; repeat for another chosen resolution.

    If a visitor stopped the solve before the end of its schedule, the stage stays open: the same command continues it.

    Raises:
        UserError: as `fit` and `train`, or a photo cannot be read.
    """
    device = (training_device if options.is_trained() else solver_device)(options.device)
    checkpoint = run.file("checkpoint.safetensors")
    while True:
        resolution, config = schedule(options, run, source)
        chosen = replace(options, preset=resolution)
        found = _photos_for(chosen, source, options, run, photos)
        scenes = prepare_views(source, seen_views(source, found, calibrated), chosen)
        report = _reporter(run, scenes[0])
        if isinstance(config, TrainConfig):
            steering = RequestSteering(run)
            fields = train(scenes[0], config, report, checkpoint, device, steering)
            break
        lies = _lies(source, found, calibrated, chosen) if source.ground_is_known(options) else ()
        start, doubts = None, ()
        if lies:
            together = lay_lies_together(scenes, lies, config.seed, run, report, device)
            scenes = joined_scenes(scenes, lies, together.placed)
            doubts = tuple(text for _, text in together.refused)
            if together.placed:
                start = begun(together.start, min(1, len(config.levels) - 1), scenes)
        steering = RequestSteering(run, config, continued)
        try:
            earlier = load_state(run.file(EARLIER), json.dumps(asdict(config))) or start
            fields = fit(scenes, config, report, checkpoint, device, steering, earlier, run.activity)
            fields = replace(fields, doubts=(*fields.doubts, *doubts))
            break
        except Rescheduled as change:
            _reschedule(change, run)
    if steering.was_stopped:
        run.leave_open()
    else:
        forget_lies(run)
    run.reopen("mesh", "detail")  # of a surface that was stopped earlier
    return fields


def _photos_for(
    chosen: RunOptions, source: Source, options: RunOptions, run: RunFolder, photos: Lazy[AllPhotos]
) -> AllPhotos:
    """Return the photos at the chosen resolution's size; only those stored in the run folder stay in memory."""
    kept, pictures = run.file(KEPT), photos.get()
    if chosen.long_side() != options.long_side():
        plan = next((one.plan for one in pictures if isinstance(one, Photos)), None)
        return read_views(source, chosen, kept if kept.is_dir() else None, plan)
    if not kept.is_dir():
        photos.forget()
    return pictures


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
            f"{path} holds no settings of a solver ({why(error)}). Give --force to start again, or another --out."
        ) from error
    config = solver_config(options)
    if options.time_budget is not None:
        config = within_budget(config, options.time_budget, work_of(source, options))
    run.write_json("config.json", asdict(config))
    return options.preset, config


def _reschedule(change: Rescheduled, run: RunFolder) -> None:
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
