"""The mesh for printing and measuring: PLY, STL, OFF and 3MF, closed, in the world's frame and unit.

Writers raise ReconstructionError if the mesh cannot be read or reduced, OSError if a file cannot be written.
"""

import zipfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import trimesh

from capture.errors import ReconstructionError
from capture.files.regular import read_regular
from reconstruct.export.edited import edit_of, edited_surface, edits_in_words
from reconstruct.export.export import Contents, ExportOptions, OnProgress, reading_back
from reconstruct.mesh.edit import Edit
from reconstruct.mesh.simplify import bounds_a_solid
from reconstruct.stored_run.ply import LARGEST_FILE
from reconstruct.stored_run.stored_run import MESH, StoredRun

CORE_3MF = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
RELATIONS = "http://schemas.openxmlformats.org/package/2006/relationships"
CONTENT_TYPES = "http://schemas.openxmlformats.org/package/2006/content-types"
MODEL_PART = "3D/3dmodel.model"
ZIP_TIME = (1980, 1, 1, 0, 0, 0)  # the same run gives the same bytes
SMALLEST_PRINT, LARGEST_PRINT = 1.0, 10_000.0  # mm, of the longest side


def ply(run: StoredRun, path: Path, options: ExportOptions, on_progress: OnProgress) -> None:
    """Write mesh.ply unchanged, or edited or reduced: normals and sRGB colours per vertex."""
    on_progress(0, 1, "writing the mesh")
    if options.faces is None and edit_of(run) == Edit():
        assert len(run.mesh.faces)  # which reads the file, so that no damaged one is passed on
        path.write_bytes(read_regular(run.run_dir / MESH, LARGEST_FILE))
        return
    mesh = _solid(run, options)
    mesh.export(path, file_type="ply", vertex_normal=True)


def stl(run: StoredRun, path: Path, options: ExportOptions, on_progress: OnProgress) -> None:
    """Write binary STL, which stores no unit: millimetres for a phone capture, or the size that was asked for."""
    on_progress(0, 1, "writing the mesh")
    _printed(run, options).export(path, file_type="stl")


def off(run: StoredRun, path: Path, options: ExportOptions, on_progress: OnProgress) -> None:
    """Write OFF: vertices and faces as text."""
    on_progress(0, 1, "writing the mesh")
    _solid(run, options).export(path, file_type="off")


def threemf(run: StoredRun, path: Path, options: ExportOptions, on_progress: OnProgress) -> None:
    """Write 3MF by its core specification 1.3: one mesh, millimetres, standing on z = 0, without colours.

    A scene's own unit is written as millimetres too, because 3MF has only physical units; the reader states this.
    """
    on_progress(0, 1, "writing the mesh")
    if edit_of(run).cuts_guess:
        raise ReconstructionError(
            "3MF holds closed solids, and in this run's page the guess is cut away, which leaves holes. Show the guess "
            "under 'Cut and smooth' there, or export STL, OBJ, GLB or PLY."
        )
    mesh = _printed(run, options)
    ground = float(mesh.bounds[0, 2])
    vertices = mesh.vertices - [0.0, 0.0, ground]
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


def read(run: StoredRun, path: Path) -> Contents:
    """Read back the contents of a mesh file.

    Raises:
        ReconstructionError: it cannot be read, or does not bound a solid although nothing was cut away.
    """
    with reading_back(path):
        mesh = _read_3mf(path) if path.suffix.lower() == ".3mf" else trimesh.load_mesh(path, process=False)
        extents = tuple(float(e) for e in mesh.extents)
        is_closed = bounds_a_solid(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    edits = edits_in_words(run)
    if not is_closed and not edit_of(run).cuts_guess:
        raise ReconstructionError(
            f"{path.name} reads back as {len(mesh.faces)} triangles that leave holes, and a closed surface was needed. "
            "Export again with another number of faces."
        )
    is_mm = run.unit == "mm"
    note = "millimetres, z up" if is_mm else "one unit of the scene is written as one millimetre, z up"
    return Contents(len(mesh.faces), (extents[0], extents[1], extents[2]), is_closed=is_closed, note=note + edits)


def _read_3mf(path: Path) -> trimesh.Trimesh:
    """Read the mesh of a 3MF that this module wrote."""
    with zipfile.ZipFile(path) as archive:
        model = ElementTree.fromstring(archive.read(MODEL_PART))
    if model.get("unit") != "millimeter":
        raise ValueError("its unit is not the millimetre")
    core = f"{{{CORE_3MF}}}"
    vertices = [[float(v.get(axis, "nan")) for axis in "xyz"] for v in model.iter(f"{core}vertex")]
    faces = [[int(t.get(corner, "-1")) for corner in ("v1", "v2", "v3")] for t in model.iter(f"{core}triangle")]
    return trimesh.Trimesh(vertices, faces, process=False)


def _solid(run: StoredRun, options: ExportOptions) -> trimesh.Trimesh:
    """Return the mesh with colours and normals, edited as the run says, reduced if the options ask for it."""
    return edited_surface(run).reduced(options.faces)


def _printed(run: StoredRun, options: ExportOptions) -> trimesh.Trimesh:
    """Return the solid in the size in which it is to be printed.

    Raises:
        ReconstructionError: the size is none that can be printed.
    """
    mesh = _solid(run, options)
    if options.print_size is not None:
        if not SMALLEST_PRINT <= options.print_size <= LARGEST_PRINT:
            raise ReconstructionError(
                f"{options.print_size:g} mm is no size to print; {SMALLEST_PRINT:g} to {LARGEST_PRINT:g} mm for the "
                "longest side was needed."
            )
        mesh.apply_scale(options.print_size / float(max(mesh.extents)))
    return mesh
