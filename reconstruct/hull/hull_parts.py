"""Which nodes of a carved grid belong to the object: what no light needs, floats or only hides it does not."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.ndimage import distance_transform_edt, label, maximum_filter, minimum_filter

from reconstruct.labels.labels import Labels
from reconstruct.scene import Scene

SPECK = 0.01  # of the largest part
ABOUT = 2.0  # nodes: a pixel whose ray passes this close to a kept node has met it
MISSED = 0.01  # of a camera's object pixels: as many may lose what they met with a floating part
MET = 0.5  # of a camera's object pixels: as many meet what enough lights need, or fewer lights are enough
NOT_DENIED = 2  # lights that need a node which none denies
NEAR = 8.0  # nodes from the kept ones within which a missed pixel is given a node
RAY_STEP = 0.6  # nodes: no node on a ray is stepped over
RAYS_AT_ONCE = 2000  # 10 MB of indices
SURE = 0.5  # confidence from which a label may carve


@dataclass(frozen=True)
class PixelRays:
    """The nodes that the rays of a camera's object pixels pass, in the order of their distance."""

    nodes: Int[np.ndarray, "steps rays"]  # flat
    valid: Bool[np.ndarray, "steps rays"]  # within the grid
    t: Float[np.ndarray, " steps"]  # nodes from the eye
    pixels: Int[np.ndarray, " rays"]  # flat

    def meet(self, keep: Bool[np.ndarray, "x y z"]) -> Bool[np.ndarray, " rays"]:
        """Return whether each ray passes near a kept node."""
        return self.pass_within(_away_from(keep))

    def pass_within(self, away: Float[np.ndarray, "x y z"]) -> Bool[np.ndarray, " rays"]:
        """Return whether each ray passes a node that is so little away, nodes, from kept ones."""
        return np.any((away < ABOUT).reshape(-1)[self.nodes] & self.valid, axis=0)


def _away_from(keep: Bool[np.ndarray, "x y z"]) -> Float[np.ndarray, "x y z"]:
    """Return each node's distance to the nearest kept one, nodes; inf if none is kept."""
    return np.asarray(distance_transform_edt(~keep), dtype=np.float64) if keep.any() else np.full(keep.shape, np.inf)


def with_support(keep: np.ndarray) -> np.ndarray:
    """Return the nodes that are kept or lie below a kept one.

    Behind the object the camera sees no ground, so nothing there is ever proven empty, but no shadow needs it either.
    No visible shadow needs the inside of a solid object's foot; it is kept because kept nodes lie above it.
    """
    return np.maximum.accumulate(keep[:, :, ::-1], axis=2)[:, :, ::-1]


def without_specks(keep: np.ndarray, least: float = SPECK) -> np.ndarray:
    """Remove parts far smaller than the largest: single wrong pixels, which would also enlarge the object's box.

    Args:
        least: of the largest part's size: smaller ones are removed.
    """
    parts = np.empty(keep.shape, np.int32)
    label(keep, np.ones((3, 3, 3)), output=parts)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    kept = np.flatnonzero(sizes >= least * sizes.max(initial=1))
    return np.isin(parts, kept)


def before_object(
    inside: Bool[np.ndarray, "x y z"],
    needed: UInt8[np.ndarray, "x y z"],
    scene: Scene,
    rays: PixelRays,
    lower: np.ndarray,
    spacing: float,
) -> Bool[np.ndarray, "x y z"]:
    """Return the nodes that hide, from an object pixel, the first of those that most lights need on its ray.

    Few lights prove little of the space between camera and object empty. A node of the object throws a shadow on
    ground seen dark under nearly every light whose shadow of it is in sight. With five to ten lights, the most needed
    nodes of every object pixel's ray lay at the object; nine in ten nodes before it were needed by one light or none.
    """
    before = np.zeros(inside.shape, np.bool_)
    if not inside.any():
        return before
    count = np.where(rays.valid, (needed * inside).reshape(-1)[rays.nodes], 0)
    first = count.argmax(0)
    begins = np.full(scene.directions.shape[:2], -np.inf, np.float32)
    begins.reshape(-1)[rays.pixels] = np.where(count.any(0), rays.t[first], -np.inf)
    begins = np.asarray(minimum_filter(begins, 3))
    index = np.argwhere(inside)
    nodes = lower + spacing * index
    uv, depth = scene.posed_camera.project_with_depth(nodes)
    column, row = np.rint(np.where(depth[:, None] > 0, uv, -1)).astype(int).T
    height, width = scene.directions.shape[:2]
    seen = (depth > 0) & (row >= 0) & (row < height) & (column >= 0) & (column < width)
    t = np.linalg.norm(nodes[seen] - scene.eye.numpy(), axis=1) / spacing
    before[tuple(index[seen].T)] = t < begins[row[seen], column[seen]] - ABOUT
    return before


