"""Stage "solve": the scene is built and a surface fitted to it, on a schedule that visitors of the page can change."""

import json
from dataclasses import asdict, replace

from calibration.calibration import Calibration
from reconstruct.config import FitConfig
from reconstruct.fields import Fields
from reconstruct.mesh.mesh import preview_mesh
from reconstruct.run.machine import within_budget
from reconstruct.run.presets import config_from_json, continued, solver_config, training
from reconstruct.run.steering import Steered
from reconstruct.run_folder.folder import KEPT, RunFolder
from reconstruct.run_folder.once import Later
from reconstruct.scene import Scene, build_scene
from reconstruct.sdf.grid import SdfGrid
from reconstruct.shadowneus.config import TrainConfig
from reconstruct.shadowneus.trainer import train
from reconstruct.solve.backend import solver_device, training_device
from reconstruct.solve.checkpoint import load_state, save_state
from reconstruct.solve.solver import Report, fit
from reconstruct.solve.steering import Rescheduled
from reconstruct.source.options import LONG_SIDES, RunOptions
from reconstruct.source.photos import Photos, read_photos
from reconstruct.source.source import Source

EARLIER = "checkpoint_earlier.safetensors"  # where a solve stood when a visitor of the page chose another resolution
RESOLUTION = "resolution"  # key of config.json: the preset that was chosen then


def prepare_scene(source: Source, photos: Photos, calibration: Calibration, options: RunOptions) -> Scene:
    """The photos and their calibration as torch tensors, at the preset's size or what of it fits into memory."""
    long_side = LONG_SIDES[options.preset]
    if photos.plan is not None:
        long_side = min(long_side, photos.plan.long_side)
    scene = build_scene(photos.stack, calibration, long_side, photos.shadow, photos.mask, photos.ground_depth)
    return replace(scene, ground_known=source.ground_is_known(options))


def solve(
    source: Source, options: RunOptions, run: RunFolder, photos: Later[Photos], calibration: Calibration
) -> Fields:
    """Build the scene and fit the surface, or train a field; again where a visitor chose another resolution.

    Where a visitor stopped the solve before the end of its schedule, the stage is left open: the same command goes on.
    """
    device = (training_device if options.is_trained() else solver_device)(options.device)
    checkpoint = run.file("checkpoint.safetensors")
    while True:
        resolution, config = schedule(options, run)
        chosen = replace(options, preset=resolution)
        scene = prepare_scene(source, _photos_for(chosen, source, options, run, photos), calibration, chosen)
        report = _reporter(run, scene.ground_height)
        if isinstance(config, TrainConfig):
            steering = Steered(run)
            fields = train(scene, config, report, checkpoint, device, steering)
            break
        steering = Steered(run, config, continued)
        try:
            earlier = load_state(run.file(EARLIER), json.dumps(asdict(config)))
            fields = fit(scene, config, report, checkpoint, device, steering, earlier)
            break
        except Rescheduled as change:
            _reschedule(change, run)
    if steering.was_stopped:
        run.leave_open()
    run.reopen("mesh", "detail")  # of a surface that was stopped earlier
    return fields


def _photos_for(
    chosen: RunOptions, source: Source, options: RunOptions, run: RunFolder, photos: Later[Photos]
) -> Photos:
    """The photos at the size that the chosen resolution needs; only those that lie in the run folder stay in memory."""
    kept, pictures = run.file(KEPT), photos.get()
    if chosen.long_side() != options.long_side():
        return read_photos(source, chosen, kept if kept.is_dir() else None, pictures.plan)
    if not kept.is_dir():
        photos.forget()
    return pictures


def schedule(options: RunOptions, run: RunFolder) -> tuple[str, FitConfig | TrainConfig]:
    """The preset whose working size counts, and the solver's settings.

    Kept in config.json, so that a resumed run keeps what a time budget or a visitor of the page chose.
    """
    if options.is_trained():
        _, trained = training(options.preset, options.field, options.ablate, options.seed)
        run.write_json("config.json", asdict(trained))
        return options.preset, trained
    path = run.file("config.json")
    kept = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    resolution = kept.pop(RESOLUTION, options.preset)
    if kept and (options.time_budget is not None or resolution != options.preset):
        return resolution, config_from_json(kept)
    config = solver_config(options)
    if options.time_budget is not None:
        config = within_budget(config, options.time_budget)
    run.write_json("config.json", asdict(config))
    return options.preset, config


def _reschedule(change: Rescheduled, run: RunFolder) -> None:
    """Have `schedule` and the earlier state say what is to be done from now on; the second file makes it so."""
    save_state(change.state, json.dumps(asdict(change.config)), run.file(EARLIER))
    run.write_json("config.json", asdict(change.config) | {RESOLUTION: change.resolution})


def _reporter(run: RunFolder, ground_height: float) -> Report:
    """Tells a run folder what `fit` reports: the log, and now and then a coarse mesh to look at."""

    def tell(
        *, stage: str, done: int, total: int, message: str, numbers: dict[str, float], surface: SdfGrid | None
    ) -> None:
        losses = {f"loss_{name}": value for name, value in numbers.items()}
        mesh = None if surface is None else preview_mesh(surface, ground_height)
        if mesh is not None and stage == "hull":
            with run.writing("hull.ply") as path:
                mesh.export(path)
        run.progress(stage, done, total, message, losses, mesh)

    return tell
