"""A whole run: photos on disk become a calibration, a surface, a mesh and maps in a run folder.

Eight functions, in this order. Each depends on its arguments alone; examples/step_by_step.py calls them one by one.

    open_source       a folder            -> Source: a capture, or a scene that comes with its lights
    read_photos       Source              -> Photos of each view: linear, bad ones named, room light divided out
    calibrate_source  Photos              -> CalibratedViews: camera, ground, a light per photo, each with its sigma
    check_capture     Photos, Calibration -> CaptureCheck: a verdict; a hopeless capture ends here
    prepare_scene     Photos, Calibration -> a Scene of each view: torch tensors at the preset's size
    fit               Scenes              -> SolvedScene: signed distances and materials
    extract_mesh      SolvedScene         -> a closed mesh in the world frame
    save_results      mesh, SolvedScene   -> files for people and other programs

A capture of one view is a tuple of one.

A stage that an earlier invocation finished is not repeated: its result is read back if a later stage needs it.
"""

import platform
import shutil
from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np
import torch
from PIL import Image

from calibration.calibrated_views import CalibratedViews, load_views, save_views
from calibration.posed_camera import PosedCamera
from capture.errors import CaptureError
from capture.files.atomic import atomic_file
from capture.files.title import hand_title_on
from capture.photos.photo import read_thumbnail
from reconstruct.check.readiness import refuse_hopeless
from reconstruct.check.verdict import check_capture
from reconstruct.fields import SolvedScene, load_fields, save_fields
from reconstruct.mesh.mesh import extract_mesh
from reconstruct.run.machine import kernels_are_compiled, measure_speed, planned_seconds, whole_seconds, work_of
from reconstruct.run.presets import solver_config
from reconstruct.run.report_json import summary, versions
from reconstruct.run.results import detail_is_asked, save_results, write_detail
from reconstruct.run.solve_stage import kept_plan, solve
from reconstruct.run_folder.folder import KEPT, RunFolder, content_hash
from reconstruct.run_folder.forecast import duration_text, plan_numbers
from reconstruct.run_folder.progress import Lazy, log_to, once
from reconstruct.sdf.grid import SdfGrid
from reconstruct.solve.backend import backend_name, solver_device
from reconstruct.source.calibrate_source import calibrate_source, in_millimetres, with_scale_of
from reconstruct.source.photos import Photos, read_photos
from reconstruct.source.source import RunOptions, Source
from reconstruct.stored_run.maps import THUMBS, thumbnail_name
from reconstruct.stored_run.stored_run import CALIBRATION, FIELDS

THUMBNAIL_LONG_SIDE = 320  # px: what a browser panel shows
THUMBNAIL_QUALITY = 88  # JPEG: artefacts do not show at this size
KEPT_PER_PIXEL = 13  # bytes of each photo kept: three float32 and a flag
ADDED_LATER = ("detail",)  # options that can be added to a finished run: they leave its existing results unchanged
CALIBRATING = ("capture", "calibrate")  # stages of `shadowgraph calibrate`
CALIBRATION_OPTIONS = ("board", "input", "lights", "split", "light_error", "ground")


