"""The shadow hull: carve space that lit, visible ground proves empty, and space in front of bare ground in the view."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from calibration.ground.shadow_reach import shadow_reach
from calibration.side_view import SideView, signed_distance
from capture.errors import ReconstructionError
from reconstruct.hull.hull_parts import (
    SURE,
    before_object,
    most_needed,
    pixel_rays,
    with_seen_pixels,
    with_support,
    without_floating,
    without_specks,
)
from reconstruct.labels.labels import Labels
from reconstruct.labels.uneven_ground import Relief, ground_relief, near_ground
from reconstruct.scene import Scene
from reconstruct.sdf import carve_kernels as carve
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.rays import PerThread, run, thread_count
from reconstruct.views import Scenes, each

MAP_CELLS = 640  # of the ground maps along their longer side
SEARCH_NODES = (64, 128)  # of the grids that look for the object's box: the finer where the coarser finds nothing
SEARCH_ROUNDS = 3
HEIGHTS = (0.7, 0.95)  # of the camera's above the ground: up to where an object is looked for; higher if it goes on
HIDDEN = 3.0  # cells: uneven ground this far behind what the camera sees is hidden; less is interpolation error
FEWEST_NODES = 8  # of a hull that is worth the name
BELOW = 3.0  # voxels of the grid under the ground, so that the surface crosses the ground plane instead of ending on it
MARGIN = 0.06  # of the box's size, kept free around the hull
LIGHTS_PER_NEED = 10  # a node stays if more than a tenth of the lights throw its shadow on ground seen dark
STANDING = 2.0  # nodes above the ground within which a part stands on it
REACH_STEP = 4  # px between the pixels whose ground is tested for shadows
MUCH_LARGER = 2.0  # than the shadows' reach: ground in sight for which the maps would be too coarse
SIDE_SIGMAS = 3.0  # of an outline seen from the side: nodes nearer to it stay

View = tuple[Scene, Labels]


@dataclass(frozen=True)
class GroundMaps:
    """Signed distance (world length, positive inside) to the edge of lit ground; the last map is the camera's."""

    fields: np.ndarray  # (photos + 1, gx, gy) float32
    dark: np.ndarray  # (photos + 1, gx, gy) uint8: bare ground seen in shadow
    heights: np.ndarray  # (gx, gy) float32 of uneven ground, world z; empty for a plane
    origin: np.ndarray  # (2,) world x, y of node (0, 0)
    cell: float
    lights: np.ndarray  # (photos + 1, 4) homogeneous


def ground_maps(scene: Scene, labels: Labels, region: np.ndarray, relief: Relief | None = None) -> GroundMaps:
    """Return the lit-ground maps over region, a (2, 2) box of world x, y.

    Pixels that show the object, lie outside the photo or are uncertain prove nothing; nor does ground of a relief that
    is hidden from the camera by other ground.
    """
    size = region[1] - region[0]
    cell = float(size.max() / MAP_CELLS)
    counts = np.maximum(np.ceil(size / cell).astype(int), 2)
    xs = region[0, 0] + cell * np.arange(counts[0])
    ys = region[0, 1] + cell * np.arange(counts[1])
    across = np.broadcast_arrays(xs[:, None], ys[None, :])
    heights = scene.ground_height if relief is None else relief.at(*across)
    world = np.stack(np.broadcast_arrays(*across, heights), -1)
    uv, depth = scene.posed_camera.project_with_depth(world)
    uv = uv.astype(np.float32)
    uv[depth <= 0] = -10

    def look(image: np.ndarray) -> np.ndarray:
        image = np.ascontiguousarray(image, np.float32)
        return cv2.remap(image, uv[..., 0], uv[..., 1], cv2.INTER_LINEAR, borderValue=0)

    bare = look(((labels.mask < 0.5) & (labels.mask_confidence > SURE)).numpy()) > 0.5
    if scene.ground_depth is not None:
        bare &= depth < look(scene.ground_depth.numpy()) + HIDDEN * cell
    fields = np.empty((len(scene.lights) + 1, *counts), np.float32)
    dark = np.zeros(fields.shape, np.uint8)
    for k, (visible, sure) in enumerate(zip(labels.visibility, labels.confidence, strict=True)):
        known = look((sure > SURE).numpy()) > 0.5
        lit = look(visible.numpy()) > 0.5
        fields[k] = signed_distance(bare & known & lit) * cell
        dark[k] = bare & known & ~lit
    fields[-1] = signed_distance(bare) * cell
    lights = np.concatenate([scene.lights.numpy(), [[*scene.eye.tolist(), 1.0]]]).astype(float)
    map_of_heights = np.zeros((0, 0), np.float32) if relief is None else np.asarray(heights, np.float32)
    return GroundMaps(fields, dark, map_of_heights, region[0].astype(float), cell, lights)


