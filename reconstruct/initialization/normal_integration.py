"""Integration of normals to depth: shape from shading over long distances.

A ray constrains one point of the surface, and its effect spreads by a few voxels per iteration. A wide flat top
therefore stays the dome of the shadow hull, though every normal on it is known. Its depth is the normals' integral.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import csc_matrix, csr_matrix, diags
from scipy.sparse.linalg import cg, spsolve
from torch import Tensor

from reconstruct.labels.labels import Labels
from reconstruct.scene import Scene, ground_points
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.rays import find_surface

ROUNDS = 6  # of reweighting
BREAK = 2.0  # pixels between the tangent planes of neighbours that are on different surfaces, before and after
GUESSED = 2 * BREAK  # pixels of empty space before a depth that is a guess: its breaks are guesses, too
GUESSED_WIDTHS = (np.inf, 30.0, 9.0)  # of BREAK, for pairs with such a depth, in rounds before the others
TOUCHING = 10.0  # times heavier when in front of a bound, where nothing can be, than behind it
OUTSIDE = 1000.0  # of the usual tie, in front of a hull that shadows carved; and where the surface touches that hull
LIKE_HULL = 0.9  # cosine between the normals of hull and shading above which the surface may touch the hull
WRONG_BOUNDS = 0.05  # share of a hull's pixels that are behind the truth: edges, and beside thin matter that was lost
HELD_FROM, HELD_ROUNDS = 32.0, 8  # pixels below which an error counts squared, at first; halved in each round, to 1
GRAZING = 0.5  # cosine between ray and normal below which a normal says less of depth
OWN_NORMAL = 0.03  # confidence of the surface's own normal where shading says nothing
REACH = 2.0  # of the object's extent in the picture: how far normals carry a depth
OUTLINE, OUTLINE_REACH = 2, 10.0  # pixels about an outline, where shadow edges hold the surface; reach of the normals
MOST_PIXELS = 20_000  # solved for at once; more are skipped evenly: only long distances matter here
DIRECT_PIXELS = 2 * MOST_PIXELS  # factorised in half a second
CG_STEPS, CG_RESIDUAL = 150, 1e-9  # a wave of a hundred pixels settles in as many steps
FEWEST_PIXELS = 9
DUST = 1e-6  # of a tie, or nothing would hold what no other pixel does
BIAS = np.radians(1.5)  # of normals: common error of a whole side by highlights and interreflection
LIT_BIAS = np.radians(4.0)  # the same of normals that are read from which lights reach a pixel
SEEN = 0.3  # of the pixels about a node's must show the object for it to move
ABOUT = 4.0  # voxels before and behind the surface in which nodes move
MOST_OF_DEPTH = 0.8  # of the matter along a ray may be taken from its front

Integrate = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]  # as integrate_normals


def follow_normals(
    grid: SdfGrid,
    scene: Scene,
    points: Float[Tensor, "height width 3"],
    own: Float[Tensor, "height width 3"],
    labels: Labels,
    integrate: Integrate,
    bias: float = BIAS,
) -> SdfGrid:
    """Move the grid's visible side to the integral of the labels' normals.

    Args:
        points: world, where each pixel's ray meets the grid's surface or the ground.
        own: world, the surface's normals there; 0 on the ground.
        integrate: what is known of the surface so far: `integrate_normals`, or that it is a shadow hull, which the
            object is never in front of.
        bias: rad, of the labels' normals: their integral does not move what it explains.

    Returns:
        The grid. Where it was moved, only its sign is right: it is no longer a distance.
    """
    some = some_pixels(scene, points, own, labels)
    if some is None:
        return grid
    before, rays, seen = some.before, some.rays, np.isfinite(some.before)
    given = (rays, before, some.own, some.normals, some.trust)
    after = integrate(*given)
    after = before + _beyond_bias(after - before, before, rays, bias)
    part = (slice(None, None, some.step), slice(None, None, some.step))
    shown = torch.from_numpy(seen)
    to_ground = (ground_points(scene) - points).norm(dim=-1)[part][shown]
    matter = _matter_behind(grid, points[part][shown], scene.directions[part][shown], to_ground)
    after[seen] = np.minimum(after[seen], before[seen] + MOST_OF_DEPTH * matter)
    return _with_front(grid, scene, before, after, some.step)


def normals_bias(scene: Scene) -> float:
    """Return the common error of a side's normals, rad: from shading, or from which lights reach a pixel."""
    return BIAS if scene.rgb is not None else LIT_BIAS


