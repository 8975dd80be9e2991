"""The G-buffer of a solved scene: surface_maps (depth, normals, mask), material_at (of any point), look (both)."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Integer
from scipy.ndimage import binary_erosion
from scipy.spatial import KDTree
from torch import Tensor

from calibration.posed_camera import PosedCamera
from reconstruct.appearance.brdf import Gloss
from reconstruct.fields import SolvedScene
from reconstruct.render.radiosity import Patches, PatchWeights, find_patches, nearest_patches
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.rays import first_hits

RAYS_PER_BLOCK = 2**18  # about 40 MB of rays at a time, for photos of any size
SAME_DEPTH = 2.0  # voxels: a pixel that sees something nearer than a point does not see the point
MIN_FACING = 0.15  # cosine to the view ray (about 81 degrees); below it a pixel's albedo is unreliable
NEIGHBOURS = 4  # seen points averaged for the material of one beside them
WIDE_NEIGHBOURS = 24  # means of seen points that a hidden one is averaged from
CELLS = 32  # along the longest side of what is seen: the size of the cells whose means these are
NEAR = (0.5, 2.0)  # cells from the nearest seen point, over which the near average goes over into the wide one
SAME_POINT = 1e-6  # world length: closer points are equal in float32


@dataclass(frozen=True)
class SurfaceMaps:
    """The surface that each pixel of a camera sees. World frame."""

    depth: Float[Tensor, "height width"]  # z-depth; inf where nothing
    normals: Float[Tensor, "height width 3"]  # unit, outward; 0 where nothing
    mask: Bool[Tensor, "height width"]  # the object, not the ground
    points: Float[Tensor, "height width 3"]  # 0 where nothing


@dataclass(frozen=True)
class Interreflection:
    """Data that a view needs for interreflection."""

    patches: Patches  # of the whole scene
    albedo: Float[Tensor, "patches 3"]  # of each, true
    weights: PatchWeights  # of the pixels that see something, in their order

    def at_pixels(self, arriving: Float[Tensor, "patches 3"]) -> Float[Tensor, "n 3"]:
        """Return the irradiance of the pixels by one reflection at the patches.

        Args:
            arriving: direct irradiance of the patches.
        """
        return self.weights.interpolated(self.patches.bounced(self.albedo, arriving))


@dataclass(frozen=True)
class RenderView:
    """A scene seen by one camera, ready to be lit; it can be reused while the light moves."""

    maps: SurfaceMaps
    albedo: Float[Tensor, "height width 3"]  # linear; 0 where nothing
    grid: SdfGrid
    eye: Float[Tensor, "3"]  # the camera's centre, world
    gloss: Gloss | None = None  # of the same pixels; None: all is matt
    interreflection: Interreflection | None = None  # None: surfaces send each other no light


@dataclass(frozen=True)
class SeenPoints:
    """Points of object or ground that cameras see well, and what is known there. World frame."""

    points: Float[np.ndarray, "seen 3"]
    values: Float[np.ndarray, "seen channels"]  # albedo, and of the object the weights of Gloss, where there is one

    @cached_property
    def tree(self) -> KDTree:
        """A search tree over the points, built once."""
        return KDTree(self.points, balanced_tree=False, compact_nodes=False)  # from afar, eight times as fast

    @cached_property
    def means(self) -> tuple[KDTree, Float[np.ndarray, "cells channels"], float]:
        """Means of the points in cells, CELLS along the longest side of their box, and of their values; cells' size."""
        size = float(np.ptp(self.points, axis=0).max(initial=0.0)) / CELLS if len(self.points) else 0.0
        cell, means = in_cells(self.points, size)
        count = np.bincount(cell, minlength=len(means))
        values = [np.bincount(cell, column, len(means)) / count for column in self.values.T]
        return KDTree(means), np.stack(values, 1), size

    def at(
        self, points: Float[np.ndarray, "n 3"], otherwise: Float[np.ndarray, " channels"]
    ) -> Float[np.ndarray, "n channels"]:
        """Interpolate the values from the NEIGHBOURS nearest seen points, weighted by 1 / distance^2.

        Points farther from them than NEAR take the wide average, in between a share of both.
        """
        seen = self.tree
        if not seen.n or not len(points):
            return np.broadcast_to(otherwise, (len(points), len(otherwise))).copy()
        if seen.n == 1:
            return np.broadcast_to(self.values, (len(points), self.values.shape[1])).copy()
        size, has_wide = max(self.means[2], SAME_POINT), self.means[0].n > WIDE_NEIGHBOURS
        asked = 2 * NEAR[1] * size if has_wide else np.inf  # from afar, many points are about as near: that takes long
        distance, index = seen.query(points, k=min(NEIGHBOURS, seen.n), distance_upper_bound=asked, workers=-1)
        distance, index = distance.reshape(len(points), -1), np.minimum(index, seen.n - 1).reshape(len(points), -1)
        weight = 1 / np.maximum(distance, SAME_POINT) ** 2
        total = np.maximum(weight.sum(1, keepdims=True), np.finfo(float).tiny)
        out = ((weight / total)[:, :, None] * self.values[index]).sum(1)
        away = np.clip((distance[:, 0] / size - NEAR[0]) / (NEAR[1] - NEAR[0]), 0, 1)
        far = away > 0
        if far.any() and has_wide:
            share = (away[far] ** 2 * (3 - 2 * away[far]))[:, None]
            out[far] += share * (self._from_means(points[far]) - out[far])
        return out.astype(np.float32)

    def _from_means(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n channels"]:
        """Interpolate the cells' means at points far from all of them.

        Weights are ((R - d) / (R d))^2 with R the distance to the last neighbour [Franke and Nielson 1980]: a neighbour
        that comes or goes has weight 0, so that nothing jumps where another set of neighbours begins.
        """
        tree, means, _ = self.means
        distance, index = tree.query(points, k=WIDE_NEIGHBOURS, workers=-1)
        last = distance[:, -1:]
        weight = ((last - distance) / (last * np.maximum(distance, SAME_POINT))) ** 2 + SAME_POINT**4
        return ((weight / weight.sum(1, keepdims=True))[:, :, None] * means[index]).sum(1)


@dataclass(frozen=True)
class SeenMaterial:
    """Material of the points that the capture cameras see well, away from outlines and grazing views."""

    on_object: SeenPoints
    on_ground: SeenPoints
    fields: SolvedScene  # that it was made of

    @cached_property
    def patches(self) -> tuple[Patches, Float[Tensor, "patches 3"]] | None:
        """The patches of object and ground with their true albedo, made once; None without interreflection."""
        found = find_patches(self.fields.grid, self.fields.ground_height) if self.fields.interreflection > 0 else None
        if found is None:
            return None
        return found, self.fields.interreflection * material_at(self, found.points, found.on_object)[0]


def in_cells(
    points: Float[np.ndarray, "n 3"], size: float
) -> tuple[Integer[np.ndarray, " n"], Float[np.ndarray, "cells 3"]]:
    """Return the number of each point's cell, and the means of the points in each; one cell for all if size is 0.

    Args:
        size: of a cell, in the points' length unit.
    """
    place = np.floor((points - points.min(0)) / size).astype(np.int64) if size > 0 else np.zeros((len(points), 3), int)
    # One number for each cell: sorting rows of three would take ten times as long.
    _, cell = np.unique(np.ravel_multi_index(tuple(place.T), place.max(0, initial=0) + 1), return_inverse=True)
    count = np.bincount(cell)
    return cell, np.stack([np.bincount(cell, points[:, axis]) / count for axis in range(3)], 1)


def camera_rays(posed_camera: PosedCamera, rows: slice) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]]:
    """Return unit world directions of the pixels of some rows, and the range along each ray per unit of z-depth."""
    camera = posed_camera.camera
    through = camera.unproject(camera.pixel_grid()[rows].reshape(-1, 2))
    stretch = np.linalg.norm(through, axis=1)
    directions = posed_camera.world_from_camera.rotate(through / stretch[:, None])
    return torch.from_numpy(directions).float(), torch.from_numpy(stretch).float()


