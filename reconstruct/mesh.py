"""The SDF becomes a closed, coloured triangle mesh of the object without the ground, and a PLY and a GLB file."""

from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Float, UInt8
from scipy import ndimage
from skimage.measure import marching_cubes
from trimesh.visual import ColorVisuals

from capture.atomic import atomic_file
from capture.errors import ReconstructionError
from capture.photo import decode_srgb, encode_srgb
from reconstruct.fields import Fields
from reconstruct.glb import write_glb
from reconstruct.grid import SdfGrid
from reconstruct.view import albedo_at, paint

MAX_NODES = 400**3  # nodes around the object: beyond, marching cubes alone takes more than 2 GB
PREVIEW_NODES = 96**3  # 30 thousand faces: what a browser takes several times a second
ISLAND_SHARE = 0.01  # of the largest piece's volume: smaller ones are debris that no photo would miss
OFF_SURFACE = 0.01  # voxels: no node lies closer to the surface, or its triangles would have no area
MM_PER_METRE = 1000.0


def extract_mesh(fields: Fields, max_nodes: int = MAX_NODES) -> trimesh.Trimesh:
    """The object's surface above the ground, world frame: closed, outward, with normals and sRGB albedo per vertex.

    Raises:
        ReconstructionError: nothing stands on the ground, or the grid around the object has more than max_nodes nodes.
    """
    mesh = surface_mesh(fields.grid, fields.ground_height, max_nodes)
    vertices = torch.from_numpy(np.asarray(mesh.vertices)).float()
    albedo = albedo_at(fields, paint(fields), vertices, torch.ones(len(vertices), dtype=torch.bool))
    mesh.visual = ColorVisuals(mesh, vertex_colors=encode_srgb(albedo.numpy()))
    return mesh


def preview_mesh(grid: SdfGrid, ground_height: float, max_nodes: int = PREVIEW_NODES) -> trimesh.Trimesh:
    """A coarse, uncoloured `extract_mesh` of at most about max_nodes nodes, fast enough to watch a surface grow."""
    stride = max(1, int(np.ceil((grid.values.numel() / max_nodes) ** (1 / 3))))
    coarse = SdfGrid(grid.values[::stride, ::stride, ::stride], grid.origin, grid.spacing * stride)
    return surface_mesh(coarse, ground_height, MAX_NODES)


def surface_mesh(grid: SdfGrid, ground_height: float, max_nodes: int) -> trimesh.Trimesh:
    """The uncoloured surface of max(sdf, ground_height - z): the object cut flat at the ground and closed there."""
    solid, first = _solid(grid, ground_height, max_nodes)
    vertices, faces, _, _ = marching_cubes(solid, 0.0, gradient_direction="descent", allow_degenerate=False)
    world = grid.origin.double().numpy() + grid.spacing * (vertices.astype(float) + first)
    mesh = trimesh.Trimesh(world, faces, process=False)
    if not (mesh.is_watertight and mesh.volume > 0):
        raise ReconstructionError(
            f"the surface of {len(faces)} triangles is not closed, and a closed one was needed. "
            "Please report this with the run folder; another --preset makes another grid."
        )
    mesh.vertex_normals = _normals(grid, ground_height, mesh)
    return mesh


def _solid(grid: SdfGrid, ground_height: float, max_nodes: int) -> tuple[Float[np.ndarray, "nx ny nz"], np.ndarray]:
    """The cut SDF around the object in voxels, one node of air about it, without debris; its first node's index."""
    height = float(grid.origin[2]) + grid.spacing * np.arange(grid.values.shape[2]) - ground_height
    inside = (grid.values.numpy() < 0) & (height > 0)
    if not inside.any():
        raise ReconstructionError(
            "no surface was found above the ground: the photos show no object, or all of it was proven empty. "
            "Check in report.html that the object is in the picture and that its shadows are dark."
        )
    kept = [np.flatnonzero(inside.any(axis=tuple(a for a in range(3) if a != axis))) for axis in range(3)]
    window = tuple(slice(max(k[0] - 1, 0), k[-1] + 2) for k in kept)
    nodes = int(np.prod([k[-1] - k[0] + 3 for k in kept]))
    if nodes > max_nodes:
        raise ReconstructionError(
            f"the grid has {nodes / 1e6:.0f} million nodes around the object, at most {max_nodes / 1e6:.0f} million "
            "fit in memory for the mesh. Choose a coarser --preset."
        )
    cut = np.maximum(grid.values.numpy()[window], -height[window[2]]) / grid.spacing
    touches = [(int(k[0] == 0), int(k[-1] == n - 1)) for k, n in zip(kept, grid.values.shape, strict=True)]
    solid = np.pad(cut.astype(np.float32), touches, constant_values=1.0)  # air beyond the walls of the box
    first = np.array([w.start - t[0] for w, t in zip(window, touches, strict=True)])
    _drop_islands(solid)
    near = np.abs(solid) < OFF_SURFACE
    solid[near] = np.where(solid[near] < 0, -OFF_SURFACE, OFF_SURFACE)
    return solid, first


