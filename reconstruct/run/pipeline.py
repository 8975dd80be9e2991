"""A whole run, stage by stage: photos on disk to calibration, surface, mesh and maps in a run folder."""

import json
import platform
import shutil
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from calibration.calibration import Calibration, load_calibration, save_calibration
from capture.decode.formats import read_size
from capture.errors import CaptureError
from capture.photos.photo import read_thumbnail
from reconstruct.run.memory import Plan, keep_spread, plan_for, read_plan
from reconstruct.run.options import CALIBRATION_LONG_SIDE, LONG_SIDES, RunOptions
from reconstruct.run.report_json import summary, versions
from reconstruct.run.source import Pictures, Source, calibrate_source, read_pictures
from reconstruct.run_folder.cost import memory_room
from reconstruct.run_folder.folder import KEPT, PLAN, RunFolder, content_hash

if TYPE_CHECKING:
    from reconstruct.fields import Fields
    from reconstruct.scene import Scene
    from reconstruct.sdf.grid import SdfGrid
    from reconstruct.shadowneus.config import TrainConfig
    from reconstruct.solve.checkpoint import SolveState
    from reconstruct.solve.solver import FitConfig, Report
    from reconstruct.solve.steering import Rescheduled

THUMBNAIL_LONG_SIDE = 320  # px: what a browser panel shows
THUMBNAIL_QUALITY = 88  # JPEG: artefacts do not show at this size
EARLIER = "checkpoint_earlier.safetensors"  # where a solve stood when a visitor of the page chose another resolution
KEPT_PER_PIXEL = 13  # bytes of each photo kept: three float32 and a flag
RESOLUTION = "resolution"  # key of config.json: the preset that was chosen then
ADDED_LATER = ("detail",)  # options that a finished run can still be given: they change nothing of what is there
CALIBRATION_OPTIONS = ("board", "input", "lights", "split", "light_error", "ground")


def run_calibration(source: Source, options: RunOptions, run: RunFolder) -> Calibration:
    """Stages "capture" and "calibrate"; an earlier result is read back."""
    if run.is_finished("calibrate"):
        return load_calibration(run.file("calibration.json"))
    with run.stage("capture", f"reading {len(source.photos())} photos", leaves_files=False):
        if not options.is_trained():
            run.progress(message=_memory_plan(source, options, run).sentence)
        pictures = _pictures(source, options, run)
        _write_thumbnails(source.photos(), run)
    with run.stage("calibrate", "finding camera, ground and lights"):
        calibration = calibrate_source(source, pictures, options)
        save_calibration(calibration, run.file("calibration.json"))
    return calibration


def _pictures(source: Source, options: RunOptions, run: RunFolder) -> Pictures:
    """The pictures, mapped from the run folder as long as the run needs them, where the disk has room for that."""
    photos, longest = source.photos(), 2 * max(CALIBRATION_LONG_SIDE, LONG_SIDES[options.preset]) ** 2
    has_room = shutil.disk_usage(run.path).free > KEPT_PER_PIXEL * longest * len(photos)
    return read_pictures(source, options, run.file(KEPT) if has_room else None)


def run_reconstruction(source: Source, options: RunOptions, run: RunFolder, calibration: Calibration) -> None:
    """Stages "solve", "mesh" and "detail": everything else a run leaves, except the page of the report."""
    from reconstruct.fields import load_fields, save_fields
    from reconstruct.mesh.mesh import extract_mesh, mesh_material, save_mesh
    from reconstruct.run.detail_stage import detail_is_due, run_detail
    from reconstruct.run.machine import kernels_are_compiled
    from reconstruct.solve.backend import backend_name, solver_device

    if not run.is_finished("solve"):
        calibration = _within_memory(source, options, run, calibration)
        compiling = "" if kernels_are_compiled() else "; compiling its kernels first, once on this machine"
        device = solver_device(options.device)
        fitting = "training a field" if options.is_trained() else f"fitting the surface by {backend_name(device)}"
        with run.stage("solve", f"{fitting}{compiling}"):
            solved, was_stopped = _solved(source, options, run, calibration)
            save_fields(solved, run.file("fields.safetensors"))
        run.reopen("mesh", "detail", *(["solve"] if was_stopped else []))
    due = detail_is_due(source, options, run)
    if run.is_finished("solve") and not due:
        run.discard(KEPT)
    if run.is_finished("mesh") and run.file("report.json").exists() and not due:  # a kill may come between them
        return
    solved = load_fields(run.file("fields.safetensors"))
    with run.stage("mesh", "extracting the mesh"):
        mesh = extract_mesh(solved)
        save_mesh(mesh, run.file("mesh.ply"), run.file("mesh.glb"), solved.unit, mesh_material(solved, mesh))
        _write_maps(solved, calibration, run)
    if due:
        run_detail(source, options, run, calibration, solved)
        if run.is_finished("solve"):
            run.discard(KEPT)
    run.write_json("report.json", summary(source, options, run, calibration, mesh, solved))


