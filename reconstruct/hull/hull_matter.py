"""Which of the matter in front of an integral of normals is there? The rays from what is lit and what is dark tell.

A shadow hull holds the object, and more: over a bowl it is a lid. The integral of the normals lies behind the lid, but
runs on below the bowl's front rim as if there were no break: floor and rim have one normal. Each pixel's piece of the
hull, from its front to the integral, is there as a whole or not at all, to be told from rays that meet nothing behind
the integral: a lit ray meets no piece, a dark one at least one. What is there is found by expectation maximisation
under a noisy or [Pearl, Probabilistic Reasoning in Intelligent Systems, 1988, 4.3]: with m_i the belief in piece i,

    a dark ray r is due to piece i with  q_ri = m_i / (1 - (1 - LEAK) prod_j (1 - m_j)),  j over the pieces it meets,
    m_i = (sum_r q_ri + MEAN + ALIKE a_i) / (sum_r q_ri + LIT * (lit rays through i) + 2 MEAN + ALIKE a_i).

So one piece that no lit ray meets, the rim, accounts for a dark ray alone, and the lid beside it is not needed. The
wall below the rim is not needed either, but has the hull's normal, a_i = 1; the lid over a flat floor has it, too, and
lit rays deny it. A ray from a point behind such a piece counts by 1 - a_i m_i: the point is not there if the piece is.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from reconstruct.labels.labels import Labels
from reconstruct.scene import Scene, ground_points
from reconstruct.sdf.grid import SdfGrid

LEAK = 0.02  # of dark rays are dark for another reason: a wrong label
LIT = 3.0  # times as much as a dark ray, a lit one counts: it denies all pieces that it meets, a dark one needs one
MEAN = 1.0  # rays for and as many against, where there are none
ALIKE = 10.0  # rays for, where the hull has the normal of shading
ROUNDS = 40
SURE = 0.3  # confidence of a label from which its ray is asked
FACING = 0.15  # cosine between normal and light: below, a facet decides whether it is lit
MOST_RAYS = 1_000_000  # of which most miss the hull
OFFSET = 2.0  # pixels: a ray begins above its own piece
BEHIND = 1.0  # pixels behind the integral there is matter
INSIDE = 0.3  # voxels: deeper in the hull there is matter
STEP = 0.7  # voxels along a ray


@dataclass(frozen=True)
class _Rays:
    """Rays from points to lights, and what they are labelled."""

    origins: Float[np.ndarray, "n 3"]  # world
    directions: Float[np.ndarray, "n 3"]  # unit, world
    lengths: Float[np.ndarray, " n"]  # to the light
    dark: Bool[np.ndarray, " n"]
    weight: Float[np.ndarray, " n"]  # confidence of the label, over the share of rays that are drawn
    pixels: Int[np.ndarray, " n"]  # index of the pixel whose piece lies in front of the origin; -1 on the ground


@dataclass(frozen=True)
class _Met:
    """Which pieces the rays meet that meet nothing behind the integral: pairs of a ray and a piece."""

    rays: Int[np.ndarray, " pairs"]
    pieces: Int[np.ndarray, " pairs"]  # index of the pixel


def hull_occupancy(
    hull: SdfGrid,
    scene: Scene,
    labels: Labels,
    behind: Float[np.ndarray, "height width"],
    step: int,
    alike: Float[np.ndarray, "height width"],
) -> Float[np.ndarray, "height width"]:
    """Return the belief, 0 to 1, that the hull's matter in front of a surface is there; 0.5 where no ray tells.

    Args:
        labels: on the scene's pixels.
        behind: world length of every step-th pixel's ray to that surface; nan beside it.
        step: of the pixels along each axis.
        alike: how surely the hull has the normals of shading, 0 to 1, see `likeness`.
    """
    rays = _rays(scene, labels, behind, step)
    met = _met(rays, hull, scene, behind, step)
    dark = rays.dark[met.rays]
    (lit_ray, lit_piece), (ray, piece) = ((met.rays[some], met.pieces[some]) for some in (~dark, dark))
    touching = ALIKE * alike.ravel()
    belief = np.full(behind.size, 0.5)
    for _ in range(ROUNDS):
        doubt = rays.weight * np.where(rays.pixels < 0, 1.0, 1 - (alike.ravel() * belief)[rays.pixels])
        lit, weight = np.bincount(lit_piece, doubt[lit_ray], minlength=behind.size), doubt[ray]
        free = np.exp(np.bincount(ray, np.log1p(-belief)[piece], minlength=len(rays.dark)))
        due = np.bincount(piece, weight * belief[piece] / (1 - (1 - LEAK) * free[ray]), minlength=behind.size)
        belief = (due + MEAN + touching) / (due + LIT * lit + 2 * MEAN + touching)
    return belief.reshape(behind.shape)


def _rays(scene: Scene, labels: Labels, behind: Float[np.ndarray, "height width"], step: int) -> _Rays:
    """Return the rays from the ground, and from the surface where it faces the light, that have sure labels."""
    part = (slice(None, None, step), slice(None, None, step))
    directions = scene.directions[part].numpy().astype(np.float64)
    eye, normals = scene.eye.numpy().astype(np.float64), labels.normals[part].numpy()
    is_object = labels.mask[part].numpy() > 0.5
    on_object = (eye + behind[..., None] * directions).reshape(-1, 3)
    on_ground = ground_points(scene)[part].numpy().astype(np.float64).reshape(-1, 3)
    below = is_object.reshape(-1, 1) & (on_object[:, 2:] < on_ground[:, 2:])  # nothing is there
    points = np.where(below, np.nan, np.where(is_object.reshape(-1, 1), on_object, on_ground))
    is_object, normals = is_object.ravel(), normals.reshape(-1, 3)
    visible = labels.visibility[(slice(None), *part)].numpy().reshape(len(scene.lights), -1)
    confidence = labels.confidence[(slice(None), *part)].numpy().reshape(len(scene.lights), -1)
    share = min(1.0, MOST_RAYS / confidence.size)
    drawn = np.random.default_rng(0).random(confidence.shape) < share
    found = []
    for number, light in enumerate(scene.lights.numpy().astype(np.float64)):
        there = np.flatnonzero(drawn[number] & (confidence[number] > SURE) & np.isfinite(points).all(-1))
        to = light[:3] - light[3] * points[there]
        far = np.linalg.norm(to, axis=1)
        to /= far[:, None]
        asked = ~is_object[there] | ((to * normals[there]).sum(1) > FACING)
        there, length = there[asked], np.where(light[3] > 0, far, np.inf)[asked]
        of = np.where(is_object[there], there, -1)
        found.append(
            (points[there], to[asked], length, visible[number][there] < 0.5, confidence[number][there] / share, of)
        )
    return _Rays(*(np.concatenate(column) for column in zip(*found, strict=True)))


def _met(rays: _Rays, hull: SdfGrid, scene: Scene, behind: Float[np.ndarray, "height width"], step: int) -> _Met:
    """Follow the rays through the hull, until they meet what is behind the surface."""
    pixel = float(np.median(np.linalg.norm(np.diff(scene.directions[::step, ::step].numpy(), axis=1), axis=-1)))
    size = pixel * float(np.nanmedian(behind))
    first, last = _within_box(rays, hull)
    first, last = np.maximum(first, OFFSET * size), np.minimum(last, rays.lengths)
    near = np.flatnonzero(first < last)
    blocked = np.zeros(len(first), bool)
    pairs, pace = [np.zeros(0, np.int64)], STEP * hull.spacing
    for number in range(int(np.ceil((last - first)[near].max(initial=0) / pace))):
        on = near[(first[near] + number * pace < last[near]) & ~blocked[near]]
        points = rays.origins[on] + (first[on] + number * pace)[:, None] * rays.directions[on]
        inside = hull.sdf(torch.from_numpy(points).float()).numpy() < -INSIDE * hull.spacing
        on, points = on[inside], points[inside]
        piece = _pixels(scene, points, behind.shape, step)
        in_front = np.linalg.norm(points - scene.eye.numpy(), axis=1) < behind.ravel()[piece] + BEHIND * size
        blocked[on[~in_front]] = True
        pairs.append(on[in_front].astype(np.int64) * behind.size + piece[in_front])
    ray, piece = np.divmod(np.unique(np.concatenate(pairs)), behind.size)
    free = ~blocked[ray]
    return _Met(ray[free], piece[free])


def _within_box(rays: _Rays, hull: SdfGrid) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the lengths at which rays enter and leave the hull's box; the first is the larger if they miss it."""
    low = hull.origin.numpy().astype(np.float64)
    high = low + hull.spacing * (np.array(hull.values.shape) - 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([(low - rays.origins) / rays.directions, (high - rays.origins) / rays.directions])
    return np.nanmax(ends.min(0), axis=1), np.nanmin(ends.max(0), axis=1)


def _pixels(scene: Scene, points: Float[np.ndarray, "n 3"], shape: tuple[int, ...], step: int) -> Int[np.ndarray, " n"]:
    """Return the index of the pixel, of every step-th, nearest to where each point is seen."""
    at = np.round(scene.posed_camera.project(points) / step).astype(np.int64)
    column, row = np.clip(at, 0, (shape[1] - 1, shape[0] - 1)).T
    return row * shape[1] + column
