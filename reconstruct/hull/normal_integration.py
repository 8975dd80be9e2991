"""Integration of normals to depth: shape from shading over long distances.

A ray constrains one point of the surface, and its effect spreads by a few voxels per iteration. A wide flat top
therefore stays the dome of the shadow hull, though every normal on it is known. Its depth is the normals' integral.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csc_matrix, csr_matrix, diags
from scipy.sparse.linalg import cg, spsolve

from capture.checks.robust import geman_mcclure
from reconstruct.labels.photometric_stereo import NORMAL_SIGMA

ROUNDS = 6  # of reweighting
BREAK = 2.0  # pixels between the tangent planes of neighbours that are on different surfaces, before and after
WIDE_FIRST = (np.inf, *np.geomspace(30.0, 1.4, 9))  # of BREAK, in rounds before the last, where breaks are unknown
TOUCHING = 10.0  # times heavier when in front of a bound, where nothing can be, than behind it
OUTSIDE = 1000.0  # of the usual tie, in front of a hull that shadows carved
# Per squared pixel: a side that touches its hull leaves it by half a pixel if all its normals err by their sigma.
TOUCH = (NORMAL_SIGMA / 0.5) ** 2
LIKELY, THERE = 0.5, 0.3  # belief in matter from which the surface is held to it, per squared pixel
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
DUST = 1e-6  # of a tie, or nothing would hold what no other pixel does


def integrate_normals(
    rays: Float[np.ndarray, "height width 3"],
    before: Float[np.ndarray, "height width"],
    own: Float[np.ndarray, "height width 3"],
    normals: Float[np.ndarray, "height width 3"],
    trust: Float[np.ndarray, "height width"],
    bounds: bool = False,
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
    """
    where = np.isfinite(before)
    t0 = before[where]
    chords = _chords(rays, before, own, normals, trust)
    weight = np.where(np.abs(chords.apart) > BREAK, 0, chords.weight)
    tie = _tie(where, 0 if bounds else OUTLINE)[where] / chords.size**2
    t = t0
    for _ in range(ROUNDS):
        hold = tie * np.where(t < t0, TOUCHING if bounds else 1.0, 1.0)
        t = _reweighted(chords.slope, chords.apart, weight, BREAK, hold, t0, t)
    return _spread(t, where)


def integrate_within(
    rays: Float[np.ndarray, "height width 3"],
    hull: Float[np.ndarray, "height width"],
    own: Float[np.ndarray, "height width 3"],
    normals: Float[np.ndarray, "height width 3"],
    trust: Float[np.ndarray, "height width"],
    behind: Float[np.ndarray, "height width"] | None = None,
    matter: Float[np.ndarray, "height width"] | None = None,
) -> Float[np.ndarray, "height width"]:
    """Solve for ray lengths t, so that the surface t * ray has the given normals and lies in a shadow hull.

    Two surfaces that touch have one normal there. So the hull is the surface, to a pixel, where shading tells the
    hull's own normal; elsewhere it lies in front of the surface by no one knows what: over a bowl it is a lid. Held to
    the lid as to an outline, the bottom of a bowl came half way up. Since breaks of the hull are not the surface's, as
    at the bowl's front rim, pairs begin without robust weights, which then narrow [graduated non-convexity: Blake and
    Zisserman, Visual Reconstruction, 1987].

    Args:
        hull: t of the hull; nan where there is none.
        own: its normals, which are used where the given ones are not trusted.
        behind: t that was solved for before.
        matter: belief that the hull's matter in front of that is there, see `hull_occupancy`. Where it is likely, the
            hull is the surface; pairs begin with the breaks between it and `behind`.
    """
    where = np.isfinite(hull)
    t0 = hull[where]
    chords = _chords(rays, hull, own, normals, trust)
    outside = OUTSIDE * _tie(where, 0)[where] / chords.size**2
    touching = TOUCH * np.maximum(likeness(own, normals, trust)[where], DUST) / chords.size**2
    held = np.zeros(len(t0), bool) if matter is None else matter[where] > LIKELY
    t = t0 if behind is None else np.where(held | np.isnan(behind[where]), t0, behind[where])
    for wider in (*(WIDE_FIRST if behind is None else ()), *(1.0 for _ in range(ROUNDS))):
        width = wider * BREAK
        near = touching * geman_mcclure(((t - t0) / (width * chords.size)) ** 2) + DUST * outside
        hold = np.where(t < t0, outside, near)
        hold = np.where(held, THERE / chords.size**2, hold)
        t = _reweighted(chords.slope, np.zeros_like(chords.apart), chords.weight, width, hold, t0, t)
    return _spread(t, where)


def likeness(
    own: Float[np.ndarray, "height width 3"],
    normals: Float[np.ndarray, "height width 3"],
    trust: Float[np.ndarray, "height width"],
) -> Float[np.ndarray, "height width"]:
    """Return how surely a hull has the normals of shading, 0 to 1: two surfaces that touch have one normal there."""
    return trust * np.clip(((own * normals).sum(-1) - LIKE_HULL) / (1 - LIKE_HULL), 0, 1)


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

    The chord between two points of a curve is perpendicular to the mean of its normals there. Where these differ by an
    angle, it may have any slope between the two tangent planes: it weighs less by that variance, angle^2 / 12, over
    that of a normal. So a surface breaks at creases first: the far wall of a cup hangs on its rim, not on the near one.
    The residual of the present surface's own normals, at edges, is to be subtracted, so that a surface that already has
    the given normals does not move.
    """
    where = np.isfinite(before)
    d, t0, sure = rays[where].astype(np.float64), before[where], trust[where]
    n = np.where((sure > OWN_NORMAL)[:, None], normals[where], own[where]).astype(np.float64)
    p, q = _neighbours(where)
    size = np.median(np.linalg.norm(d[p] - d[q], axis=1)) * t0
    worth = np.maximum(sure, OWN_NORMAL)
    turn = np.arccos(np.clip((n[p] * n[q]).sum(1), -1, 1))
    weight = (worth[p] + worth[q]) / 2 / (1 + (turn / NORMAL_SIGMA) ** 2 / 12)
    chord = (worth[p, None] * n[p] + worth[q, None] * n[q]) / ((worth[p] + worth[q]) * size[p])[:, None]
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
    robust = weight * geman_mcclure(((slope @ t - apart) / width) ** 2)
    matrix = slope.T @ diags(robust) @ slope + diags(hold)
    return _solved(csc_matrix(matrix), slope.T @ (robust * apart) + hold * held, t)


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
