"""A solved scene small enough for a web page: distances and colours on a grid, the ground as a picture."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import distance_transform_edt

from capture.photos.photo import encode_srgb
from reconstruct.fields import Fields
from reconstruct.render.g_buffer import albedo_at, seen_material
from reconstruct.render.studio import Studio
from reconstruct.sdf.grid import SdfGrid

MAX_NODES = 176**3  # 11 MB on the graphics card as half floats, 22 MB of colours
MARGIN = 2  # nodes of air around the object
BAND = 4.0  # voxels within which distances are kept finely; a solve keeps them up to six
STEP = 1 / 64  # voxel: below the effect of trilinear interpolation on a normal
COARSE_STEP = 0.5  # voxels, beyond the band, where rays only take long steps
SLACK = 1.75  # voxels by which a node may lie outside a region that has no node nearer: the diagonal of a cell
COLOURED = 1.75  # voxels from the surface: all corners of the cells that it passes through
GROUND_SIZE = 512  # px
GROUND_RADII = 3.0  # half the side of the ground's picture, in radii of the object
BLEND = 0.06  # of that picture's side: width of the edge where the ground blends into its mean colour


@dataclass(frozen=True)
class PageScene:
    """The scene that the page draws. Grid lengths are in voxels, positions in the world frame."""

    distances: Float[np.ndarray, "nx ny nz"]  # float16, voxels, negative inside; beyond BAND at most the true distance
    colours: UInt8[np.ndarray, "n 3"]  # sRGB albedo of the nodes within COLOURED, in C order
    origin: Float[np.ndarray, "3"]  # of node (0, 0, 0)
    spacing: float
    ground: UInt8[np.ndarray, "size size 3"]  # sRGB albedo; row 0 at the largest y, column 0 at the smallest x
    ground_centre: Float[np.ndarray, "2"]  # x, y of the picture's middle
    ground_half: float  # half the side of the picture
    ground_mean: UInt8[np.ndarray, "3"]  # sRGB, beyond the picture
    ground_height: float


def page_scene(fields: Fields, studio: Studio) -> PageScene:
    """Return the part of the scene around the object, with at most MAX_NODES grid nodes."""
    grid = _window(fields)
    distances = leaping_distances(grid.values.numpy() / grid.spacing)
    ground, mean = _ground(fields, studio)
    return PageScene(
        distances,
        _colours(fields, grid, coloured(distances)),
        grid.origin.double().numpy(),
        grid.spacing,
        ground,
        studio.centre[:2],
        GROUND_RADII * studio.radius,
        mean,
        fields.ground_height,
    )


def leaping_distances(voxels: Float[np.ndarray, "nx ny nz"]) -> Float[np.ndarray, "nx ny nz"]:
    """Return distances (voxels, float16) for sphere tracing: fine near the surface, conservative and coarse elsewhere.

    Outside BAND: the distance to the nearest node in it (Euclidean distance transform), minus SLACK, plus BAND.
    """
    near = np.clip(np.round(voxels / STEP) * STEP, -BAND, BAND)
    away = voxels >= BAND
    if away.any() and not away.all():
        leap = np.asarray(distance_transform_edt(away)) - SLACK
        far = BAND + np.floor(np.maximum(leap, 0) / COARSE_STEP) * COARSE_STEP
        near = np.where(away, far, near)
    return near.astype(np.float16)


def coloured(distances: Float[np.ndarray, "nx ny nz"]) -> Bool[np.ndarray, "nx ny nz"]:
    """Return the mask of the nodes that have a colour."""
    return np.abs(distances) < COLOURED


def _window(fields: Fields) -> SdfGrid:
    """Return the grid around the object, from just below the ground, coarsened to at most MAX_NODES."""
    grid = fields.grid
    inside = torch.nonzero(grid.values < 0)
    lowest = inside.min(0).values if len(inside) else torch.zeros(3, dtype=torch.long)
    highest = inside.max(0).values if len(inside) else torch.tensor(grid.values.shape) - 1
    ground = int(np.floor((fields.ground_height - float(grid.origin[2])) / grid.spacing))
    lowest[2] = max(int(lowest[2]), min(ground, int(highest[2]) - 1))
    first = (lowest - MARGIN).double()
    count = (highest - lowest + 1 + 2 * MARGIN).double()
    stride = max(1.0, float((count.prod() / MAX_NODES) ** (1 / 3)))
    shape = torch.ceil(count / stride).long().tolist()
    axes = [float(first[a]) + stride * torch.arange(shape[a]) for a in range(3)]
    nodes = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3).float()
    values = grid.sdf(grid.origin + grid.spacing * nodes).reshape(shape)
    origin = grid.origin + grid.spacing * first.float()
    return SdfGrid(values, origin, grid.spacing * stride)


def _colours(fields: Fields, grid: SdfGrid, nodes: Bool[np.ndarray, "nx ny nz"]) -> UInt8[np.ndarray, "n 3"]:
    """Return the sRGB albedo of the surface point nearest to each of these nodes."""
    index = torch.from_numpy(np.argwhere(nodes)).float()
    points = grid.origin + grid.spacing * index
    slope = torch.nn.functional.normalize(grid.gradient(points), dim=-1)
    points = points - grid.sdf(points)[:, None] * slope
    albedo = albedo_at(fields, seen_material(fields), points, torch.ones(len(points), dtype=torch.bool))
    return encode_srgb(albedo.numpy())


def _ground(fields: Fields, studio: Studio) -> tuple[UInt8[np.ndarray, "size size 3"], UInt8[np.ndarray, "3"]]:
    """Return the ground's picture from above and its mean colour, which fills parts that no photo shows (soft edge)."""
    across = (np.arange(GROUND_SIZE) + 0.5) / GROUND_SIZE * 2 - 1
    x, y = np.meshgrid(across, -across)
    reach = GROUND_RADII * studio.radius
    points = np.stack(
        [studio.centre[0] + reach * x, studio.centre[1] + reach * y, np.full_like(x, fields.ground_height)], -1
    )
    flat = torch.from_numpy(points.reshape(-1, 3)).float()
    material = seen_material(fields)
    albedo = albedo_at(fields, material, flat, torch.zeros(len(flat), dtype=torch.bool)).numpy().reshape(*x.shape, 3)
    mean = material.ground_albedo.mean(0) if len(material.ground_albedo) else np.full(3, 0.5, np.float32)
    is_seen = np.pad((albedo != mean).any(-1), 1)
    inwards = np.asarray(distance_transform_edt(is_seen))[1:-1, 1:-1] / (BLEND * GROUND_SIZE)
    share = np.clip(inwards, 0, 1)[..., None]
    return encode_srgb(mean + share * (albedo - mean)), encode_srgb(mean)
