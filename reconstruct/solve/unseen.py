"""Mean curvature flow of the hidden surface: it removes unseen matter that no ray supports.

Behind an object there is space that the camera does not see, and whose shadow falls outside its view, too. No ray
needs matter there, and no ray proves it empty. Of all surfaces that agree with the rays, this finds a tight one.
"""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from torch import Tensor

from reconstruct.config import FitConfig
from reconstruct.labels.supervision import DARK_ENOUGH, SURE_ENOUGH, Supervision
from reconstruct.scene import Scene
from reconstruct.sdf import kernels
from reconstruct.sdf.blocks import pack
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.level_set import redistanced
from reconstruct.sdf.rays import first_hits, lights_to_grid, to_grid, visibility
from reconstruct.solve.ray_counts import FEWEST_RAYS, ray_counts
from reconstruct.views import Scenes, each

STABLE_STEP = 1 / 6  # voxels^2: explicit steps of the flow are stable up to here
STEPS = 120  # bulges up to a radius of 2 sqrt(STEPS * STABLE_STEP) = 9 voxels vanish; larger ones become lower
CHECK_EVERY = 10  # steps: in that time at most a bulge of one voxel vanishes and has to be restored
ROUNDS = 4  # of restoring matter after a check
SEEN_SHELL = 3  # voxels about what the camera sees: known without shadows
SLIVER = 2  # px: wider is no sliver, see _slivers
EDGE_SHELL = 1  # voxels about where dark rays at the edges of shadows pass: matter is there
NEAR = 3.0  # voxels about the surface in which it moves
SHARPNESS = 8.0  # NeuS s per voxel: a ray that passes a tenth of a voxel inside counts as blocked
STEP_ALONG = 0.5  # voxels, of the search for the matter that blocked a ray
AIR = 0.5  # voxels: on the walls of the box, where matter would stick, the surface closes half a voxel inside
LEAST_MATTER = 1.0  # voxels: radius of the matter restored for a ray

Voxels = Float[np.ndarray, "nx ny nz"]
Nodes = Bool[np.ndarray, "nx ny nz"]


def without_unsupported_matter(
    surface: SdfGrid, scenes: Scene | Scenes, rays: Supervision | tuple[Supervision, ...], config: FitConfig
) -> SdfGrid:
    """Remove unseen matter that no ray supports; dark shadow rays that were blocked stay blocked.

    Mean curvature flow, d phi / dt = Laplacian phi, makes a ball of radius r vanish in a time r^2 / 4 and leaves a flat
    wall unchanged. The surface is fixed near what a camera sees and where dark rays touch it; a lit ray that touches
    it only bounds the matter. If the flow would free a dark ray, matter is restored, and fixed, where the ray
    passes closest to the remaining matter. On the ground the surface stands upright.

    Args:
        scenes: of all cameras, with the lights that the surface was solved under; world frame.
        rays: the supervision that the surface was solved from, of each scene.

    Returns:
        The surface on the same grid, world frame and length.
    """
    scenes, rays = each(scenes), each(rays)
    walls = _walls(surface.values.shape)
    phi = _in_voxels(surface)
    phi[walls] = np.maximum(phi[walls], AIR)
    phi = _as_distance(phi)
    before, low = phi.copy(), _first_above(surface, scenes[0].ground_height)
    seen = [_seen(surface, scene, own) for scene, own in zip(scenes, rays, strict=True)]
    fixed = np.logical_or.reduce([shell for _, shell in seen])
    dark = tuple(replace(own, confidence=own.confidence * (own.label < DARK_ENOUGH)) for own in rays)
    edges = ray_counts(scenes, dark, surface, config).numpy() > FEWEST_RAYS
    fixed |= walls | ndimage.binary_dilation(edges, iterations=EDGE_SHELL)
    views = zip(scenes, rays, seen, strict=True)
    guard = _Guard(_as_grid(before, surface), [_dark_rays(scene, own, at) for scene, own, (at, _) in views], fixed)
    for step in range(STEPS):
        _tighten(phi, fixed, low)
        if (step + 1) % CHECK_EVERY == 0:
            phi = _as_distance(guard.given_back(phi, fixed))
    return _as_grid(phi, surface)


def _in_voxels(grid: SdfGrid) -> Voxels:
    return np.ascontiguousarray((grid.values / grid.spacing).numpy(), np.float32)


def _as_distance(phi: Voxels) -> Voxels:
    return redistanced(pack(phi)).dense()


def _as_grid(phi: Voxels, like: SdfGrid) -> SdfGrid:
    return SdfGrid(torch.from_numpy(phi * np.float32(like.spacing)), like.origin, like.spacing)


def _walls(shape: tuple[int, ...]) -> Nodes:
    """Return the nodes on all faces of the box but the lowest."""
    walls = np.ones(shape, bool)
    walls[1:-1, 1:-1, :-1] = False
    return walls


def _first_above(surface: SdfGrid, ground_height: float) -> int:
    """Return the index of the first layer of nodes that is not below the ground."""
    level = int(np.ceil((ground_height - float(surface.origin[2])) / surface.spacing - 1e-6))
    return min(max(level, 0), surface.values.shape[2] - 1)


def _tighten(phi: Voxels, fixed: Nodes, low: int) -> None:
    """Take one step of the flow, in place; nodes below the ground copy the layer on it."""
    above = phi[:, :, low:]
    moves = (np.abs(above) < NEAR) & ~fixed[:, :, low:]
    above += np.where(moves, STABLE_STEP * np.clip(ndimage.laplace(above, mode="nearest"), -1, 1), np.float32(0))
    phi[:, :, :low] = phi[:, :, low : low + 1]