def surface_maps(grid: SdfGrid, posed_camera: PosedCamera) -> SurfaceMaps:
    """Return depth, normal and mask of every pixel of a camera, along its true (distorted) ray: object, else ground."""
    camera = posed_camera.camera
    rows = max(1, RAYS_PER_BLOCK // camera.width)
    eye = torch.from_numpy(posed_camera.centre).float()
    blocks = []
    for first in range(0, camera.height, rows):
        directions, stretch = camera_rays(posed_camera, slice(first, first + rows))
        blocks.append(_seen_along(grid, posed_camera.ground_height, eye, directions, stretch))
    depth, normals, mask, points = (torch.cat(parts) for parts in zip(*blocks, strict=True))
    shape = (camera.height, camera.width)
    return SurfaceMaps(depth.reshape(shape), normals.reshape(*shape, 3), mask.reshape(shape), points.reshape(*shape, 3))


def _seen_along(
    grid: SdfGrid,
    ground_height: float,
    eye: Float[Tensor, "3"],
    directions: Float[Tensor, "n 3"],
    stretch: Float[Tensor, " n"],
) -> tuple[Float[Tensor, " n"], Float[Tensor, "n 3"], Bool[Tensor, " n"], Float[Tensor, "n 3"]]:
    """Return z-depth, normal, is-object and world point of the first hit along each ray from the eye."""
    to_ground = (ground_height - eye[2]) / directions[:, 2]
    to_ground = torch.where(to_ground > 0, to_ground, torch.inf)
    first = first_hits(grid, eye, directions, to_ground)
    t, mask = first.distance, first.on_object
    seen = torch.isfinite(t)
    points = torch.where(seen[:, None], eye + torch.where(seen, t, 0)[:, None] * directions, 0)
    normals = torch.zeros_like(points)
    normals[seen & ~mask] = torch.tensor([0.0, 0.0, 1.0])
    normals[mask] = torch.nn.functional.normalize(grid.gradient(points[mask]), dim=-1)
    return t / stretch, normals, mask, points


def seen_material(fields: SolvedScene) -> SeenMaterial:
    """Return the reliable part of the albedo that every camera saw as world points.

    A pixel on the outline mixes object and ground, so one pixel is left out on both sides; not where the object stands
    on the ground, as nothing else would show its foot. If nothing remains (an object of a few pixels), all seen pixels
    are used.
    """
    parts = [_seen_by_one(view) for view in fields.views()]
    both = [[getattr(part, name) for part in parts] for name in ("on_object", "on_ground")]
    joined = [[np.concatenate([getattr(own, x) for own in some]) for x in ("points", "values")] for some in both]
    return SeenMaterial(*(SeenPoints(*own) for own in joined), fields)


def _seen_by_one(fields: SolvedScene) -> SeenMaterial:
    """Return the material that the first camera saw."""
    maps = surface_maps(fields.grid, fields.posed_camera)
    mask, albedo = maps.mask.numpy(), fields.albedo.numpy()
    gloss = np.zeros((*mask.shape, 0), np.float32) if fields.gloss is None else fields.gloss.weights.numpy()
    finite = torch.isfinite(maps.depth).numpy()
    towards_eye = torch.from_numpy(fields.posed_camera.centre).float() - maps.points
    distance = towards_eye.norm(dim=-1)
    facing = ((maps.normals * towards_eye).sum(-1) / distance).numpy()
    footprint = distance.numpy() / fields.camera.fx
    square = np.ones((3, 3), bool)
    inside = np.asarray(binary_erosion(mask, square, border_value=1), bool)
    inside |= away_from_outlines(maps, facing, footprint, fields.grid.spacing)
    trusted = inside & (facing > MIN_FACING)
    ground = np.asarray(binary_erosion(finite & ~mask, square, border_value=1), bool)
    trusted = trusted if trusted.any() else mask
    points = maps.points.numpy()
    if fields.object_from_world is not None:  # of another object pose: its ground is not that of the scene
        points = fields.in_common(points.reshape(-1, 3).astype(float)).reshape(points.shape).astype(np.float32)
        ground = np.zeros_like(ground)
    on_object = SeenPoints(points[trusted], np.concatenate([albedo, gloss], -1)[trusted])
    return SeenMaterial(on_object, SeenPoints(points[ground], albedo[ground]), fields)


def away_from_outlines(
    maps: SurfaceMaps,
    facing: Float[np.ndarray, "height width"],
    footprint: Float[np.ndarray, "height width"],
    spacing: float,
) -> Bool[np.ndarray, "height width"]:
    """Find the pixels of the object beside which nothing lies far before or behind: what stands before it included.

    Args:
        facing: cosine to the view ray.
        footprint: width of a pixel on a surface that faces the camera, world length.
        spacing: of the grid: two voxels, and the slope of the surface, are no step.
    """
    cosine = np.clip(facing, MIN_FACING, 1)
    step = SAME_DEPTH * spacing + 2 * footprint * np.sqrt(1 - cosine**2) / cosine
    depth, window = finite(maps.depth.numpy()), np.ones((3, 3), np.uint8)
    return maps.mask.numpy() & (cv2.dilate(depth, window) - cv2.erode(depth, window) < step)


def finite(depth: Float[np.ndarray, "height width"]) -> Float[np.ndarray, "height width"]:
    """Return a depth map with 0 where nothing is seen."""
    return np.where(np.isfinite(depth), depth, 0).astype(np.float32)


def material_at(
    material: SeenMaterial, points: Float[Tensor, "n 3"], on_object: Bool[Tensor, " n"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n materials"]]:
    """Return the linear albedo of world points on the surface, and their weights of Gloss, 0 on the ground.

    A point on the object takes the weighted mean of its nearest object points (in 3-D) that a capture camera sees;
    far from them, that of the means of cells around it, which changes without a seam. Ground inside the photo takes
    seen ground in the same way; ground outside the photo takes the mean of all seen ground.
    """
    seen, ground = material.on_object, material.on_ground
    where, is_object = points.numpy(), on_object.numpy()
    mean = ground.values.mean(0) if len(ground.values) else np.full(3, 0.5, np.float32)
    nothing = np.zeros(seen.values.shape[1] - 3, np.float32)
    out = np.tile(np.concatenate([mean, nothing]), (len(points), 1))
    out[is_object] = seen.at(where[is_object], np.concatenate([mean, nothing]))
    inside = _inside_photo(material.fields, where) & ~is_object
    out[inside, :3] = ground.at(where[inside], mean)
    albedo, gloss = np.split(out, [3], 1)
    return torch.from_numpy(np.ascontiguousarray(albedo)), torch.from_numpy(np.ascontiguousarray(gloss))


def _inside_photo(fields: SolvedScene, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Find the world points in front of a capture camera and inside its picture."""
    inside = np.zeros(len(points), bool)
    for view in (fields, *(one for one in fields.further if one.object_from_world is None)):
        posed_camera = PosedCamera(view.camera, view.world_from_camera, fields.ground_height)
        uv, depth = posed_camera.project_with_depth(points.astype(float))
        ends = [view.camera.width - 0.5, view.camera.height - 0.5]
        inside |= (depth > 0) & ((uv > -0.5) & (uv < ends)).all(1)
    return inside


def look(
    fields: SolvedScene,
    width: int | None = None,
    posed_camera: PosedCamera | None = None,
    material: SeenMaterial | None = None,
) -> RenderView:
    """Return the scene seen by a camera (by default the capture camera), ready for `relight`.

    Args:
        width: picture width, px; default: the camera's own (400 is fast enough to drag a light).
        posed_camera: another camera or viewpoint.
        material: `seen_material(fields)`, to be reused over several views.
    """
    posed_camera = posed_camera or fields.posed_camera
    if width is not None:
        camera = posed_camera.camera
        posed_camera = posed_camera.resized(width, max(1, round(camera.height * width / camera.width)))
    material = material or seen_material(fields)
    maps = surface_maps(fields.grid, posed_camera)
    seen = torch.isfinite(maps.depth)
    where = maps.points[seen], maps.mask[seen]
    albedo = torch.zeros_like(maps.points)
    albedo[seen], of_seen = material_at(material, *where)
    eye = torch.from_numpy(posed_camera.centre).float()
    interreflection, gloss = None, None
    if material.patches is not None:
        interreflection = Interreflection(
            *material.patches, nearest_patches(material.patches[0], where[0], maps.normals[seen])
        )
    if fields.gloss is not None:
        weights = torch.zeros(*maps.depth.shape, len(fields.gloss.lobes))
        weights[seen] = of_seen
        gloss = Gloss(fields.gloss.lobes, weights)
    return RenderView(maps, albedo, fields.grid, eye, gloss, interreflection)