@dataclass(frozen=True)
class SomePixels:
    """Every step-th pixel along each axis of a picture, and what is known there."""

    step: int
    rays: Float[np.ndarray, "height width 3"]  # unit, world
    before: Float[np.ndarray, "height width"]  # world length of the ray to the surface so far; nan beside the object
    own: Float[np.ndarray, "height width 3"]  # world, that surface's normals
    normals: Float[np.ndarray, "height width 3"]  # world, of shading
    trust: Float[np.ndarray, "height width"]  # in them, 0 to 1


def some_pixels(
    scene: Scene, points: Float[Tensor, "height width 3"], own: Float[Tensor, "height width 3"], labels: Labels
) -> SomePixels | None:
    """Return as many evenly spaced pixels as are integrated at once; None without an object or normals of shading."""
    on_object = (labels.mask > 0.5) & (own != 0).any(-1)
    step = 1 + int((float(on_object.sum()) / MOST_PIXELS) ** 0.5)
    part = (slice(None, None, step), slice(None, None, step))
    seen = on_object[part].numpy()
    if seen.sum() < FEWEST_PIXELS or not labels.normal_confidence.any():
        return None
    t = (points - scene.eye).norm(dim=-1)[part].numpy().astype(np.float64)
    read = (labels.normals, labels.normal_confidence)
    normals, trust = (image[part].numpy().astype(np.float64) for image in read)
    return SomePixels(
        step, scene.directions[part].numpy(), np.where(seen, t, np.nan), own[part].numpy(), normals, trust
    )


def integrate_normals(
    rays: Float[np.ndarray, "height width 3"],
    before: Float[np.ndarray, "height width"],
    own: Float[np.ndarray, "height width 3"],
    normals: Float[np.ndarray, "height width 3"],
    trust: Float[np.ndarray, "height width"],
    bounds: bool = False,
    front: Float[np.ndarray, "height width"] | None = None,
) -> Float[np.ndarray, "height width"]:
    """Solve for ray lengths t from the eye, so that the surface t * ray has the given normals and stays near `before`.

    Least squares over neighbouring pixels, see `_chords`. Pairs across a depth break of the present surface have no
    weight; Geman-McClure weights separate pairs where shading shows a break. Each t is tied to its old value, loosely
    inside the object's outline.

    Args:
        before: t of the present surface; nan where there is none.
        own: its normals, which are used where the given ones are not trusted.
        bounds: nothing is in front of the present surface: the tie is stronger in front than behind. Otherwise it is
            stronger at the outline, which shadow edges determine.
        front: t before which nothing can be, where that is not the present surface. A depth GUESSED pixels or more
            behind it is a guess, and breaks beside it are found anew: pairs begin without robust weights, which then
            narrow [graduated non-convexity: Blake and Zisserman, Visual Reconstruction, 1987].
    """
    where = np.isfinite(before)
    t0 = before[where]
    chords = _chords(rays, before, own, normals, trust)
    first = t0 if front is None else np.minimum(front[where], t0)
    guess = (t0 - first) / chords.size > GUESSED
    guessed = guess[chords.first] | guess[chords.second]
    broken = np.abs(chords.apart) > BREAK
    apart = np.where(broken & guessed, 0, chords.apart)
    weight = np.where(broken & ~guessed, 0, chords.weight)
    tie = _tie(where, 0 if bounds else OUTLINE)[where] / chords.size**2
    t = t0
    for wider in (*(GUESSED_WIDTHS if guess.any() else ()), *(1.0 for _ in range(ROUNDS))):
        hold = tie * np.where(t < first, TOUCHING if bounds else 1.0, 1.0)
        t = _reweighted(chords.slope, apart, weight, BREAK * np.where(guessed, wider, 1.0), hold, t0, t)
    return _spread(t, where)


