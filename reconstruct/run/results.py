"""save_results: write a solved scene's mesh and maps for people and other programs.

write_detail: stage "detail" of a run, which reads the full-size photos again, on the finished surface.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from calibration.calibrated_views import CalibratedViews
from calibration.calibration import Calibration
from capture.files.atomic import atomic_file
from reconstruct.detail.detail import OnProgress, estimate_illumination, solve_detail
from reconstruct.detail.file import DETAIL, Detail, save_details
from reconstruct.detail.full_photos import full_photos
from reconstruct.fields import SolvedScene
from reconstruct.labels.multiple_lights import is_shared
from reconstruct.mesh.mesh import mesh_material, save_mesh
from reconstruct.render.g_buffer import surface_maps
from reconstruct.run.solve_stage import seen_views
from reconstruct.run_folder.folder import RunFolder
from reconstruct.scene import build_scene
from reconstruct.source.photos import Photos
from reconstruct.source.source import LONG_SIDES, RunOptions, Source

STAGE = "detail"
SMALL = "draft"  # preset whose size is enough for noise and light from the ground
LINES = 100  # of the log, at most


def detail_is_asked(source: Source, options: RunOptions) -> bool:
    """Return True if --detail or the preset asks for the stage, and there are colour photos for it."""
    asked = options.detail == "on" or (options.detail == "auto" and options.preset == "fine")
    has_colour = source.known is None or source.known.rgb_paths is not None
    return asked and has_colour and options.input != "shadow"


def write_detail(
    source: Source,
    options: RunOptions,
    run: RunFolder,
    photos: Sequence[Photos],
    calibrated: CalibratedViews,
    fields: SolvedScene,
) -> None:
    """Write detail.safetensors, the detail of each view that has one; log the reason where a view has none.

    Args:
        photos: as read_photos reads them.

    Raises:
        CaptureError: a photo can no longer be read.
    """
    sources = {own.name: own for own in source.views()}
    seen = [own for one in (calibrated, *calibrated.object_poses) for own in seen_views(photos, one)]
    by_name = {own[0].view: own for own in seen}
    views, details = fields.views(), []
    for number, view in enumerate(views):
        own = by_name.get(view.view, seen[0] if number == 0 else None)
        if own is not None:
            found = _of_view(sources.get(view.view, source), options, run, own, view, _reporter(run, number, views))
            details += [] if found is None else [replace(found, view=number, object_from_world=view.object_from_world)]
    if details:
        save_details(details, fields, run.file(DETAIL))


def _reporter(run: RunFolder, number: int, views: Sequence[SolvedScene]) -> OnProgress:
    """Return what logs the progress of one of the views, in at most LINES lines for all."""
    lines, of_view = set(), f"{views[number].view}: " if len(views) > 1 else ""

    def report(done: int, total: int, message: str) -> None:
        line = LINES * (number * total + done) // (len(views) * total)
        if line not in lines:
            run.progress(STAGE, number * total + done, len(views) * total, of_view + message)
        lines.add(line)

    return report


def _of_view(
    source: Source,
    options: RunOptions,
    run: RunFolder,
    own: tuple[Photos, Calibration],
    fields: SolvedScene,
    report: OnProgress,
) -> Detail | None:
    """Return the detail of one view, or None and log why there is none.

    Args:
        source, own, fields: of the view: its folder, its photos and calibration, and the scene as it saw it.
    """
    photos, calibration = own
    assert photos.stack is not None
    scene = build_scene(photos.stack, calibration, LONG_SIDES[SMALL], mask=photos.mask)
    scene = replace(scene, ground_known=source.ground_is_known(options))
    dark = () if source.session is None else source.session.dark
    is_linear = source.known is not None and source.known.is_linear
    files = full_photos(photos.stack, scene.photo_names, dark, is_linear)
    if is_shared(scene):
        run.progress(message="photos under several lights at once are not read in full detail")
        return None
    detail = solve_detail(estimate_illumination(scene, fields), fields, calibration.camera, files, run.path, report)
    if detail is None:
        run.progress(message="no pixel of the photos sees the surface")
    return detail


def save_results(mesh: trimesh.Trimesh, fields: SolvedScene, calibrated: CalibratedViews, folder: Path) -> None:
    """Write mesh.ply, mesh.glb, depth.npy, normal.npy and mask.png, each whole or absent; see CONVENTIONS.md.

    The maps are those of the first view's camera: depth along its z axis, normals in the world frame. Where there are
    several views, the maps of each follow in a folder of its name. Those of another object pose belong to that pose's
    calibration: normals in its world, the maps cut at its ground.

    Args:
        mesh: of extract_mesh(fields).

    Raises:
        ReconstructionError: the mesh is empty.
        OSError: no room, or no right to write there.
    """
    folder.mkdir(parents=True, exist_ok=True)
    save_mesh(mesh, folder / "mesh.ply", folder / "mesh.glb", fields.unit, mesh_material(fields, mesh))
    save_maps(fields, calibrated.first, folder)
    calibrations = {view.name: view.calibration for view in calibrated.every()}
    for view in fields.views():
        if view.view in calibrations and view.view:
            save_maps(view, calibrations[view.view], folder / view.view)


def save_maps(fields: SolvedScene, calibration: Calibration, folder: Path) -> None:
    """Write depth.npy, normal.npy and mask.png of one camera, each whole or absent.

    Raises:
        OSError: no room, or no right to write there.
    """
    folder.mkdir(parents=True, exist_ok=True)
    maps = surface_maps(fields.grid, replace(calibration.posed_camera, ground_height=fields.ground_height))
    mask = maps.mask.numpy()
    with atomic_file(folder / "depth.npy") as path:
        np.save(path, np.where(mask, maps.depth.numpy(), np.inf).astype(np.float32))
    with atomic_file(folder / "normal.npy") as path:
        np.save(path, np.where(mask[..., None], maps.normals.numpy(), 0).astype(np.float32))
    with atomic_file(folder / "mask.png") as path:
        Image.fromarray(np.where(mask, 255, 0).astype(np.uint8)).save(path)
