"""Lights from the outlines of shadows and the shading of the whole series together, where shading alone does not do.

A phone that lifts shadows, bends contrast or shoots a hot beam makes each light's shading misleading. Outlines are not
touched by that. They fix all lights up to one number (calibration.outlines.fit.homology), which one scan finds: with
the places held, the shading of all photos fits best at the right number, whatever the tone curve. Then all is refitted
together; shading is trusted only as far as its own misfit allows.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from calibration.flashlight.fit import FAR, NEAR, START_BEAM, FlashlightFit
from calibration.flashlight.model import (
    EXTRA_TERMS,
    NOISE,
    Evidence,
    Flashlights,
    Priors,
    cell_residuals,
    free_tangent,
    normal_equations,
    refine,
)
from calibration.ground.ground_field import fit_ground_field
from calibration.ground.ground_shadows import GroundShadows, find_shadows
from calibration.outlines.fit import fit_outlines, homology
from calibration.outlines.outline_maps import GROUND_LIKE, outline_maps
from calibration.outlines.shadow_start import shadow_start
from calibration.outlines.terms import OutlineTerms
from calibration.posed_camera import PosedCamera
from capture.checks.robust import spread
from capture.photos.photo import PhotoStack

SCAN = tuple(np.linspace(-0.3, 0.3, 7))  # of the homology: lights change by up to a half
THIN = 4  # every fourth ground cell: misfits are smooth over many
ALIKE = 40.0  # ground cells that are wrong together: a misfit is smooth over some 60 mm
LIT = 0.85  # visibility from which a cell's brightness counts
LOOSE = Priors(log_power=0.1, beam=50.0, power_outlier=0.5)  # a hot centre, rings; a phone's tone differs by photo
STRAY, ROUNDS = 1.0, 2  # px of outlines' misfit from which a light is looked for again, and how often
TURNS, SLANTS = (-0.3, -0.15, 0.0, 0.15, 0.3), (0.5, 0.65, 0.8, 1.0, 1.25, 1.6)  # radians, factors
FARTHER = (0.6, 0.8, 1.0, 1.25, 1.6)
LEAST_SHADOWS = 0.5  # of the photos that must show a shadow
ROUNDED = 0.03  # of the range: what neither outlines nor shading show


def with_outlines(
    evidence: Evidence, stack: PhotoStack, posed_camera: PosedCamera, photos: Bool[np.ndarray, " photos"]
) -> FlashlightFit | None:
    """Return the joint fit; None where no object or too few shadows are in sight, or no number fits best.

    Args:
        evidence: of the used photos, before any fit.
        photos: which of the stack these are.
    """
    field = fit_ground_field(stack.rgb[photos], ~stack.clipped[photos])
    shadows = find_shadows(field)
    maps = outline_maps(field, shadows, posed_camera)
    if maps is None or len(np.unique(maps.owner)) < LEAST_SHADOWS * maps.n_photos():
        return None
    eye, ground = posed_camera.centre, posed_camera.ground_height
    every = np.ones(maps.n_photos(), bool)
    start, _ = shadow_start(maps, shadows.object_mask, posed_camera)
    lights = fit_outlines(maps, start, eye, ground, every).lights
    evidence = _lit_cells(evidence, shadows, posed_camera)
    terms = OutlineTerms(maps, eye, ground, every)
    fit = _joint(lights, evidence, terms)
    for _ in range(ROUNDS):
        strays = terms.misfit(fit.flashlights.positions) > STRAY
        if not strays.any():
            break
        fit = _joint(_relocated(fit.flashlights.positions, start, strays, terms), evidence, terms)
    return fit


def _joint(lights: Float[np.ndarray, "photos 3"], evidence: Evidence, terms: OutlineTerms) -> FlashlightFit:
    """Fit to outlines and shading together, from the number of the homology at which shading fits best."""
    flashlights, misfit = _scaled(lights, evidence, terms)
    trust = (NOISE / max(misfit, NOISE)) ** 2 / ALIKE
    evidence = replace(evidence, weight=evidence.weight * trust, outlines=terms)
    flashlights, weight = refine(flashlights, evidence, LOOSE, free_tangent, FAR[:8] + NEAR)
    return FlashlightFit(flashlights, evidence, weight, LOOSE, free_tangent)


def _relocated(
    lights: Float[np.ndarray, "photos 3"],
    start: Float[np.ndarray, "photos 3"],
    strays: Bool[np.ndarray, " photos"],
    terms: OutlineTerms,
) -> Float[np.ndarray, "photos 3"]:
    """Move each stray to the place, of many around its start, where the outlines of all photos agree best."""
    lights = lights.copy()
    foot = np.array([*terms.maps.foot[:2], terms.ground])
    for k in np.flatnonzero(strays):
        places = np.concatenate([_around(start[k] - foot) + foot, lights[k : k + 1]])
        trials = np.repeat(lights[None], len(places), 0)
        trials[:, k] = places
        lights[k] = places[int(np.argmin([terms.cost(one) for one in trials]))]
    return lights


def _around(arm: Float[np.ndarray, "3"]) -> Float[np.ndarray, "places 3"]:
    """Places turned about the foot, steeper and flatter, nearer and farther."""
    distance, azimuth = np.linalg.norm(arm), np.arctan2(arm[1], arm[0])
    slant = np.hypot(arm[0], arm[1]) / max(arm[2], 1e-9)
    turned = (azimuth + np.array(TURNS))[:, None, None]
    flat = (slant * np.array(SLANTS))[None, :, None]
    far = (distance * np.array(FARTHER))[None, None] / np.sqrt(1 + flat**2)
    return np.stack(np.broadcast_arrays(far * flat * np.cos(turned), far * flat * np.sin(turned), far), -1).reshape(
        -1, 3
    )


def outline_sigma(fit: FlashlightFit) -> Float[np.ndarray, "photos 3"]:
    """Return one sigma per coordinate of the joint fit, whose residuals are already counted in sigmas."""
    matrix, _ = normal_equations(fit.flashlights, fit.evidence, fit.weight, fit.priors)
    basis = fit.tangent(fit.flashlights)
    covariance = basis @ np.linalg.pinv(basis.T @ matrix @ basis, hermitian=True) @ basis.T
    n, own = len(fit.flashlights.positions), fit.flashlights.per_flashlight()
    variance = np.diag(covariance)[: own * n].reshape(n, own)[:, :3]
    reach = np.linalg.norm(fit.flashlights.positions - fit.evidence.cells.centre, axis=1, keepdims=True)
    return np.sqrt(np.maximum(variance, 0) + (ROUNDED * reach) ** 2 / 3)


def _lit_cells(evidence: Evidence, shadows: GroundShadows, posed_camera: PosedCamera) -> Evidence:
    """Keep every THIN-th ground cell, and of its samples those that are lit ground."""
    height, width = shadows.object_mask.shape
    cells = evidence.cells
    points = cells.points[::THIN]
    pixels = np.rint(posed_camera.resized(width, height).project(points)).astype(int)
    column, row = np.clip(pixels[:, 0], 0, width - 1), np.clip(pixels[:, 1], 0, height - 1)
    lit = (shadows.visibility[:, row, column] > LIT) & (shadows.likelihood[row, column] < GROUND_LIKE)
    thin = replace(cells, points=points, rgb=cells.rgb[:, ::THIN], usable=cells.usable[:, ::THIN])
    return Evidence(thin, evidence.height, evidence.log_grey[:, ::THIN], evidence.weight[:, ::THIN] * lit)


def _scaled(lights: Float[np.ndarray, "photos 3"], evidence: Evidence, terms: OutlineTerms):
    """Return the flashlights at the number of the homology where shading fits best, and its misfit, log units."""

    def held(amount: float):
        return _held(homology(lights, terms.eye, terms.ground, amount), evidence, terms.ground)

    tries = [held(amount) for amount in SCAN]
    misfits = np.array([np.inf if one is None else one[1] for one in tries])
    best = int(misfits.argmin())
    near = slice(max(best - 1, 0), best + 2)
    if len(misfits[near]) == 3 and np.isfinite(misfits[near]).all():
        bend, slope, _ = np.polyfit(SCAN[near], misfits[near], 2)
        between = held(float(np.clip(-slope / (2 * bend), SCAN[best - 1], SCAN[best + 1]))) if bend > 0 else None
        return between or tries[best]
    return tries[best]


def _held(places: Float[np.ndarray, "photos 3"], evidence: Evidence, ground: float):
    """Fit beam, aims and powers with the places held; None where a place is not above the ground."""
    if not np.isfinite(places).all() or (places[:, 2] <= ground).any():
        return None
    n, centre = len(places), evidence.cells.centre
    beam = np.r_[START_BEAM, np.zeros(EXTRA_TERMS)]
    start = Flashlights(places, np.repeat(centre[None], n, 0), np.zeros(n), beam, 0.02, centre)
    flashlights, weight = refine(start, evidence, LOOSE, _places_held, FAR[:8] + NEAR)
    return flashlights, spread(cell_residuals(flashlights, evidence, weight)[evidence.weight > 0])


def _places_held(flashlights: Flashlights) -> Float[np.ndarray, "full reduced"]:
    basis = free_tangent(flashlights)
    n, free = len(flashlights.positions), flashlights.per_flashlight() - 1
    columns = np.arange(basis.shape[1])
    return basis[:, (columns >= free * n) | (columns % free >= 3)]