def integrate_within(
    rays: Float[np.ndarray, "height width 3"],
    hull: Float[np.ndarray, "height width"],
    own: Float[np.ndarray, "height width 3"],
    normals: Float[np.ndarray, "height width 3"],
    trust: Float[np.ndarray, "height width"],
) -> Float[np.ndarray, "height width"]:
    """Solve for ray lengths t, so that the surface t * ray has the given normals and lies in a shadow hull.

    Two surfaces that touch have one normal there. So the hull is the surface, to a pixel, where shading tells the
    hull's own normal; elsewhere it lies in front of the surface by no one knows what: over a bowl it is a lid. Held to
    the lid as to an outline, the bottom of a bowl came half way up. Since breaks of the hull are not the surface's, as
    at the bowl's front rim, pairs begin without robust weights, which then narrow, as in `integrate_normals`.

    Args:
        hull: t of the hull; nan where there is none.
        own: its normals, which are used where the given ones are not trusted.
    """
    where = np.isfinite(hull)
    t0 = t = hull[where]
    chords = _chords(rays, hull, own, normals, trust)
    cosine = (own * normals).sum(-1)[where]
    touching = trust[where] * np.clip((cosine - LIKE_HULL) / (1 - LIKE_HULL), DUST, 1)
    tie = OUTSIDE * _tie(where, 0)[where] / chords.size**2
    for wider in (*GUESSED_WIDTHS, *(1.0 for _ in range(ROUNDS))):
        width = wider * BREAK
        hold = tie * np.where(t < t0, 1, touching * _geman_mcclure((t - t0) / (width * chords.size)) + DUST)
        t = _reweighted(chords.slope, np.zeros_like(chords.apart), chords.weight, width, hold, t0, t)
    return _spread(t, where)


def integrate_behind(
    rays: Float[np.ndarray, "height width 3"],
    hull: Float[np.ndarray, "height width"],
    own: Float[np.ndarray, "height width 3"],
    normals: Float[np.ndarray, "height width 3"],
    trust: Float[np.ndarray, "height width"],
) -> Float[np.ndarray, "height width"]:
    """Solve for ray lengths t, so that the surface t * ray has the given normals and lies behind a shadow hull.

    As `integrate_normals`, but with what a hull says of depth: it is an outer bound, known to a pixel, and wrong at a
    few pixels, where thin matter was lost. Over a flat top it is a dome, which touches the top at its rim alone. The
    least squares of a tie lie at the dome's mean height; absolute errors that weigh more in front than behind lie at a
    quantile of the bounds [Koenker and Bassett, Regression Quantiles, Econometrica 46, 1978], which neither the dome's
    height nor a few wrong bounds move. They are solved by reweighting, from errors that are squared up to HELD_FROM.
    A chord along a grazing ray is 1 / cosine longer, and so is what an error of its normal makes in depth: it weighs
    the squared cosine, or it would draw what stands above to what lies below.

    Args:
        hull: t of the hull; nan where there is none.
        own: its normals, which are used where the given ones are not trusted.
    """
    where = np.isfinite(hull)
    chords = _chords(rays, hull, own, normals, trust)
    facing = np.minimum(chords.facing[chords.first], chords.facing[chords.second])
    weight = np.where(np.abs(chords.apart) > BREAK, 0, chords.weight * np.minimum(facing / GRAZING, 1) ** 2)
    bound = cv2.erode(np.where(where, hull, np.inf), np.ones((3, 3)))[where]
    t, pull = hull[where], 1 / (REACH * _extent(where) * chords.size)
    for width in HELD_FROM / 2.0 ** np.arange(HELD_ROUNDS):
        away = np.maximum(np.abs(t - bound), max(width, 1.0) * chords.size)
        hold = pull * np.where(t < bound, 1.0, WRONG_BOUNDS) / away
        t = _reweighted(chords.slope, chords.apart, weight, BREAK, hold, bound, t)
    return _spread(t, where)


