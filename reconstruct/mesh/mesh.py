"""Extract a closed, coloured triangle mesh of the object without the ground from the SDF; write PLY and GLB."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float, Int, UInt8
from scipy import ndimage
from skimage.measure import marching_cubes
from trimesh.visual import ColorVisuals

from capture.errors import ReconstructionError, Remedy
from capture.files.atomic import atomic_file
from capture.photos.photo import decode_srgb, encode_srgb
from reconstruct.appearance.brdf import MetalRough, metal_rough
from reconstruct.fields import SolvedScene
from reconstruct.mesh.evidence import vertex_evidence
from reconstruct.mesh.glb import Y_UP, metres, write_glb
from reconstruct.render.g_buffer import material_at, seen_material, surface_maps
from reconstruct.sdf.grid import SdfGrid

MAX_NODES = 400**3  # nodes around the object: beyond, marching cubes alone takes more than 2 GB
PREVIEW_NODES = 96**3  # 30 thousand faces, which a browser can draw several times a second
ISLAND_SHARE = 0.01  # of the largest piece's volume: smaller ones are debris,
SEEN_SHARE = 0.005  # unless a camera sees one in as many of the object's pixels: an ear's tip, a hand, a thin rail
OFF_SURFACE = 0.01  # voxels: nodes closer to the surface are moved, because their triangles would have no area

Seen = Callable[[], Sequence[Float[np.ndarray, "_ 3"]]]  # where each view's rays meet the object first, world
Axes = tuple[Float[np.ndarray, " _"], Float[np.ndarray, " _"], Float[np.ndarray, " _"]]  # voxels; z from the ground


def extract_mesh(fields: SolvedScene, max_nodes: int = MAX_NODES) -> trimesh.Trimesh:
    """Return the object's surface above the ground, world frame: closed, outward, with normals and sRGB albedo.

    If the solve stored its ray counts, `vertex_attributes` has `evidence` and `sigma` (reconstruct.mesh.evidence).

    Raises:
        ReconstructionError: there is no surface above the ground, it is not closed, or the grid around the object has
            more than max_nodes nodes.
    """
    mesh = surface_mesh(fields.grid, fields.ground_height, max_nodes, lambda: seen_points(fields))
    vertices = torch.from_numpy(np.asarray(mesh.vertices)).float()
    albedo, _ = material_at(seen_material(fields), vertices, torch.ones(len(vertices), dtype=torch.bool))
    mesh.visual = ColorVisuals(mesh, vertex_colors=encode_srgb(albedo.numpy()))
    evidence = vertex_evidence(fields, np.asarray(mesh.vertices))
    if evidence is not None:
        mesh.vertex_attributes |= {"evidence": evidence.kind, "sigma": evidence.sigma}
    return mesh


def seen_points(fields: SolvedScene) -> list[Float[np.ndarray, "_ 3"]]:
    """Return where the rays of each view's pixels meet the object first, in the frame that all views share."""
    maps = [(view, surface_maps(view.grid, view.posed_camera)) for view in fields.views()]
    return [view.in_common(own.points[own.mask].double().numpy()) for view, own in maps]


def preview_mesh(grid: SdfGrid, ground_height: float, max_nodes: int = PREVIEW_NODES) -> trimesh.Trimesh | None:
    """Return a coarse, uncoloured mesh from at most about max_nodes nodes, fast enough to watch a surface grow.

    None if so few nodes show no surface, because thin parts lie between them.
    """
    stride = max(1, int(np.ceil((grid.values.numel() / max_nodes) ** (1 / 3))))
    coarse = SdfGrid(grid.values[::stride, ::stride, ::stride], grid.origin, grid.spacing * stride)
    try:
        return surface_mesh(coarse, ground_height, MAX_NODES)
    except ReconstructionError:
        return None


