"""The mesh as a file: for display reduced and textured (GLB, OBJ with its pictures, USDZ), for printing and measuring
closed, in the world's frame and unit (PLY, STL, OFF, 3MF).

Writers raise ReconstructionError if the mesh cannot be read or reduced, or has holes although nothing was cut away;
OSError if a file cannot be written.
"""

import zipfile
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from capture.errors import ReconstructionError
from capture.files.regular import read_regular
from reconstruct.export.edited import edited_surface
from reconstruct.export.export import Contents, ExportOptions, OnProgress
from reconstruct.mesh.glb import Y_UP, metres
from reconstruct.mesh.texture import TexturedMesh, bake, size_for, write_textured_glb
from reconstruct.stored_run.ply import LARGEST_FILE
from reconstruct.stored_run.stage_pack import ZIP_TIME
from reconstruct.stored_run.stored_run import MESH, StoredRun

FACES = 30_000  # unless another number is asked for: any phone turns it smoothly, and the normal map keeps what is lost
TEXTURE_SIZES = (64, 8192)  # px: what every graphics card takes
USUAL_TEXTURE = 1024  # px, both sides: about two texels per voxel on most objects
LARGEST_UNASKED = 4096  # px: some 30 MB of pictures; what a phone still loads
TEXTURE_STEP = 256  # px
STEPS = 3
CORE_3MF = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
RELATIONS = "http://schemas.openxmlformats.org/package/2006/relationships"
CONTENT_TYPES = "http://schemas.openxmlformats.org/package/2006/content-types"
MODEL_PART = "3D/3dmodel.model"
SMALLEST_PRINT, LARGEST_PRINT = 1.0, 10_000.0  # mm, of the longest side


def glb(run: StoredRun, path: Path, options: ExportOptions, on_progress: OnProgress) -> Contents:
    """Write GLB: metres, y up, standing on the origin, base colour, normal map, metallic and roughness factors."""
    baked, contents = _baked(run, path, options, on_progress)
    path.write_bytes(write_textured_glb(baked.standing(metres(run.unit))))
    return contents


def obj(run: StoredRun, path: Path, options: ExportOptions, on_progress: OnProgress) -> Contents:
    """Write OBJ with MTL and two PNG files beside it: the run's unit, y up, as most programs expect."""
    baked, contents = _baked(run, path, options, on_progress, "millimetres")
    stem = path.stem.replace(" ", "_")  # programs disagree about spaces in these names
    material = path.with_name(f"{stem}.mtl")
    pictures = {"map_Kd": path.with_name(f"{stem}_colour.png"), "norm": path.with_name(f"{stem}_normals.png")}
    for picture, file in zip((baked.base, baked.normal_map), pictures.values(), strict=True):
        Image.fromarray(picture).save(file)
    lines = ["newmtl object", "Kd 1 1 1", "Ks 0 0 0", f"Pm {baked.metallic:.4f}", f"Pr {baked.roughness:.4f}"]
    lines += [f"{key} {file.name}" for key, file in pictures.items()]
    material.write_text("\n".join(lines) + "\n", encoding="utf-8")
    unit = "millimetres" if run.unit == "mm" else "units of the scene"
    vertices, normals = baked.vertices @ Y_UP.T, baked.normals @ Y_UP.T
    with path.open("w", encoding="utf-8") as file:
        file.write(f"# Shadowgraph, {unit}, y up\nmtllib {material.name}\no object\nusemtl object\n")
        np.savetxt(file, vertices, "v %.5f %.5f %.5f" if run.unit == "mm" else "v %.7g %.7g %.7g")
        np.savetxt(file, np.column_stack([baked.uv[:, 0], 1 - baked.uv[:, 1]]), "vt %.6f %.6f")  # v up
        np.savetxt(file, normals, "vn %.5f %.5f %.5f")
        np.savetxt(file, np.repeat(baked.faces + 1, 3, 1), "f %d/%d/%d %d/%d/%d %d/%d/%d")
    return contents


def usdz(run: StoredRun, path: Path, options: ExportOptions, on_progress: OnProgress) -> Contents:
    """Write USDZ: metres, y up, standing on the origin, UsdPreviewSurface. Needs the extra `usd`.

    Raises:
        ReconstructionError: it is not installed.
    """
    try:
        from reconstruct.mesh.usd import write_usdz
    except ImportError as error:
        raise ReconstructionError(
            "USDZ needs the package usd-core, which is not installed: pip install 'shadowgraph[usd]'. "
            "GLB needs nothing more, and holds the same."
        ) from error
    baked, contents = _baked(run, path, options, on_progress)
    write_usdz(path, baked.standing(metres(run.unit)))
    return contents


def _baked(
    run: StoredRun, path: Path, options: ExportOptions, on_progress: OnProgress, unit: str = "metres"
) -> tuple[TexturedMesh, Contents]:
    """Return the textured mesh, and what a file of it holds whose lengths are in `unit`."""
    low, high = TEXTURE_SIZES
    if options.texture is not None and not low <= options.texture <= high:
        raise ReconstructionError(f"pictures of {options.texture} px were asked for; {low} to {high} px can be made.")
    on_progress(0, STEPS, "reducing the mesh")
    surface = edited_surface(run)
    small = surface.reduced(options.faces or FACES)
    size = options.texture or _size_for(run)
    on_progress(1, STEPS, f"unwrapping it and baking colour and normals, {size} x {size} pixels")
    baked = bake(surface.fields, small, surface.mesh, size, surface.details)
    on_progress(2, STEPS, "writing it")
    joins = "without gaps, but cut along the seams of its pictures (to print it, export 3MF or STL)"
    how = joins if surface.is_closed(path, baked.vertices, baked.faces) else "not closed"
    note = f"{how}, {unit if run.unit == 'mm' else 'units of the scene'}, y up, pictures of {size} x {size} pixels"
    x, y, z = map(float, np.ptp(baked.vertices, axis=0))
    return baked, Contents(len(baked.faces), (x, y, z), run.unit, note=note + surface.edits_in_words())


def _size_for(run: StoredRun) -> int:
    """Return the side of the texture (px), no finer than the surface's resolution."""
    if not run.details:
        return USUAL_TEXTURE
    steps = -(-size_for(run.details, run.mesh) // TEXTURE_STEP)
    return min(max(TEXTURE_STEP * steps, USUAL_TEXTURE), LARGEST_UNASKED)


def plain(run: StoredRun, path: Path, options: ExportOptions, on_progress: OnProgress) -> Contents:
    """Write PLY with normals and sRGB colours per vertex, mesh.ply itself where nothing changes it; OFF; or binary STL,
    which stores no unit: millimetres for a phone capture, or the size that was asked for.
    """
    kind = path.suffix.lower().removeprefix(".")
    mesh, contents = _solid(run, path, options, on_progress, options.print_size if kind == "stl" else None)
    if kind == "ply" and mesh is run.mesh:
        path.write_bytes(read_regular(run.run_dir / MESH, LARGEST_FILE))
    else:
        mesh.export(path, file_type=kind, **({"vertex_normal": True} if kind == "ply" else {}))
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
    run: StoredRun, path: Path, options: ExportOptions, on_progress: OnProgress, print_size: float | None
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