@dataclass(frozen=True)
class _Chords:
    """The equations slope @ t = apart, one for each pair of neighbours."""

    first: Int[np.ndarray, " pairs"]  # pixels of a pair, of those that are set
    second: Int[np.ndarray, " pairs"]
    slope: csr_matrix
    apart: Float[np.ndarray, " pairs"]  # pixels between the tangent planes of the present surface
    weight: Float[np.ndarray, " pairs"]
    size: Float[np.ndarray, " n"]  # of a pixel, world length
    facing: Float[np.ndarray, " n"]  # cosine between a pixel's ray and normal


def _chords(
    rays: Float[np.ndarray, "height width 3"],
    before: Float[np.ndarray, "height width"],
    own: Float[np.ndarray, "height width 3"],
    normals: Float[np.ndarray, "height width 3"],
    trust: Float[np.ndarray, "height width"],
) -> _Chords:
    """Return (n_p + n_q) / 2 . (t_q d_q - t_p d_p) of neighbouring pixels p, q, in pixels of the picture.

    The chord between two points of a curve is perpendicular to the mean of its normals there. The residual of the
    present surface's own normals, at edges, is to be subtracted, so that a surface that already has the given normals
    does not move.
    """
    where = np.isfinite(before)
    d, t0, sure = rays[where].astype(np.float64), before[where], trust[where]
    n = np.where((sure > OWN_NORMAL)[:, None], normals[where], own[where]).astype(np.float64)
    p, q = _neighbours(where)
    size = np.median(np.linalg.norm(d[p] - d[q], axis=1)) * t0
    worth = np.maximum(sure, OWN_NORMAL)
    weight = (worth[p] + worth[q]) / 2
    chord = (worth[p, None] * n[p] + worth[q, None] * n[q]) / (2 * weight * size[p])[:, None]
    own_chord = own[where][p] + own[where][q]
    apart = (own_chord * (t0[q, None] * d[q] - t0[p, None] * d[p])).sum(1) / (2 * size[p])
    rows, ends = np.arange(len(p)), np.stack([q, p], -1).ravel()
    values = np.stack([(chord * d[q]).sum(1), -(chord * d[p]).sum(1)], -1)
    slope = csr_matrix((values.ravel(), (np.repeat(rows, 2), ends)), shape=(len(p), len(t0)))
    return _Chords(p, q, slope, apart, weight, size, np.abs((n * d).sum(1)))


def _reweighted(
    slope: csr_matrix,
    apart: Float[np.ndarray, " pairs"],
    weight: Float[np.ndarray, " pairs"],
    width: float | Float[np.ndarray, " pairs"],
    hold: Float[np.ndarray, " n"],
    held: Float[np.ndarray, " n"],
    t: Float[np.ndarray, " n"],
) -> Float[np.ndarray, " n"]:
    """Return t after a round of least squares with Geman-McClure weights of a width, and ties of `hold` to `held`."""
    robust = weight * _geman_mcclure((slope @ t - apart) / width)
    matrix = slope.T @ diags(robust) @ slope + diags(hold)
    return _solved(csc_matrix(matrix), slope.T @ (robust * apart) + hold * held, t)