def surface_mesh(grid: SdfGrid, ground_height: float, max_nodes: int, seen: Seen = lambda: ()) -> trimesh.Trimesh:
    """Return the uncoloured surface above the ground, world frame: closed, with a flat base exactly on the ground.

    Args:
        seen: is asked if a piece is small enough for debris: it stays if a camera sees much of it.

    Raises:
        ReconstructionError: as of extract_mesh.
    """
    layers, axes = _above_ground(grid, ground_height)
    solid, axes = _around_object(layers, axes, max_nodes)
    _drop_islands(solid, lambda: [_voxels_of(points, grid, ground_height, axes) for points in seen()])
    near = np.abs(solid) < OFF_SURFACE
    solid[near] = np.where(solid[near] < 0, -OFF_SURFACE, OFF_SURFACE)
    index, faces, _, _ = marching_cubes(solid, 0.0, gradient_direction="descent", allow_degenerate=False)
    voxels = np.stack([np.interp(index[:, a], np.arange(len(axes[a])), axes[a]) for a in range(3)], 1)
    lowest = np.append(grid.origin[:2].double().numpy(), ground_height)
    vertices = lowest + grid.spacing * voxels
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if not (mesh.is_watertight and mesh.volume > 0):
        raise ReconstructionError(
            f"the surface of {len(faces)} triangles is not closed, and a closed one was needed.",
            "report this with the run folder",
            Remedy.COARSER,
        )
    mesh.vertex_normals = _normals(grid, ground_height, mesh)
    return mesh


def _above_ground(grid: SdfGrid, ground_height: float) -> tuple[Float[np.ndarray, "nx ny levels"], Axes]:
    """Return the SDF in voxels at the nodes above the ground and in a layer on it, and the nodes' places by axis.

    A cut with max(sdf, ground - z) instead would bevel the rim of the base by up to a voxel.
    """
    values = grid.in_voxels()
    height = (float(grid.origin[2]) - ground_height) / grid.spacing + np.arange(values.shape[2])
    first = int(np.searchsorted(height, OFF_SURFACE, side="right"))
    layers, levels = values[:, :, first:], height[first:]
    if 0 < first < len(height):
        share = height[first]  # of the layer below: nodes are one voxel apart
        on_ground = (1 - share) * values[:, :, first] + share * values[:, :, first - 1]
        layers, levels = np.concatenate([on_ground[:, :, None], layers], 2), np.append(0.0, levels)
    return layers.astype(np.float32), (np.arange(values.shape[0]) * 1.0, np.arange(values.shape[1]) * 1.0, levels)


def _around_object(
    layers: Float[np.ndarray, "nx ny levels"], axes: Axes, max_nodes: int
) -> tuple[Float[np.ndarray, "mx my mz"], Axes]:
    """Crop to the object with air on every side; also return the nodes' places. The base ends on the ground."""
    inside = layers < 0
    if not inside.any():
        raise ReconstructionError(
            "no surface was found above the ground: the photos show no object, or all of it was proven empty. "
            "Check in report.html that the object is in the picture and that its shadows are dark."
        )
    spans = [np.flatnonzero(inside.any(axis=tuple(b for b in range(3) if b != a)))[[0, -1]] for a in range(3)]
    nodes = int(np.prod([last - first + 3 for first, last in spans]))
    if nodes > max_nodes:
        raise ReconstructionError(
            f"the grid has {nodes / 1e6:.3g} million nodes around the object, at most {max_nodes / 1e6:.3g} million "
            "fit in memory for the mesh.",
            Remedy.COARSER,
        )
    window = tuple(slice(max(first - 1, 0), last + 2) for first, last in spans)
    walls = [(int(first == 0), int(last == n - 1)) for (first, last), n in zip(spans, layers.shape, strict=True)]
    solid = np.pad(layers[window], walls, constant_values=1.0)  # air beyond the walls of the box
    places = [np.pad(axis[w], wall) for axis, w, wall in zip(axes, window, walls, strict=True)]
    for place, (low, high) in zip(places, walls, strict=True):
        place[0] = place[1] - 1 if low else place[0]
        place[-1] = place[-2] + 1 if high else place[-1]
    places[2] = np.maximum(places[2], 0)  # the air below the base has no thickness
    return solid, (places[0], places[1], places[2])


def _voxels_of(
    points: Float[np.ndarray, "n 3"], grid: SdfGrid, ground_height: float, axes: Axes
) -> Int[np.ndarray, "n 3"]:
    """Return the indices of the nodes that are nearest to world points."""
    lowest = np.append(grid.origin[:2].double().numpy(), ground_height)
    at = (points - lowest) / grid.spacing
    places = [np.interp(at[:, a], axes[a], np.arange(len(axes[a]))) for a in range(3)]
    return np.rint(np.stack(places, 1)).astype(int)