def run_stages(source: Source, options: RunOptions, run: RunFolder, stages: str) -> None:
    """Do the stages of "run", "calibrate" or "reconstruct", from where an earlier invocation stopped.

    Raises:
        CaptureError: "reconstruct" in a folder without a finished calibration.
        UserError: a stage refuses its input.
    """
    if stages == "reconstruct" and not run.is_finished("calibrate"):
        raise CaptureError(
            f"{run.path} holds no finished calibration, which `reconstruct` starts from. "
            f"Run `shadowgraph calibrate {source.folder} --out {run.path}` first."
        )
    if run.forgotten:
        run.progress("capture", message=f"forgotten, as the run starts anew: {', '.join(sorted(run.forgotten))}")
    _plan_time(source, options, run, stages)
    if stages != "calibrate" and not run.is_finished("solve"):
        kept_plan(source, options, run)  # before photos fill the memory
    photos = Lazy(lambda: _read(source, options, run))
    calibrated = Lazy(lambda: load_views(run.file(CALIBRATION)))
    fields = Lazy(lambda: load_fields(run.file(FIELDS)))
    mesh = Lazy(lambda: extract_mesh(fields.get()))

    def calibrate() -> None:
        save_views(_calibrated(source, photos.get(), options, run), run.file(CALIBRATION))

    def fit() -> None:
        save_fields(_solved(source, photos, calibrated.get(), options, run), run.file(FIELDS))

    once(run, "calibrate", "finding camera, ground and lights", calibrate, photos, CALIBRATION)
    if stages == "calibrate":
        return
    if source.session is not None and source.ground_is_known(options) and not run.is_finished("solve"):
        once(run, "check", "judging the photos", lambda: _check(source, photos.get(), calibrated.get(), run), photos)
    compiling = "" if kernels_are_compiled() else "; the first run on a machine takes some 20 s longer"
    what = "training a field" if options.is_trained() else "fitting the surface"
    message = f"{what} on {backend_name(solver_device(options.device))}{compiling}"
    once(run, "solve", message, fit, photos, FIELDS)
    if source.scale(options) is not None and run.is_finished("solve"):
        _keep_scale(source, options, run, calibrated.get(), fields.get())
    calibrated.forget()  # the memory plan may have left out photos
    is_new = once(
        run, "mesh", "making the mesh", lambda: save_results(mesh.get(), fields.get(), calibrated.get(), run.path)
    )
    if detail_is_asked(source, options):
        message = "reading relief and colours from the whole photos"
        do = lambda: write_detail(source, options, run, photos.get(), calibrated.get(), fields.get())  # noqa: E731
        is_new |= once(run, "detail", message, do, photos)
    if run.is_finished("solve"):  # a visitor of the page may have stopped it: then the same command goes on
        run.discard(KEPT)
    if is_new or not run.file("report.json").exists():  # a kill may come between them
        run.write_json("report.json", summary(source, options, run, calibrated.get(), mesh.get(), fields.get()))


def _plan_time(source: Source, options: RunOptions, run: RunFolder, stages: str) -> None:
    """Log how many seconds the stages that are not finished should take on this machine; not of trained fields."""
    if options.is_trained() or run.is_finished("mesh"):
        return
    run.activity("measuring how fast this machine is just now")
    plan = planned_seconds(
        solver_config(options), measure_speed(), work_of(source, options, detail_is_asked(source, options))
    )
    wanted = CALIBRATING if stages == "calibrate" else tuple(plan)
    is_solved = run.is_finished("solve")
    plan = {
        name: seconds
        for name, seconds in plan.items()
        if name in wanted and not run.is_finished(name) and not (is_solved and name in ("capture", "hull"))
    }
    message = f"about {duration_text(whole_seconds(plan))} from here, if nothing else gets in its way"
    run.progress("capture", message=message, numbers=plan_numbers(plan))


def _read(source: Source, options: RunOptions, run: RunFolder) -> tuple[Photos, ...]:
    """Stage "capture": done by every invocation that needs photos; they stay in the run folder in the meantime."""
    with run.stage("capture", f"reading {len(source.photos())} photos", leaves_files=False):
        for one in source.left_out():
            run.progress(message=f"{one.called} is left out: {one.kind}, {one.text}")
        longest = 2 * options.long_side() ** 2
        has_room = shutil.disk_usage(run.path).free > KEPT_PER_PIXEL * longest * len(source.photos())
        photos = read_photos(source, options, run.file(KEPT) if has_room else None)
        if not run.is_finished("calibrate"):
            write_thumbnails(source, run)
    return photos


def _calibrated(source: Source, photos: Sequence[Photos], options: RunOptions, run: RunFolder) -> CalibratedViews:
    """Stage "calibrate"; small photos are named anew if the first view is left out."""
    with log_to(run.activity, lambda text: run.progress(message=text)):
        calibrated = calibrate_source(source, photos, options)
    if len(photos) > 1 and photos[0].view != calibrated.views[0].name:
        write_thumbnails(source, run, calibrated.views[0].name)
    return calibrated