def _seen(surface: SdfGrid, scene: Scene, rays: Supervision) -> tuple[Float[np.ndarray, "pixels 3"], Nodes]:
    """Return where each pixel's ray ends (world; nan: nowhere), and the nodes near the visible object surface."""
    directions = torch.from_numpy(rays.directions).float()
    first = first_hits(surface, scene.eye, directions, torch.from_numpy(rays.ground_t).float())
    hit, on_object = first.distance.double().numpy(), first.on_object.numpy() & (rays.role != kernels.GROUND)
    end = np.where(on_object, hit, np.where(rays.role == kernels.OBJECT, np.inf, rays.ground_t))
    points = scene.eye.double().numpy() + np.where(np.isfinite(end), end, np.nan)[:, None] * rays.directions
    plain = on_object & ~_slivers(hit, on_object, rays, scene.directions.shape[:2], SEEN_SHELL * surface.spacing)
    nodes = np.rint((points[plain] - surface.origin.double().numpy()) / surface.spacing).astype(int)
    nodes = nodes[((nodes >= 0) & (nodes < surface.values.shape)).all(1)]
    shell = np.zeros(tuple(surface.values.shape), bool)
    shell[tuple(nodes.T)] = True
    return points, ndimage.binary_dilation(shell, iterations=SEEN_SHELL)


def _slivers(
    hit: Float[np.ndarray, " pixels"],
    on_object: Bool[np.ndarray, " pixels"],
    rays: Supervision,
    shape: tuple[int, int],
    step: float,
) -> Bool[np.ndarray, " pixels"]:
    """Find pixels at the outline that see a surface behind a nearer edge: they may just miss that edge.

    Args:
        hit: world length along each pixel's ray.
        shape: of the picture.
        step: world length from which something lies behind.
    """
    depth = np.full(shape, np.inf, np.float32)
    depth.flat[rays.pixels[on_object]] = hit[on_object]
    window = np.ones((2 * SLIVER + 1,) * 2, np.uint8)
    found = (depth > cv2.erode(depth, window) + step) & np.isinf(cv2.dilate(depth, window))
    return found.flat[rays.pixels]


def _dark_rays(
    scene: Scene, rays: Supervision, points: Float[np.ndarray, "pixels 3"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 4"]]:
    """Return the start and the light, world, of a view's surely dark shadow rays from points that its pixels see."""
    dark = (rays.label < DARK_ENOUGH) & (rays.confidence > SURE_ENOUGH) & (rays.role != kernels.EDGE)
    photo, pixel = np.nonzero(dark & np.isfinite(points[:, 0]))
    return torch.from_numpy(points[pixel]).float(), scene.lights[torch.from_numpy(photo)]


class _Guard:
    """The dark shadow rays that only movable matter blocks, and the surface that blocked them."""

    def __init__(self, before: SdfGrid, dark: Sequence[tuple[Tensor, Tensor]], fixed: Nodes):
        self._before, self._phi = before, _in_voxels(before)
        self._starts, self._lights = (torch.cat(parts) for parts in zip(*dark, strict=True))
        self._keep(self._free(np.where(fixed, self._phi, np.float32(NEAR))))
        self._keep(~self._free(self._phi))

    def _keep(self, chosen: Bool[np.ndarray, " rays"]) -> None:
        which = torch.from_numpy(chosen)
        self._starts, self._lights = self._starts[which].contiguous(), self._lights[which].contiguous()

    def _free(self, phi: Voxels) -> Bool[np.ndarray, " rays"]:
        """Return which of the rays reach their light."""
        grid = _as_grid(phi, self._before)
        return visibility(grid, self._starts, self._lights, SHARPNESS / grid.spacing).numpy() > DARK_ENOUGH

    def given_back(self, phi: Voxels, fixed: Nodes) -> Voxels:
        """Return phi with matter restored where rays became free, and add that matter to `fixed` in place."""
        for _ in range(ROUNDS):
            places = self._closest(phi, self._free(phi))
            if not len(places):
                break
            missing = np.ones(phi.shape, bool)
            missing[tuple(places.T)] = False
            away = np.asarray(ndimage.distance_transform_edt(missing)) - LEAST_MATTER
            phi = np.minimum(phi, np.maximum(away, self._phi)).astype(np.float32)
            fixed |= away < LEAST_MATTER
        return np.ascontiguousarray(phi)

    def _closest(self, phi: Voxels, free: Bool[np.ndarray, " rays"]) -> Int[np.ndarray, "n 3"]:
        """Return, for each freed ray, the node closest to the remaining matter among those that blocked it before."""
        which = torch.from_numpy(free)
        starts, lights = to_grid(self._before, self._starts[which]), lights_to_grid(self._before, self._lights[which])
        towards = lights[:, :3] - lights[:, 3:] * starts
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        best, places = np.full(len(starts), np.inf), np.zeros((len(starts), 3))
        for t in np.arange(0, np.linalg.norm(phi.shape), STEP_ALONG):
            at = starts + t * towards
            was, now = (ndimage.map_coordinates(f, at.T, order=1, cval=np.inf) for f in (self._phi, phi))
            nearer = (was < 0) & (now < best)
            best[nearer], places[nearer] = now[nearer], at[nearer]
        return np.unique(np.rint(places[np.isfinite(best)]).astype(int), axis=0)