def _geman_mcclure(error: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return the weights of errors in units of their width."""
    return 1 / (1 + error**2) ** 2


def _spread(t: Float[np.ndarray, " n"], where: Bool[np.ndarray, "height width"]) -> Float[np.ndarray, "height width"]:
    """Return an image of t, nan elsewhere."""
    result = np.full(where.shape, np.nan)
    result[where] = t
    return result


def _solved(
    matrix: csc_matrix, right: Float[np.ndarray, " n"], guess: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Solve matrix @ t = right: exactly, or above DIRECT_PIXELS by conjugate gradients.

    Conjugate gradients start from a guess that is already right over long distances.
    """
    if len(right) <= DIRECT_PIXELS:
        return np.asarray(spsolve(matrix, right))
    scale = diags(1 / matrix.diagonal())
    return cg(
        matrix, right, guess, rtol=0.0, atol=CG_RESIDUAL * float(np.linalg.norm(right)), maxiter=CG_STEPS, M=scale
    )[0]


def _beyond_bias(
    move: Float[np.ndarray, "height width"],
    before: Float[np.ndarray, "height width"],
    rays: Float[np.ndarray, "height width 3"],
    bias: float,
) -> Float[np.ndarray, "height width"]:
    """Subtract from a move the part that a common error bias of all normals makes between the outline and a pixel."""
    pixel = np.linalg.norm(np.diff(rays, axis=1), axis=-1)
    within = cv2.distanceTransform(np.isfinite(before).astype(np.uint8), cv2.DIST_L2, 5)
    doubt = np.tan(bias) * within * float(np.median(pixel)) * before
    return np.sign(move) * np.maximum(np.abs(move) - doubt, 0)


def _tie(where: Bool[np.ndarray, "height width"], outline: int) -> Float[np.ndarray, "height width"]:
    """Return the weight of a pixel's tie to its old depth, per squared pixel."""
    inner = cv2.erode(where.astype(np.uint8), np.ones((2 * outline + 1, 2 * outline + 1)), borderValue=0)
    return np.where(inner > 0, 1 / (REACH * _extent(where)) ** 2, 1 / OUTLINE_REACH**2)


def _extent(where: Bool[np.ndarray, "height width"]) -> int:
    """Return the longer side of what is set, pixels."""
    return max(int(np.ptp(axis)) for axis in np.nonzero(where)) + 1


def _neighbours(where: Bool[np.ndarray, "height width"]) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Return pairs of neighbouring pixels, as indices into the set pixels."""
    number = np.full(where.shape, -1)
    number[where] = np.arange(where.sum())
    first, second = [], []
    for a, b in ((number[:, :-1], number[:, 1:]), (number[:-1], number[1:])):
        both = (a >= 0) & (b >= 0)
        first.append(a[both])
        second.append(b[both])
    return np.concatenate(first), np.concatenate(second)


def _matter_behind(
    grid: SdfGrid, points: Float[Tensor, "n 3"], rays: Float[Tensor, "n 3"], to_ground: Float[Tensor, " n"]
) -> Float[np.ndarray, " n"]:
    """Return the world length of matter along rays behind points on the surface: to its end, or to the ground."""
    hollow = SdfGrid(-grid.values, grid.origin, grid.spacing)
    inside = points + 0.5 * grid.spacing * rays
    ends = find_surface(hollow, inside.contiguous(), rays.contiguous())
    return torch.where(ends.isfinite(), ends, to_ground).nan_to_num(nan=0.0).double().numpy()


def _with_front(
    grid: SdfGrid,
    scene: Scene,
    before: Float[np.ndarray, "height width"],
    after: Float[np.ndarray, "height width"],
    step: int,
) -> SdfGrid:
    """Move the visible side along the camera's rays: a node takes the value at the surface's old position.

    The far side does not move: where the front moves back, only inside nodes change, and where it comes forward, only
    outside nodes.
    """
    there = np.isfinite(before)
    share = cv2.blur(there.astype(np.float32), (3, 3))
    maps = [np.where(there, m, 0).astype(np.float32) for m in (before, after - before)]
    old, shift = (np.where(there, m, cv2.blur(m, (3, 3)) / share.clip(1e-6)) for m in maps)
    eye = scene.eye.numpy().astype(np.float64)
    values = grid.values.numpy().copy()
    across = np.indices(values.shape[1:])
    for i, slab in enumerate(values):
        nodes = grid.origin.numpy() + grid.spacing * np.stack([np.full(slab.shape, i), *across], -1)
        uv = (scene.posed_camera.project(nodes) / step).astype(np.float32)
        front, by, seen = (cv2.remap(m, uv[..., 0], uv[..., 1], cv2.INTER_LINEAR) for m in (old, shift, share))
        t = np.linalg.norm(nodes - eye, axis=-1)
        change = (seen > SEEN) & (np.abs(t - front - by / 2) < np.abs(by) / 2 + ABOUT * grid.spacing)
        if change.any():
            back = nodes[change] - (by[change] / t[change])[:, None] * (nodes[change] - eye)
            moved = grid.sdf(torch.from_numpy(back).float()).numpy()
            slab[change] = np.where(by[change] > 0, np.maximum(slab[change], moved), np.minimum(slab[change], moved))
    return SdfGrid(torch.from_numpy(values), grid.origin, grid.spacing)