def _solved(source: Source, options: RunOptions, run: RunFolder, calibration: Calibration) -> tuple["Fields", bool]:
    """The solved scene, and whether a visitor of the page stopped the solve before the end of its schedule."""
    from reconstruct.run.presets import continued
    from reconstruct.run.steering import Steered
    from reconstruct.shadowneus.config import TrainConfig
    from reconstruct.shadowneus.trainer import train
    from reconstruct.solve.backend import solver_device
    from reconstruct.solve.solver import fit
    from reconstruct.solve.steering import Rescheduled

    device, checkpoint = solver_device(options.device), run.file("checkpoint.safetensors")
    while True:
        resolution, config = _schedule(options, run)
        scene = _scene(source, replace(options, preset=resolution), run, calibration)
        report = _reporter(run, scene.ground_height)
        if isinstance(config, TrainConfig):
            steering = Steered(run)
            return train(scene, config, report, checkpoint, device, steering), steering.was_stopped
        steering = Steered(run, config, continued)
        try:
            earlier = _earlier(config, run)
            return fit(scene, config, report, checkpoint, device, steering, earlier), steering.was_stopped
        except Rescheduled as change:
            _reschedule(change, run)


def _scene(source: Source, options: RunOptions, run: RunFolder, calibration: Calibration) -> "Scene":
    """What the solver is given. The photos themselves are not in memory any more when this is done."""
    from reconstruct.scene import build_scene

    pictures = _pictures(source, options, run)
    given = (pictures.shadow, pictures.mask, pictures.ground_depth)
    plan = read_plan(run.file(PLAN))
    long_side = min(LONG_SIDES[options.preset], plan.long_side if plan else LONG_SIDES[options.preset])
    scene = build_scene(pictures.stack, calibration, long_side, *given)
    scene = replace(scene, ground_known=source.ground_is_known(options))
    if source.session is not None and scene.ground_known:
        _heed_check(scene, calibration, pictures, run)
    return scene


def _memory_plan(source: Source, options: RunOptions, run: RunFolder) -> Plan:
    """What fits into memory, decided once for all invocations of a run."""
    plan = read_plan(run.file(PLAN))
    if plan is None:
        room = float(memory_room()) if options.memory is None else 1e9 * options.memory
        plan = plan_for(len(source.photos()), *read_size(source.photos()[0]), options.preset, room)
        run.write_json(PLAN, asdict(plan))
    return plan


def _within_memory(source: Source, options: RunOptions, run: RunFolder, calibration: Calibration) -> Calibration:
    """The calibration with as many photos in use as the plan allows; calibration.json says so, too."""
    if options.is_trained():
        return calibration
    thinned = keep_spread(calibration, _memory_plan(source, options, run).photos)
    if [light.used for light in thinned.lights] != [light.used for light in calibration.lights]:
        save_calibration(thinned, run.file("calibration.json"))
    return thinned


def _earlier(config: "FitConfig", run: RunFolder) -> "SolveState | None":
    """Where another schedule came to before it was exchanged for this one."""
    from reconstruct.solve.checkpoint import load_state

    return load_state(run.file(EARLIER), json.dumps(asdict(config)))


def _reschedule(change: "Rescheduled", run: RunFolder) -> None:
    """Have `_schedule` and `_earlier` say what is to be done from now on; the second file makes it so."""
    from reconstruct.solve.checkpoint import save_state

    save_state(change.state, json.dumps(asdict(change.config)), run.file(EARLIER))
    run.write_json("config.json", asdict(change.config) | {RESOLUTION: change.resolution})


def _heed_check(scene: "Scene", calibration: Calibration, pictures: Pictures, run: RunFolder) -> None:
    """check.json: what `shadowgraph check` would say; a hopeless capture ends the run, the rest becomes warnings."""
    from reconstruct.run.check import judge, refuse_hopeless, tone_doubts
    from reconstruct.run.light_coverage import shadow_cover

    doubts = () if pictures.stack is None else tone_doubts(pictures.stack, calibration)
    readiness = judge(calibration, pictures.findings, shadow_cover(scene), doubts)
    run.write_json("check.json", readiness.document())
    run.progress(message=readiness.sentence())
    refuse_hopeless(readiness)