def _check(source: Source, photos: Sequence[Photos], calibrated: CalibratedViews, run: RunFolder) -> None:
    """Write check.json, as `shadowgraph check`; a hopeless capture ends the run, other reasons become warnings."""
    checked = check_capture(source, photos, calibrated)
    run.write_json("check.json", checked.document())
    run.progress(message=checked.readiness.sentence())
    refuse_hopeless(checked.readiness)


def _solved(
    source: Source, photos: Lazy[tuple[Photos, ...]], calibrated: CalibratedViews, options: RunOptions, run: RunFolder
) -> SolvedScene:
    """Stage "solve", see solve_stage; a surface that no visitor stopped gets the given scale."""
    fields, length = solve(source, options, run, photos, calibrated), source.scale(options)
    if source.known is not None and source.known.left_out is not None and source.ground_is_known(options):
        fields = without_ball(fields, source.known.left_out, calibrated.first.posed_camera)
    if length is None or run.is_left_open:
        return fields
    return in_millimetres(fields, length, source.ground_is_known(options))


def _keep_scale(
    source: Source, options: RunOptions, run: RunFolder, calibrated: CalibratedViews, fields: SolvedScene
) -> None:
    """Bring calibration.json to the unit of the solved scene; it is there already if this was done before."""
    length = source.scale(options)
    if length is not None and calibrated.first.unit != fields.unit:
        known = source.ground_is_known(options)
        scaled = [with_scale_of(view.calibration, fields, length, known) for view in calibrated.views]
        save_views(calibrated.with_calibrations(scaled), run.file(CALIBRATION))


def claim(source: Source, options: RunOptions, run: RunFolder, stages: str, force: bool) -> None:
    """Tie the run folder to this capture and these options.

    Args:
        stages: "run", "calibrate" or "reconstruct": `calibrate` does not fix the solver's options yet.
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
    hand_title_on(source.folder, run.path)


def write_thumbnails(source: Source, run: RunFolder, first: str | None = None) -> None:
    """Write thumbs/*.jpg: small sRGB copies for page and report, see thumbnail_name.

    Args:
        first: name of the view whose photos are found by their names alone; by default the source's first.

    Raises:
        CaptureError: a photo cannot be read.
    """
    first = source.views()[0].name if first is None else first
    for view in source.views():
        before = "" if view.name == first else f"{view.name}/"
        for photo in view.photos():
            with atomic_file(run.file(f"{THUMBS}/{thumbnail_name(before + photo.name)}")) as path:
                Image.fromarray(read_thumbnail(photo, THUMBNAIL_LONG_SIDE)).save(path, quality=THUMBNAIL_QUALITY)


def without_ball(fields: SolvedScene, circle: tuple[float, float, float], posed_camera: PosedCamera) -> SolvedScene:
    """Return the surface without a ball that stands on the ground.

    Args:
        circle: x, y, radius of the ball and a rim about it, px of `posed_camera`.
        posed_camera: in the frame of the fields.
    """
    x, y, radius = circle
    ray, slope = posed_camera.rays(np.array([[x, y]]))[0], radius / posed_camera.camera.fx
    eye, ground = posed_camera.centre, posed_camera.ground_height
    t = (eye[2] - ground) / (slope * float(ray @ posed_camera.forward) - ray[2])  # its middle lies a radius above
    middle, size = eye + t * ray, slope * t * float(ray @ posed_camera.forward)
    grid = fields.grid
    nodes = [grid.origin[i].item() + grid.spacing * np.arange(n) - middle[i] for i, n in enumerate(grid.values.shape)]
    away = np.sqrt(nodes[0][:, None, None] ** 2 + nodes[1][:, None] ** 2 + nodes[2] ** 2)
    values = torch.maximum(grid.values, torch.from_numpy(size - away).to(grid.values.dtype))
    return replace(fields, grid=SdfGrid(values, grid.origin, grid.spacing))
