"""The mesh for printing and measuring: PLY, STL, OFF and 3MF, closed, in the world's frame and unit.

Writers raise ReconstructionError if the mesh cannot be read or reduced, or has holes although nothing was cut away;
OSError if a file cannot be written.
"""

import zipfile
from pathlib import Path

import numpy as np
import trimesh

from capture.errors import ReconstructionError
from capture.files.regular import read_regular
from reconstruct.export.edited import edited_surface
from reconstruct.export.export import Contents, ExportOptions, OnProgress
from reconstruct.stored_run.ply import LARGEST_FILE
from reconstruct.stored_run.stored_run import MESH, StoredRun

CORE_3MF = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
RELATIONS = "http://schemas.openxmlformats.org/package/2006/relationships"
CONTENT_TYPES = "http://schemas.openxmlformats.org/package/2006/content-types"
MODEL_PART = "3D/3dmodel.model"
ZIP_TIME = (1980, 1, 1, 0, 0, 0)  # the same run gives the same bytes
SMALLEST_PRINT, LARGEST_PRINT = 1.0, 10_000.0  # mm, of the longest side


def ply(run: StoredRun, path: Path, options: ExportOptions, on_progress: OnProgress) -> Contents:
    """Write mesh.ply unchanged, or edited or reduced: normals and sRGB colours per vertex."""
    mesh, contents = _solid(run, path, options, on_progress)
    if mesh is run.mesh:
        path.write_bytes(read_regular(run.run_dir / MESH, LARGEST_FILE))
    else:
        mesh.export(path, file_type="ply", vertex_normal=True)
    return contents


def stl(run: StoredRun, path: Path, options: ExportOptions, on_progress: OnProgress) -> Contents:
    """Write binary STL, which stores no unit: millimetres for a phone capture, or the size that was asked for."""
    mesh, contents = _solid(run, path, options, on_progress, options.print_size)
    mesh.export(path, file_type="stl")
    return contents


def off(run: StoredRun, path: Path, options: ExportOptions, on_progress: OnProgress) -> Contents:
    """Write OFF: vertices and faces as text."""
    mesh, contents = _solid(run, path, options, on_progress)
    mesh.export(path, file_type="off")
    return contents


def threemf(run: StoredRun, path: Path, options: ExportOptions, on_progress: OnProgress) -> Contents:
    """Write 3MF by its core specification 1.3: one mesh, millimetres, standing on z = 0, without colours.

    A scene's own unit is written as millimetres too, because 3MF has only physical units; the contents state this.
    """
    mesh, contents = _solid(run, path, options, on_progress, options.print_size)
    if not contents.is_closed:
        raise ReconstructionError(
            "3MF holds closed solids, and in this run's page the guess is cut away, which leaves holes. Show the guess "
            "under 'Cut and smooth' there, or export STL, OBJ, GLB or PLY."
        )
    vertices = mesh.vertices - [0.0, 0.0, float(mesh.bounds[0, 2])]
    points = "".join(f'<vertex x="{x:.6g}" y="{y:.6g}" z="{z:.6g}"/>\n' for x, y, z in vertices)
    triangles = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>\n' for a, b, c in mesh.faces)
    head = '<?xml version="1.0" encoding="UTF-8"?>\n'
    parts = {
        "[Content_Types].xml": f'{head}<Types xmlns="{CONTENT_TYPES}">'
        '<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
        '<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>',
        "_rels/.rels": f'{head}<Relationships xmlns="{RELATIONS}"><Relationship Target="/{MODEL_PART}" Id="model" '
        'Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>',
        MODEL_PART: f'{head}<model unit="millimeter" xml:lang="en-US" xmlns="{CORE_3MF}">'
        '<metadata name="Application">Shadowgraph</metadata><resources><object id="1" type="model"><mesh>\n'
        f"<vertices>\n{points}</vertices>\n<triangles>\n{triangles}</triangles>\n</mesh></object></resources>"
        '<build><item objectid="1"/></build></model>\n',
    }
    with zipfile.ZipFile(path, "w") as archive:
        for name, text in parts.items():
            archive.writestr(zipfile.ZipInfo(name, ZIP_TIME), text, zipfile.ZIP_DEFLATED)
    return contents


def _solid(
    run: StoredRun, path: Path, options: ExportOptions, on_progress: OnProgress, print_size: float | None = None
) -> tuple[trimesh.Trimesh, Contents]:
    """Return the mesh with colours and normals, edited as the run says, reduced and scaled as the options ask.

    Raises:
        ReconstructionError: the mesh has holes, or the size is none that can be printed.
    """
    on_progress(0, 1, "writing the mesh")
    surface = edited_surface(run)
    mesh = surface.reduced(options.faces)
    is_closed = surface.is_closed(path, np.asarray(mesh.vertices), np.asarray(mesh.faces))
    note = "millimetres, z up" if run.unit == "mm" else "one unit of the scene is written as one millimetre, z up"
    if print_size is not None:
        if not SMALLEST_PRINT <= print_size <= LARGEST_PRINT:
            raise ReconstructionError(
                f"{print_size:g} mm is no size to print; {SMALLEST_PRINT:g} to {LARGEST_PRINT:g} mm for the longest "
                "side was needed."
            )
        mesh = mesh.copy().apply_scale(print_size / float(max(mesh.extents)))
        note = "scaled to print, millimetres, z up"
    x, y, z = map(float, mesh.extents)
    unit = run.unit if print_size is None else "mm"
    return mesh, Contents(len(mesh.faces), (x, y, z), unit, is_closed, note=note + surface.edits_in_words())
