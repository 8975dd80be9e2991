"""Light that a wall beside the ground sends back: one bounce from a matt upright plane, shared by all photos.

A wall of albedo r at w, its normal n towards the scene, lit with E(w), sends to level ground at p

    r / pi * integral of E(w) (n . (p - w)) (w_z - p_z) / |p - w|^4 dw

[Goral et al., Modeling the Interaction of Light between Diffuse Surfaces (1984)]. Untold, it moves lights by a third of
their distance: it is a tenth of the light near the wall, and smooth, as what a lamp elsewhere would send.
"""

import numpy as np
from jaxtyping import Float

from calibration.flashlight.beam_profile import log_gain

WALL_TERMS = 3  # azimuth (rad, world) in which the wall lies, log of its distance from the photo's middle (mm), albedo
NO_WALL = np.array([0.0, np.log(400.0), 0.0])  # an arm's reach away, were there one
NEAREST, FARTHEST = np.log(60.0), np.log(3000.0)  # nearer, the thing would touch it; farther, it sends 1 % or less
LARGEST_STEP = 0.3
ALONG = np.radians(np.linspace(-76, 76, 13))  # angles under which the patches of the quadrature are seen, ...
UP = np.radians(np.linspace(5, 75, 8))  # ... from the point of the ground at its foot
DARKEST = 1e-3  # cosine off the beam's axis: behind, nothing is lit
BY = 1e-3  # step of the differences that stand for derivatives

Wall = Float[np.ndarray, "3"]


def moved(wall: Wall, step: Wall) -> Wall:
    """Return the wall after a step, which is limited."""
    azimuth, distance, albedo = wall + np.clip(step, -LARGEST_STEP, LARGEST_STEP)
    return np.array([azimuth, np.clip(distance, NEAREST, FARTHEST), np.clip(albedo, 0.0, 1.0)])


def wall_light(
    wall: Wall,
    positions: Float[np.ndarray, "photos 3"],
    axes: Float[np.ndarray, "photos 3"],
    beam: Float[np.ndarray, " terms"],
    narrowest: float,
    points: Float[np.ndarray, "cells 3"],
    middle: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "photos cells"]:
    """Return the irradiance of level ground by way of the wall, for flashlights of power 1; world, mm.

    Args:
        narrowest: cosine off the axis from which on the beam's terms are known; beyond, it falls as its first term.
        middle: of the photo, on the ground.
    """
    if wall[2] <= 0:
        return np.zeros((len(positions), len(points)))
    away, reach = np.array([np.cos(wall[0]), np.sin(wall[0]), 0.0]), np.exp(wall[1])
    side, up = np.array([-away[1], away[0], 0.0]), np.array([0.0, 0.0, 1.0])
    u, v = (x.ravel() for x in np.meshgrid(np.tan(ALONG), np.tan(UP)))
    area = reach**2 * (1 + u**2) * (1 + v**2) * (ALONG[1] - ALONG[0]) * (UP[1] - UP[0])
    patches = middle + reach * (away + u[:, None] * side + v[:, None] * up)
    to_patch = patches - positions[:, None]
    distance = np.linalg.norm(to_patch, axis=-1)
    cosine = np.einsum("kwx,kx->kw", to_patch, axes) / distance
    inside = np.maximum(cosine, narrowest)
    gain = log_gain(inside, beam) + abs(beam[0]) * np.log(np.maximum(cosine, DARKEST) / inside)
    lit = np.where(cosine > 0, np.exp(gain) * np.maximum(to_patch @ away, 0) / distance**3, 0.0)
    level, deep = patches @ away, points @ away  # along the wall's normal: points lie before it
    below = patches[:, 2:] - points[:, 2]
    apart = (patches**2).sum(1)[:, None] + (points**2).sum(1) - 2 * patches @ points.T
    form = np.maximum(level[:, None] - deep, 0) * np.maximum(below, 0) / apart**2
    return wall[2] / np.pi * lit @ (form * area[:, None])