@dataclass(frozen=True)
class Hull:
    """The shadow hull, of which only the sign is valid."""

    grid: SdfGrid
    maps: GroundMaps  # that carved it


def carve_grid(
    views: Sequence[View], maps: GroundMaps, lower: np.ndarray, upper: np.ndarray, nodes: int, votes: int
) -> Hull:
    """Carve the hull on a grid over the box lower .. upper with `nodes` nodes along its longest side.

    Args:
        maps: of all lights, and of the cameras after them.
    """
    spacing = float((upper - lower).max() / (nodes - 1))
    shape = np.maximum(np.ceil((upper - lower) / spacing).astype(int) + 1, 4)
    by_lights, by_camera = np.empty(shape, np.float32), np.empty(shape, np.float32)
    needed, denied = np.empty((2, *shape), np.uint8)
    nothing = np.zeros((0, 0, 0), np.float32)
    for out, known, which, k in (
        (by_camera, nothing, slice(-len(views), None), 1),  # first: it proves most of the box empty
        (by_lights, by_camera, slice(0, -len(views)), votes),
    ):
        run(
            carve.carve,
            int(shape[0]),
            out,
            needed,
            denied,
            known,
            lower.astype(float),
            spacing,
            maps.lights[which],
            (maps.fields[which], maps.dark[which], maps.heights),
            maps.origin,
            maps.cell,
            views[0][0].ground_height,
            PerThread(np.empty(k) for _ in range(thread_count())),
        )
    values = np.maximum(np.maximum(by_lights, by_camera), -1e3 * spacing)
    for scene, labels in views:
        _carve_from_the_side(values, scene.side_views, lower, spacing)
        _carve_beside_picture(values, scene, labels, lower, spacing)
    inside = values < 0
    of_a_view = (len(maps.lights) - len(views)) // len(views)  # one view sees ground in a node's shadow, at least
    above = lower[2] + spacing * np.arange(shape[2]) - views[0][0].ground_height
    rays = [pixel_rays(scene, labels, lower, spacing, inside.shape) for scene, labels in views]
    needs, keep = most_needed(inside, needed, denied > 0, 1 + of_a_view // LIGHTS_PER_NEED, rays)
    for (scene, _), own in zip(views, rays, strict=True) if needs == 1 else ():
        keep &= ~before_object(inside, needed, scene, own, lower, spacing)
    for own in rays:
        keep = with_seen_pixels(keep, inside, needed, own)
    kept = without_specks(inside & with_support(keep))
    values[inside & ~without_floating(kept, above < STANDING * spacing, rays)] = 0.5 * spacing
    return Hull(SdfGrid(torch.from_numpy(values), torch.from_numpy(lower).float(), spacing), maps)


def _carve_from_the_side(values: np.ndarray, views: Sequence[SideView], lower: np.ndarray, spacing: float) -> None:
    """Raise the values of nodes that photos from the side surely show beside the object, by SIDE_SIGMAS or more."""
    for view in views:
        index = np.argwhere(values < 0)
        nodes = lower + spacing * index
        camera = view.camera
        away = np.linalg.norm(nodes - camera.centre, axis=1)
        beside = view.emptiness(nodes) - SIDE_SIGMAS * view.sigma() * away / camera.camera.fx
        values[tuple(index[beside > 0].T)] = beside[beside > 0]


def _carve_beside_picture(values: np.ndarray, scene: Scene, labels: Labels, lower: np.ndarray, spacing: float) -> None:
    """Raise the values of nodes outside a picture that shows the whole object: they are not part of it."""
    shown, index = (labels.mask > 0.5).numpy(), np.argwhere(values < 0)
    if shown[[0, -1]].any() or shown[:, [0, -1]].any() or not len(index):
        return
    uv, depth = scene.posed_camera.project_with_depth(lower + spacing * index)
    ends = [scene.camera.width - 0.5, scene.camera.height - 0.5]
    beside = ~((depth > 0) & ((uv > -0.5) & (uv < ends)).all(1))
    values[tuple(index[beside].T)] = spacing


def shadow_hull(scenes: Scene | Scenes, labels: Labels | tuple[Labels, ...], votes: int, nodes: int) -> SdfGrid:
    """Carve a closed surface that contains the object, see `carved`."""
    return carved(scenes, labels, votes, nodes).grid


def carved(scenes: Scene | Scenes, labels: Labels | tuple[Labels, ...], votes: int, nodes: int) -> Hull:
    """Carve a closed surface that contains the object.

    Every light of every view carves, and every camera's silhouette.

    Args:
        labels: of each scene.
        votes: how many lights must prove a node empty; 1 trusts every label, 2 tolerates one wrong label per node.
        nodes: along the longest side of the object's box.

    Raises:
        ReconstructionError: no object, no bare ground, or shadows that bound nothing.
    """
    views = tuple(zip(each(scenes), each(labels), strict=True))
    ground_height, relief = views[0][0].ground_height, ground_relief(views[0][0])
    maps, grounds = hull_maps(each(scenes), each(labels), relief)
    bases = [_base(own, ground) for (_, own), ground in zip(views, grounds, strict=True)]
    lower, upper = bases[0]
    for share in HEIGHTS:
        corners = [box_over(base, scene, share) for base, (scene, _) in zip(bases, views, strict=True)]
        box = np.max([low for low, _ in corners], axis=0), np.min([high for _, high in corners], axis=0)
        if not (box[0] < box[1]).all():
            raise ReconstructionError(
                f"the {len(views)} views show objects at different places of the ground: one object that lies still "
                "between the views was needed. Check the pose of each camera, or solve the views one by one."
            )
        lower, upper = _found_box(views, maps, box, votes)
        if upper[2] < box[1][2]:
            break
    spacing = float((upper - lower).max() / (nodes - 1))
    lowest = ground_height if relief is None else relief.lowest(lower, upper)
    lower[2] = lowest - BELOW * spacing
    return carve_grid(views, maps, lower, upper, nodes, votes)


def hull_maps(
    scenes: Scenes, labels: tuple[Labels, ...], relief: Relief | None = None
) -> tuple[GroundMaps, list[Float[np.ndarray, "height width 3"]]]:
    """Return the lit-ground maps about the object, and where each scene's pixel rays meet the ground, world.

    Raises:
        ReconstructionError: no object.
    """
    grounds, regions = [near_ground(scene) for scene in scenes], []
    for scene, own, ground in zip(scenes, labels, grounds, strict=True):
        shown = (own.mask > 0.5).numpy() & np.isfinite(ground[..., 0])
        if not shown.any():
            raise ReconstructionError(
                f"no object found{f' in {scene.view}' if scene.view else ''}: every pixel behaves like bare ground. "
                "Check that an object stands in view and that the flashlight casts its shadow on the ground in sight."
            )
        regions.append(_region(scene, ground, shown))
    region = np.array([np.min(regions, axis=0)[0], np.max(regions, axis=0)[1]])
    every = [ground_maps(scene, own, region, relief) for scene, own in zip(scenes, labels, strict=True)]
    return _together(every), grounds


def _together(maps: Sequence[GroundMaps]) -> GroundMaps:
    """Return maps over one region as one: of the lights of all, then of the cameras."""
    if len(maps) == 1:
        return maps[0]
    parts = {}
    for name in ("fields", "dark", "lights"):
        arrays = [getattr(one, name) for one in maps]
        parts[name] = np.concatenate([*(a[:-1] for a in arrays), *(a[-1:] for a in arrays)])
    return replace(maps[0], **parts)


def _base(labels: Labels, ground: Float[np.ndarray, "height width 3"]) -> Float[np.ndarray, "2 2"]:
    """Return least and largest world x and y of the ground behind the object's pixels, with a margin."""
    shown = (labels.mask > 0.5).numpy() & np.isfinite(ground[..., 0])
    foot = ground[shown][:, :2]
    base = np.array([foot.min(0), foot.max(0)])
    return base + MARGIN * (base[1] - base[0]) * [[-1], [1]]


def _region(
    scene: Scene, ground: Float[np.ndarray, "height width 3"], shown: Bool[np.ndarray, "height width"]
) -> Float[np.ndarray, "2 2"]:
    """Return least and largest world x and y of the ground in sight, or of what the object's shadows can reach.

    With a wall or a horizon in the picture its ground is much larger, and cells of the maps would be coarse.
    """
    few = ground[::REACH_STEP, ::REACH_STEP]
    finite = ground[np.isfinite(ground[..., 0])][:, :2]
    sight = np.array([finite.min(0), finite.max(0)])
    eye, lights = scene.eye.double().numpy(), scene.lights.double().numpy()
    reached = few[shadow_reach(eye, ground[shown], lights, few).any(0)]
    reached = np.concatenate([reached, ground[shown]])[:, :2]
    pad = MARGIN * np.ptp(reached, axis=0)
    region = np.array([reached.min(0) - pad, reached.max(0) + pad])
    region = np.array([np.maximum(region[0], sight[0]), np.minimum(region[1], sight[1])])
    return region if np.ptp(sight, axis=0).max() > MUCH_LARGER * np.ptp(region, axis=0).max() else sight


def box_over(
    base: Float[np.ndarray, "2 2"], scene: Scene, share: float
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Return corners, world, of a box around the pixels' view from the ground up to a share of the camera's height.

    Args:
        base: least and largest world x and y of the ground behind those pixels.
    """
    eye = scene.eye.numpy().astype(float)
    lifted = base + share * (eye[:2] - base)
    height = share * (eye[2] - scene.ground_height)
    lower = np.array([*np.minimum(base[0], lifted[0]), scene.ground_height])
    return lower, np.array([*np.maximum(base[1], lifted[1]), scene.ground_height + height])


def _found_box(
    views: Sequence[View], maps: GroundMaps, box: tuple[np.ndarray, np.ndarray], votes: int
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Find the corners of a box around the hull in a larger one, by coarse hulls in smaller and smaller boxes."""
    lower, upper = box
    for _ in range(SEARCH_ROUNDS):
        grid, inside = _coarse_hull(views, maps, (lower, upper), votes)
        low, high = lower + inside.min(0) * grid.spacing, lower + inside.max(0) * grid.spacing
        pad = np.maximum(MARGIN * (high - low), 1.5 * grid.spacing)
        lower, upper = np.maximum(lower, low - pad), np.minimum(upper, high + pad)
        lower[2] = views[0][0].ground_height
    return lower, upper


def _coarse_hull(
    views: Sequence[View], maps: GroundMaps, box: tuple[np.ndarray, np.ndarray], votes: int
) -> tuple[SdfGrid, Int[np.ndarray, "n 3"]]:
    """Return the hull on a coarse grid, and its nodes; on a finer grid if the hull is too small to be found."""
    for nodes in SEARCH_NODES:
        grid = carve_grid(views, maps, *box, nodes, votes).grid
        inside = np.argwhere(grid.values.numpy() < 0)
        if len(inside) >= FEWEST_NODES:
            return grid, inside
    raise ReconstructionError(
        "the shadows contradict each other: no point of space is dark under all lights that do not reach it. The light "
        "positions or the ground plane are probably wrong, or the object is too small in the picture; look at the "
        "light fit in report.html."
    )