def _drop_islands(solid: Float[np.ndarray, "nx ny nz"], seen: Callable[[], Sequence[Int[np.ndarray, "_ 3"]]]) -> None:
    """Remove, in place, small pieces that no camera sees much of, and fill enclosed cavities."""
    labels = np.zeros(solid.shape, np.int32)
    ndimage.label(solid < 0, output=labels)
    if labels.max() > 1:
        volume = np.bincount(labels.ravel())[1:]
        small = np.append(False, volume < ISLAND_SHARE * volume.max())
        if small.any():
            small &= ~_is_seen(labels, seen())
        debris = small[labels]
        solid[debris] = -solid[debris]
    ndimage.label(solid >= 0, output=labels)
    if labels.max() > 1:  # the corner is air: one node of it surrounds the object
        cavity = (labels > 0) & (labels != labels[0, 0, 0])
        solid[cavity] = -solid[cavity]


def _is_seen(
    labels: Int[np.ndarray, "nx ny nz"], seen: Sequence[Int[np.ndarray, "_ 3"]]
) -> Bool[np.ndarray, " labels"]:
    """Return, for each label, whether some view sees the piece in SEEN_SHARE of its pixels or more."""
    about = ndimage.maximum_filter(labels, 3)  # a node nearest to the surface may be outside
    found = np.zeros(labels.max() + 1, np.bool_)
    for nodes in seen:
        count = np.bincount(about[tuple(nodes.T)], minlength=len(found))
        found |= count >= max(1, SEEN_SHARE * len(nodes))
    return found


def _normals(grid: SdfGrid, ground_height: float, mesh: trimesh.Trimesh) -> Float[np.ndarray, "n 3"]:
    """Return unit outward normals of the vertices: the SDF's gradient; straight down on the cut at the ground."""
    points = torch.from_numpy(np.asarray(mesh.vertices)).float()
    normals = torch.nn.functional.normalize(grid.gradient(points), dim=-1).double().numpy()
    flat = np.asarray(mesh.vertex_normals)
    on_cut = mesh.vertices[:, 2] < ground_height + OFF_SURFACE * grid.spacing
    agrees = (normals * flat).sum(1) > 0  # box walls and filled places have no gradient of their own
    return np.where((on_cut | ~agrees)[:, None], flat, normals)


def vertex_colours(mesh: trimesh.Trimesh) -> UInt8[np.ndarray, "n 3"]:
    """Return the sRGB colours of a mesh's vertices."""
    visual = mesh.visual
    assert isinstance(visual, ColorVisuals)
    return np.asarray(visual.vertex_colors)[:, :3]


def mesh_material(fields: SolvedScene, mesh: trimesh.Trimesh) -> MetalRough | None:
    """Return the mesh's glTF material with a colour per vertex; None if no gloss was found."""
    if fields.gloss is None:
        return None
    vertices = torch.from_numpy(np.asarray(mesh.vertices)).float()
    _, weights = material_at(seen_material(fields), vertices, torch.ones(len(vertices), dtype=torch.bool))
    coefficients = replace(fields.gloss, weights=weights).coefficients()
    return metal_rough(torch.from_numpy(decode_srgb(vertex_colours(mesh))), coefficients)


def save_mesh(
    mesh: trimesh.Trimesh, path_ply: Path, path_glb: Path, unit: str, material: MetalRough | None = None
) -> None:
    """Write a PLY and a GLB file atomically.

    PLY: world frame and unit, normals, sRGB colours, `evidence` and `sigma` if known. GLB: metres (scene units are not
    converted), y up, linear colours, one metallic-roughness material.

    Args:
        unit: "mm" | "scene".
        material: of the GLB; by default rough and not metallic, in the mesh's colours.

    Raises:
        ReconstructionError: the mesh is empty.
        OSError: a file cannot be written.
    """
    if not len(mesh.faces):
        raise ReconstructionError(
            "the mesh has no triangles, so no mesh file was written. Look at the report for what the photos show."
        )
    with atomic_file(path_ply) as temporary:
        mesh.export(temporary, file_type="ply", vertex_normal=True)
    if material is None:
        material = MetalRough(torch.from_numpy(decode_srgb(vertex_colours(mesh))), 0.0, 1.0)
    gloss = (material.metallic, material.roughness)
    with atomic_file(path_glb) as temporary:
        vertices = metres(unit) * mesh.vertices @ Y_UP.T
        normals = mesh.vertex_normals @ Y_UP.T
        temporary.write_bytes(write_glb(vertices, normals, material.base.numpy(), mesh.faces, *gloss))