def _schedule(options: RunOptions, run: RunFolder) -> tuple[str, "FitConfig | TrainConfig"]:
    """The preset whose working size counts, and the solver's settings.

    Kept in config.json, so that a resumed run keeps what a time budget or a visitor of the page chose.
    """
    from reconstruct.run.machine import within_budget
    from reconstruct.run.presets import config_from_json, preset, training, without

    if options.is_trained():
        _, trained = training(options.preset, options.field, options.ablate, options.seed)
        run.write_json("config.json", asdict(trained))
        return options.preset, trained
    path = run.file("config.json")
    kept = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    resolution = kept.pop(RESOLUTION, options.preset)
    if kept and (options.time_budget is not None or resolution != options.preset):
        return resolution, config_from_json(kept)
    _, config = preset(options.preset, options.seed)
    config = without(config, options.ablate)
    if options.time_budget is not None:
        config = within_budget(config, options.time_budget)
    run.write_json("config.json", asdict(config))
    return options.preset, config


def _reporter(run: RunFolder, ground_height: float) -> "Report":
    """Tells a run folder what `fit` reports: the log, and now and then a coarse mesh to look at."""
    from reconstruct.mesh.mesh import preview_mesh

    def tell(
        *, stage: str, done: int, total: int, message: str, numbers: dict[str, float], surface: "SdfGrid | None"
    ) -> None:
        losses = {f"loss_{name}": value for name, value in numbers.items()}
        mesh = None if surface is None else preview_mesh(surface, ground_height)
        if mesh is not None and stage == "hull":
            with run.writing("hull.ply") as path:
                mesh.export(path)
        run.progress(stage, done, total, message, losses, mesh)

    return tell


def claim(source: Source, options: RunOptions, run: RunFolder, stages: str, force: bool) -> None:
    """Tie the run folder to this capture and these options.

    Args:
        stages: "run", "calibrate" or "reconstruct": `calibrate` says nothing yet about the solver's options.
        force: start again; after `reconstruct` only the reconstruction.
    """
    names = [f.name for f in fields(options) if f.name not in ADDED_LATER]
    if stages == "calibrate":
        names = [name for name in names if name in CALIBRATION_OPTIONS]
    if force and stages == "reconstruct":
        run.forget("solve", "mesh", "detail")
        names = [name for name in names if name in CALIBRATION_OPTIONS]
        force = False
    made_with = {"python": platform.python_version(), "system": platform.system(), **versions()}
    hashes = content_hash(source.files(options))
    run.claim(hashes, {name: getattr(options, name) for name in names}, force, made_with)


def refuse_device(options: RunOptions) -> None:
    """Refuse a --device that is not there, before anything is read or written.

    Raises:
        ReconstructionError: "cuda" where torch sees no such device.
    """
    if options.device == "cuda":  # importing torch to ask it takes a second: only where it is asked for
        from reconstruct.solve.backend import solver_device

        solver_device(options.device)


def run_stages(source: Source, options: RunOptions, run: RunFolder, stages: str) -> None:
    """Do what "run", "calibrate" or "reconstruct" asks for, from where an earlier invocation stopped."""
    if stages == "reconstruct" and not run.is_finished("calibrate"):
        raise CaptureError(
            f"{run.path} holds no finished calibration, which `reconstruct` starts from. "
            f"Run `shadowgraph calibrate {source.folder} --out {run.path}` first."
        )
    if run.forgotten:
        run.progress("capture", message=f"forgotten, as the run starts anew: {', '.join(sorted(run.forgotten))}")
    calibration = run_calibration(source, options, run)
    if stages != "calibrate":
        run_reconstruction(source, options, run, calibration)


def _write_thumbnails(photos: tuple[Path, ...], run: RunFolder) -> None:
    """thumbs/*.jpg: small sRGB copies for page and report."""
    for photo in photos:
        with run.writing(f"thumbs/{photo.stem}.jpg") as path:
            Image.fromarray(read_thumbnail(photo, THUMBNAIL_LONG_SIDE)).save(path, quality=THUMBNAIL_QUALITY)


def _write_maps(fields: "Fields", calibration: Calibration, run: RunFolder) -> None:
    """depth.npy, normal.npy, mask.png of the object, on the grid of the input photos."""
    from reconstruct.render.g_buffer import surface_maps

    maps = surface_maps(fields.grid, replace(calibration.posed_camera, ground_height=fields.ground_height))
    mask = maps.mask.numpy()
    with run.writing("depth.npy") as path:
        np.save(path, np.where(mask, maps.depth.numpy(), np.inf).astype(np.float32))
    with run.writing("normal.npy") as path:
        np.save(path, np.where(mask[..., None], maps.normals.numpy(), 0).astype(np.float32))
    with run.writing("mask.png") as path:
        Image.fromarray(np.where(mask, 255, 0).astype(np.uint8)).save(path)
