"""The mesh for display: reduced and textured, as GLB, OBJ with its pictures, or USDZ.

Writers raise ReconstructionError if the mesh cannot be read or reduced, or has holes although nothing was cut away;
OSError if a file cannot be written.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image

from capture.errors import ReconstructionError
from reconstruct.export.edited import edited_surface
from reconstruct.export.export import Contents, ExportOptions, OnProgress
from reconstruct.mesh.glb import write_textured_glb
from reconstruct.mesh.mesh import MM_PER_METRE
from reconstruct.mesh.texture import TexturedMesh, bake, size_for
from reconstruct.stored_run.stored_run import StoredRun

FACES = 30_000  # unless another number is asked for: any phone turns it smoothly, and the normal map keeps what is lost
Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # x, z, -y of the world
TEXTURE_SIZES = (64, 8192)  # px: what every graphics card takes
USUAL_TEXTURE = 1024  # px, both sides: about two texels per voxel on most objects
LARGEST_UNASKED = 4096  # px: some 30 MB of pictures; what a phone still loads
TEXTURE_STEP = 256  # px
STEPS = 3


def glb(run: StoredRun, path: Path, options: ExportOptions, on_progress: OnProgress) -> Contents:
    """Write GLB: metres, y up, standing on the origin, base colour, normal map, metallic and roughness factors."""
    baked, contents = _baked(run, path, options, on_progress)
    content = write_textured_glb(
        _to_metres(run.unit) * standing(baked.vertices) @ Y_UP.T,
        baked.normals @ Y_UP.T,
        np.column_stack([baked.tangents[:, :3] @ Y_UP.T, baked.tangents[:, 3]]),
        baked.uv,
        baked.faces,
        (baked.base, baked.normal_map),
        (baked.metallic, baked.roughness),
    )
    path.write_bytes(content)
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
    write_usdz(
        path,
        _to_metres(run.unit) * standing(baked.vertices) @ Y_UP.T,
        baked.normals @ Y_UP.T,
        baked.uv,
        baked.faces,
        (baked.base, baked.normal_map),
        (baked.metallic, baked.roughness),
    )
    return contents


def standing(vertices: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return vertices (z up) moved so that the middle of their box stands on the origin, where AR viewers put it."""
    low, high = vertices.min(0), vertices.max(0)
    return vertices - np.append(0.5 * (low + high)[:2], low[2])


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


def _to_metres(unit: str) -> float:
    return 1 / MM_PER_METRE if unit == "mm" else 1.0
