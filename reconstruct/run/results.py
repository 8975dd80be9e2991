"""save_results: write a solved scene's mesh and maps for people and other programs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from calibration.calibrated_views import CalibratedViews
from calibration.calibration import Calibration
from capture.files.atomic import atomic_file
from reconstruct.fields import Fields
from reconstruct.mesh.mesh import mesh_material, save_mesh
from reconstruct.render.g_buffer import surface_maps


def save_results(mesh: trimesh.Trimesh, fields: Fields, calibrated: CalibratedViews, folder: Path) -> None:
    """Write mesh.ply, mesh.glb, depth.npy, normal.npy and mask.png, each whole or absent; see CONVENTIONS.md.

    The maps are those of the first view's camera: depth along its z axis, normals in the world frame. Where there are
    several views, the maps of each follow in a folder of its name. Those of another lie belong to that lie's
    calibration: normals in its world, the maps cut at its ground.

    Args:
        mesh: of extract_mesh(fields).

    Raises:
        ReconstructionError: the mesh is empty, or a file does not read back.
        OSError: no room, or no right to write there.
    """
    folder.mkdir(parents=True, exist_ok=True)
    save_mesh(mesh, folder / "mesh.ply", folder / "mesh.glb", fields.unit, mesh_material(fields, mesh))
    save_maps(fields, calibrated.first, folder)
    calibrations = {view.name: view.calibration for view in calibrated.every()}
    for view in fields.views():
        if view.view in calibrations and view.view:
            save_maps(view, calibrations[view.view], folder / view.view)


def save_maps(fields: Fields, calibration: Calibration, folder: Path) -> None:
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