def _drop_islands(solid: Float[np.ndarray, "nx ny nz"]) -> None:
    """In place: pieces smaller than ISLAND_SHARE of the largest become air, cavities nobody can see become solid."""
    labels = np.zeros(solid.shape, np.int32)
    ndimage.label(solid < 0, output=labels)
    if labels.max() > 1:
        volume = np.bincount(labels.ravel())[1:]
        debris = np.append(False, volume < ISLAND_SHARE * volume.max())[labels]
        solid[debris] = -solid[debris]
    ndimage.label(solid >= 0, output=labels)
    if labels.max() > 1:  # the corner is air: one node of it surrounds the object
        cavity = (labels > 0) & (labels != labels[0, 0, 0])
        solid[cavity] = -solid[cavity]


def _normals(grid: SdfGrid, ground_height: float, mesh: trimesh.Trimesh) -> Float[np.ndarray, "n 3"]:
    """Unit outward normals of the vertices: the SDF's gradient, straight down on the cut at the ground."""
    points = torch.from_numpy(np.asarray(mesh.vertices)).float()
    normals = torch.nn.functional.normalize(grid.gradient(points), dim=-1).double().numpy()
    flat = np.asarray(mesh.vertex_normals)
    on_cut = mesh.vertices[:, 2] < ground_height + 0.5 * grid.spacing
    agrees = (normals * flat).sum(1) > 0  # box walls and filled places have no gradient of their own
    return np.where((on_cut | ~agrees)[:, None], flat, normals)


def vertex_colours(mesh: trimesh.Trimesh) -> UInt8[np.ndarray, "n 3"]:
    """The sRGB colours of a mesh's vertices."""
    visual = mesh.visual
    assert isinstance(visual, ColorVisuals)
    return np.asarray(visual.vertex_colors)[:, :3]


def save_mesh(mesh: trimesh.Trimesh, path_ply: Path, path_glb: Path, unit: str) -> None:
    """Both files, each whole or absent, and opened again to see that they hold the same surface.

    PLY: world frame and unit, normals, sRGB colours. GLB: metres (scene units stay as they are), y up, linear colours,
    a rough non-metallic material.

    Args:
        unit: "mm" | "scene".

    Raises:
        ReconstructionError: an empty mesh, or a file that does not read back (a full disk).
    """
    if not len(mesh.faces):
        raise ReconstructionError(
            "the mesh has no triangles, so no mesh file was written. Look at the report for what the photos show."
        )
    with atomic_file(path_ply) as temporary:
        mesh.export(temporary, file_type="ply", vertex_normal=True)
        _check(temporary, path_ply.name, len(mesh.faces), mesh.extents)
    scale = 1 / MM_PER_METRE if unit == "mm" else 1.0
    y_up = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    colours = decode_srgb(vertex_colours(mesh))
    with atomic_file(path_glb) as temporary:
        vertices = scale * mesh.vertices @ y_up.T
        temporary.write_bytes(write_glb(vertices, mesh.vertex_normals @ y_up.T, colours, mesh.faces))
        _check(temporary, path_glb.name, len(mesh.faces), np.ptp(vertices, axis=0))


def _check(path: Path, name: str, faces: int, extents: Float[np.ndarray, "3"]) -> None:
    """Raise unless the file holds so many triangles of that extent (to float32)."""
    found = trimesh.load_mesh(path, process=False)
    if len(found.faces) != faces or not np.allclose(found.extents, extents, rtol=1e-4):
        raise ReconstructionError(
            f"{name} reads back with {len(found.faces)} triangles and extents {found.extents}, "
            f"{faces} and {extents} were written. Check the disk and export again."
        )
