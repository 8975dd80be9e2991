"""Mean curvature flow of the hidden surface between two bounds: it removes unseen matter that no ray needs.

Behind and below an object there is space that the camera does not see, and whose shadow falls outside its view or into
the shadow of what it does see. No ray needs matter there, and no ray proves it empty. Of all surfaces that agree with
the rays, this finds a tight one.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from torch import Tensor

from reconstruct.labels.supervision import DARK_ENOUGH, SURE_ENOUGH, Supervision
from reconstruct.scene import Scene
from reconstruct.sdf import kernels
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.level_set import as_distance
from reconstruct.sdf.rays import first_hits, lights_to_grid, to_grid, visibility
from reconstruct.views import Scenes, each

STABLE_STEP = 1 / 6  # voxels^2: explicit steps of the flow are stable up to here
STEPS = 200  # at most: bulges up to a radius of 2 sqrt(STEPS * STABLE_STEP) = 12 voxels vanish, larger ones sink
CHECK_EVERY = 10  # steps after which phi becomes a distance again
AT_REST = 0.05  # voxels of movement in so many steps: the flow ends
SEEN_SHELL = 1  # voxels about what the camera sees: known without shadows
EXPLAINED = 1.0  # voxels beside seen matter at which a ray may pass and needs no other: a coarse edge is off by as much
NEAR = 3.0  # voxels about the surface in which it moves
SHARPNESS = 8.0  # NeuS s per voxel: a ray that passes a tenth of a voxel inside counts as blocked
STEP_ALONG = 0.5  # voxels, of the search for the matter that blocks a ray; rays that start closer together are one
TOUCHED = 0.5  # voxels: a ray that passes the matter farther away is blocked by none
AIR = 0.5  # voxels: on the walls of the box, where matter would stick, the surface closes half a voxel inside
LEAST_MATTER = 1.0  # voxels: radius of the matter that is kept for a ray
STANDING = 3  # nodes above the ground: what is needed there stands on it

Voxels = Float[np.ndarray, "nx ny nz"]
Nodes = Bool[np.ndarray, "nx ny nz"]
Rays = tuple[Float[Tensor, "n 3"], Float[Tensor, "n 4"]]


def without_unsupported_matter(
    surface: SdfGrid, scenes: Scene | Scenes, rays: Supervision | tuple[Supervision, ...]
) -> SdfGrid:
    """Remove unseen matter that no ray needs; dark shadow rays that were blocked stay blocked.

    Mean curvature flow, d phi / dt = Laplacian phi, between two bounds. phi does not fall: lit rays bound the matter
    from outside, and nothing is added. phi does not rise where a dark ray needs matter: each that passes no matter
    that a camera sees keeps what lies about the deepest point of its way. So the hidden surface spans the places that
    shadows hold as a soap film does. What a camera sees stands still. On the ground the surface stands upright.

    A dark ray says that matter is somewhere on its way, not where. Rays that pass the edge of a table's top below a
    light at 15 degrees run along a cone under the top: the top explains them, and they hold no cone.

    Args:
        scenes: of all cameras, with the lights that the surface was solved under; world frame.
        rays: the supervision that the surface was solved from, of each scene.

    Returns:
        The surface on the same grid, world frame and length.
    """
    scenes, rays = each(scenes), each(rays)
    walls = _walls(surface.values.shape)
    phi = surface.in_voxels()
    phi[walls] = np.maximum(phi[walls], AIR)
    phi = as_distance(phi)
    before, low = phi.copy(), _first_above(surface, scenes[0].ground_height)
    seen = [_seen(surface, scene, own) for scene, own in zip(scenes, rays, strict=True)]
    shell = np.logical_or.reduce([near for _, near in seen])
    views = zip(scenes, rays, seen, strict=True)
    dark = [_dark_rays(scene, own, at, surface.spacing) for scene, own, (at, _) in views]
    most = _kept(before, surface, shell & (before < 0), dark, low)
    fixed, last = shell | walls, before
    for step in range(STEPS):
        _tighten(phi, fixed, low)
        np.clip(phi, before, most, out=phi)
        if (step + 1) % CHECK_EVERY == 0:
            phi = as_distance(phi)
            if np.abs(phi - last)[np.abs(last) < 1].max(initial=0) < AT_REST:
                break
            last = phi.copy()
    return surface.with_voxels(phi)


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
    nodes = np.rint((points[on_object] - surface.origin.double().numpy()) / surface.spacing).astype(int)
    nodes = nodes[((nodes >= 0) & (nodes < surface.values.shape)).all(1)]
    shell = np.zeros(tuple(surface.values.shape), bool)
    shell[tuple(nodes.T)] = True
    return points, ndimage.binary_dilation(shell, iterations=SEEN_SHELL)


def _dark_rays(scene: Scene, rays: Supervision, points: Float[np.ndarray, "pixels 3"], spacing: float) -> Rays:
    """Return the start and the light, world, of a view's surely dark shadow rays from points that its pixels see.

    Of rays to one light that start within STEP_ALONG voxels of each other, one stays.
    """
    dark = (rays.label < DARK_ENOUGH) & (rays.confidence > SURE_ENOUGH) & (rays.role != kernels.EDGE)
    photo, pixel = np.nonzero(dark & np.isfinite(points[:, 0]))
    places = np.rint(points[pixel] / (STEP_ALONG * spacing)).astype(np.int64)
    _, first = np.unique(np.c_[photo, places], axis=0, return_index=True)
    return torch.from_numpy(points[pixel[first]]).float(), scene.lights[torch.from_numpy(photo[first])]


def _kept(phi: Voxels, like: SdfGrid, seen: Nodes, dark: list[tuple[Tensor, Tensor]], low: int) -> Voxels:
    """Return the largest phi that leaves the matter which dark rays need: NEAR or more where none needs any.

    Args:
        seen: nodes of matter that a camera sees: rays that pass them need no other.
        low: the first layer of nodes above the ground.
    """
    starts, lights = (torch.cat(parts).contiguous() for parts in zip(*dark, strict=True))
    alone = like.with_voxels((_away(seen) - EXPLAINED).astype(np.float32))
    needy = visibility(alone, starts, lights, SHARPNESS / like.spacing) > DARK_ENOUGH
    needed = np.zeros(phi.shape, bool)
    needed[tuple(_deepest(phi, like, (starts[needy], lights[needy])).T)] = True
    foot = needed[:, :, low : low + STANDING]
    foot[...] = np.flip(np.maximum.accumulate(np.flip(foot, 2), 2), 2)
    return np.maximum(_away(needed) - LEAST_MATTER, phi).astype(np.float32)


def _away(nodes: Nodes) -> Voxels:
    """Return the distance to the nearest of some nodes, voxels; everywhere large if there are none."""
    if not nodes.any():
        return np.full(nodes.shape, float(sum(nodes.shape)))
    return np.asarray(ndimage.distance_transform_edt(~nodes))


def _deepest(phi: Voxels, like: SdfGrid, rays: Rays) -> Int[np.ndarray, "nodes 3"]:
    """Return the nodes at the deepest points of rays that touch matter."""
    starts, lights = to_grid(like, rays[0]), lights_to_grid(like, rays[1])
    towards = lights[:, :3] - lights[:, 3:] * starts
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    least, places = np.full(len(starts), TOUCHED), np.full((len(starts), 3), np.nan)
    for t in np.arange(0, np.linalg.norm(phi.shape), STEP_ALONG):
        at = starts + t * towards
        now = ndimage.map_coordinates(phi, at.T, order=1, cval=np.inf)
        deeper = now < least
        least[deeper], places[deeper] = now[deeper], at[deeper]
    return np.unique(np.rint(places[np.isfinite(places[:, 0])]).astype(int), axis=0)