def without_floating(
    keep: Bool[np.ndarray, "x y z"], near_ground: Bool[np.ndarray, " z"], rays: Sequence[PixelRays]
) -> Bool[np.ndarray, "x y z"]:
    """Remove parts that float although every camera sees the object all the same without them.

    The hull contains the object, and an object stands on the ground. Between camera and object, few lights leave space
    that nothing proves empty: it hides the object and enlarges its box. A part stays if an object pixel needs it.

    Args:
        near_ground: layers that are near enough to the ground to stand on it.
    """
    parts = np.empty(keep.shape, np.int32)
    count = label(keep, np.ones((3, 3, 3)), output=parts)
    standing = np.unique(parts[:, :, near_ground])
    floating = np.setdiff1d(np.arange(1, int(count) + 1), standing)
    if not len(floating) or not standing.any():
        return keep
    rest = keep & ~np.isin(parts, floating)
    for part in floating:
        whole = rest | (parts == part)
        if any((own.meet(whole) & ~own.meet(rest)).mean() > MISSED for own in rays):
            rest = whole
    return rest


def pixel_rays(scene: Scene, labels: Labels, lower: np.ndarray, spacing: float, shape: tuple[int, ...]) -> PixelRays:
    """Return the rays of the pixels that surely show the object."""
    shown = (labels.mask > 0.5) & (labels.mask_confidence > SURE)
    directions = scene.directions[shown].numpy()
    start = (scene.eye.numpy() - lower) / spacing
    last = np.array(shape) - 1
    reach = np.linalg.norm(last) / 2
    middle = np.linalg.norm(start - last / 2)
    t = np.arange(middle - reach, middle + reach, RAY_STEP, dtype=np.float32)
    nodes, valid = np.empty((len(t), len(directions)), np.int32), np.empty((len(t), len(directions)), np.bool_)
    for part in np.array_split(np.arange(len(directions)), max(1, len(directions) // RAYS_AT_ONCE)):
        at = np.rint(start + t[:, None, None] * directions[part]).astype(np.int32)
        valid[:, part] = np.all((at >= 0) & (at <= last), axis=-1)
        at = np.clip(at, 0, last)
        nodes[:, part] = np.ravel_multi_index((at[..., 0], at[..., 1], at[..., 2]), shape)
    return PixelRays(nodes, valid, t, np.flatnonzero(shown.numpy()))


def most_needed(
    inside: Bool[np.ndarray, "x y z"],
    needed: UInt8[np.ndarray, "x y z"],
    denied: Bool[np.ndarray, "x y z"],
    needs: int,
    rays: Sequence[PixelRays],
) -> tuple[int, Bool[np.ndarray, "x y z"]]:
    """Return how many lights need each kept node, and these nodes; fewer where object pixels would meet hardly any.

    Of thin rods under ten lights, no node of a coarse grid was needed by two of them, and nothing was left. High parts
    throw the shadows of most lights out of the picture: of a head under twenty lights, a quarter of the nodes was
    needed by two lights only, but denied by none.

    Args:
        denied: one light falls on ground in the node's shadow.
        needs: lights, at most; NOT_DENIED are enough where a node is not denied.
    """
    while True:
        keep = inside & ((needed >= needs) | ((needed >= NOT_DENIED) & ~denied))
        if needs == 1 or all(own.meet(keep).sum() >= MET * len(own.pixels) for own in rays):
            return needs, keep
        needs -= 1


def with_seen_pixels(keep: np.ndarray, inside: np.ndarray, needed: np.ndarray, rays: PixelRays) -> np.ndarray:
    """Restore a needed, nearby node for every object pixel whose ray meets no kept node."""
    away = _away_from(keep)
    worth = np.where(inside & (away < NEAR), needed - away, -np.inf)
    unmet = ~rays.pass_within(away)
    flat, valid = rays.nodes[:, unmet], rays.valid[:, unmet]
    score = np.where(valid, worth.reshape(-1)[flat], -np.inf)
    best = np.take_along_axis(flat, score.argmax(0)[None], 0)[0]
    seeds = np.zeros(keep.shape, np.uint8)
    seeds.reshape(-1)[best[score.max(0, initial=-np.inf) > -np.inf]] = 1
    return keep | (inside & (maximum_filter(seeds, 3) > 0))
