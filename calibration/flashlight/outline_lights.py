"""Lights from the outlines of shadows and the shading of the whole series together, where shading alone does not do.

A phone that lifts shadows, bends contrast or shoots a hot beam makes each light's shading misleading. Outlines are not
touched by that. They fix all lights up to one number (calibration.outlines.fit.homology), which one scan finds: with
the places held, the shading of all photos fits best at the right number, whatever the tone curve. Then all is refitted
together; shading is trusted only as far as its own misfit allows.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import minimize

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
from calibration.outlines.fit import fit_outlines
from calibration.outlines.outline_maps import GROUND_LIKE, outline_maps
from calibration.outlines.shadow_start import shadow_start
from calibration.outlines.terms import DROP_OUTLINE, OutlineTerms
from calibration.posed_camera import PosedCamera
from capture.checks.robust import spread
from capture.photos.photo import PhotoStack

SPAN, TRIALS = np.array([0.15, 0.15, 0.15, 0.15]), 60  # of the search's first steps: shares of the lights' q; trials
THIN = 4  # every fourth ground cell: misfits are smooth over many
ALIKE = 40.0  # ground cells that are wrong together: a misfit is smooth over some 60 mm
LIT = 0.85  # visibility from which a cell's brightness counts
LOOSE = Priors(log_power=0.1, beam=50.0, power_outlier=0.5)  # a hot centre, rings; a phone's tone differs by photo
STRAY, UNUSUAL = 1.0, 2.0  # px of an outline's misfit, sigmas of a distance, from which a light is looked for again
STEPS, FINER = (-2, -1, 0, 1, 2), 3  # of the places that are tried for it; rounds, each a third as wide
TURN, SLANT, FARTHER = 0.15, 0.25, 0.25  # radians; log of x / z; log of the distance
ROUNDS = 2  # of common and single motions in turn
FEWEST_WHOLE = 8  # photos whose shadows the picture does not cut
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
    whole = ~maps.is_cut if (~maps.is_cut).sum() >= FEWEST_WHOLE else every
    lights = fit_outlines(maps, start, eye, ground, whole).lights
    cells = _lit_cells(evidence, shadows, posed_camera)
    terms = OutlineTerms(maps, eye, ground, every, whole)
    for _ in range(ROUNDS):
        flashlights, weight, trust = _joint(lights, cells, terms)
        lights = flashlights.positions
    located = terms.misfit(lights) < DROP_OUTLINE
    strays = ~whole | ~located | (np.abs(terms.unusual(lights)) > UNUSUAL)
    evidence = replace(cells, weight=cells.weight * trust * whole[:, None], outlines=terms)
    if strays.any():
        terms = replace(terms, trusted=~strays)
        for k in np.flatnonzero(strays):
            flashlights = _relocated(flashlights, start, k, replace(terms, trusted=~strays | (np.arange(len(strays)) == k)))
        terms = replace(terms, trusted=every)
        evidence = replace(cells, weight=cells.weight * trust, outlines=terms)
        flashlights, weight = refine(flashlights, evidence, LOOSE, free_tangent, FAR[:4] + NEAR)
        trusted = terms.misfit(flashlights.positions) < DROP_OUTLINE
        if not trusted.all():  # a light in a wrong place would carve away what the others need
            terms = replace(terms, trusted=trusted)
            evidence = replace(evidence, weight=evidence.weight * trusted[:, None], outlines=terms)
            flashlights, weight = refine(flashlights, evidence, LOOSE, free_tangent, FAR[:4] + NEAR)
    return FlashlightFit(flashlights, evidence, weight, LOOSE, free_tangent)


def _joint(lights: Float[np.ndarray, "photos 3"], cells: Evidence, terms: OutlineTerms):
    """Fit to outlines and shading together; return flashlights, evidence and its robust weights."""
    trusted = replace(cells, weight=cells.weight * terms.trusted[:, None])
    flashlights, misfit = _scaled(lights, trusted, terms)
    trust = (NOISE / max(misfit, NOISE)) ** 2 / ALIKE
    evidence = replace(trusted, weight=trusted.weight * trust, outlines=terms)
    return *refine(flashlights, evidence, LOOSE, free_tangent, FAR[:8] + NEAR), trust


def _relocated(
    flashlights: Flashlights, start: Float[np.ndarray, "photos 3"], k: int, terms: OutlineTerms
) -> Flashlights:
    """Move light k to the place, of many around its start, where the outlines of the trusted photos agree best."""
    lights, foot = flashlights.positions.copy(), terms.maps.foot
    best, width = start[k], 1.0
    for _ in range(FINER):
        places = np.concatenate([_around(best - foot, width) + foot, best[None], lights[k : k + 1]])
        trials = np.repeat(lights[None], len(places), 0)
        trials[:, k] = places
        best, width = places[int(np.argmin([terms.cost(one) for one in trials]))], width / 3
    lights[k] = best
    targets, power = flashlights.targets.copy(), flashlights.log_power.copy()
    targets[k], power[k] = flashlights.aim, 0.0
    return replace(flashlights, positions=lights, targets=targets, log_power=power)


def _around(arm: Float[np.ndarray, "3"], width: float) -> Float[np.ndarray, "places 3"]:
    """Places turned about the foot, steeper and flatter, nearer and farther; the narrower the finer and the fewer."""
    steps = STEPS if width == 1 else STEPS[1:-1]
    turn, slant, far = (one.ravel() for one in np.meshgrid(steps, steps, steps))
    distance, azimuth = np.linalg.norm(arm), np.arctan2(arm[1], arm[0]) + TURN * width * turn
    flat = np.hypot(arm[0], arm[1]) / max(arm[2], 1e-9) * np.exp(SLANT * width * slant)
    height = distance * np.exp(FARTHER * width * far) / np.sqrt(1 + flat**2)
    return np.stack([height * flat * np.cos(azimuth), height * flat * np.sin(azimuth), height], -1)


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
    """Return the flashlights where outlines and shading agree best among all that leave the shadows coherent.

    These are, in q = (x, y, 1) / z, a common scale and shift of q [Kriegman and Belhumeur 2001]: four numbers, of which
    the silhouette fixes three only loosely. Searched by Nelder and Mead's simplex; shading is refitted at every trial.
    Also returns the misfit of the shading, log units.
    """
    foot = np.array([*terms.maps.foot[:2], terms.ground])
    arm = lights - foot
    plane = np.concatenate([arm[:, :2], np.ones((len(arm), 1))], 1) / arm[:, 2:]
    unit = np.array([1.0, 1.0, float(np.median(plane[:, 2]))])
    cells = (evidence.weight > 0).sum() / ALIKE

    def moved(numbers: Float[np.ndarray, "4"]) -> Float[np.ndarray, "photos 3"]:
        found = np.exp(numbers[3]) * (plane + numbers[:3] * unit)
        height = 1 / np.maximum(found[:, 2], 0.2 * unit[2])
        return foot + np.stack([found[:, 0] * height, found[:, 1] * height, height], -1)

    def cost(numbers: Float[np.ndarray, "4"]) -> float:
        places = moved(numbers)
        return terms.cost(places) + cells * np.log(_held(places, evidence)[1])

    simplex = np.concatenate([np.zeros((1, 4)), np.diag(SPAN)])
    best = minimize(cost, np.zeros(4), method="Nelder-Mead", options={"initial_simplex": simplex, "maxfev": TRIALS}).x
    return _held(moved(best), evidence)


def _held(places: Float[np.ndarray, "photos 3"], evidence: Evidence) -> tuple[Flashlights, float]:
    """Fit beam, aims and powers with the places held; return also the shading's misfit, log units."""
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
