"""Flashlights fitted together with what a phone makes of their light: a bent response, and beams with rings.

A smooth beam in plain pictures is a fit of few numbers that holds where it is true. Elsewhere distance, beam and
response stand in for one another, and it misplaces all lights by tens of per cent. The richer fit begins from the plain
ones and is taken where the ground's brightness asks for it.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from calibration.flashlight.beam_profile import RING_TERMS, SMOOTH_TERMS
from calibration.flashlight.descent import refine
from calibration.flashlight.fit import (
    ALIKE_POWER,
    FAR,
    NEAR,
    FirstFits,
    FlashlightFit,
    fit_flashlights,
    independent,
    thinned,
    without_gloss,
)
from calibration.flashlight.model import Evidence, Flashlights, cell_residuals, cost, free_tangent
from calibration.flashlight.wall import WALL_TERMS
from calibration.lights.response import TERMS
from capture.checks.robust import spread

ROUNDS = 8  # at most, of a schedule of steps: fits creep along what distance, beam and response leave free
STILL = 0.98  # of the cost: a round that lowers it less is the last


def with_response(first: FirstFits, plain: FlashlightFit, evidence: Evidence) -> FlashlightFit:
    """Return the fit with rings and response, if a few cells ask for them; else the plain fit.

    Args:
        first: fits of a few cells without either, from which this one begins, too.
        evidence: before any fit.
    """
    thin = thinned(evidence)
    near = _to_rest(_round(bent(plain.flashlights, evidence), thin), thin)
    if not _is_likelier(near, _round(plain.flashlights, thin), thin):
        return plain
    begun = sorted((_round(bent(state, evidence), thin) for state in first.states), key=lambda one: one[0])
    found = [near, *(_to_rest(one, thin) for one in begun[: len(begun) // 2])]  # what is far behind does not catch up
    best = min(found, key=lambda one: one[0])
    costs = np.array([one[0] for one in found])
    fits = FirstFits(tuple(one[1] for one in found), costs, independent(best[1], best[2], thin))
    fit = without_gloss(fit_flashlights(best[1], evidence, free_tangent))
    return replace(fit, between=fits.variance_about(fit.flashlights.positions))


def _is_likelier(rich: "_Found", plain: "_Found", thin: Evidence) -> bool:
    """Return whether the likelihood gains more than the further terms cost, by the samples that both fits keep.

    Schwarz, Estimating the Dimension of a Model, Annals of Statistics 6 (1978).
    """
    both = (rich[2] > 0) & (plain[2] > 0)
    sizes = (spread(cell_residuals(one[1], thin, one[2])[both]) for one in (plain, rich))
    count = independent(rich[1], rich[2], thin)
    terms = len(rich[1].response) + len(rich[1].beam) - len(plain[1].beam)
    return bool(count * np.subtract(*np.log(list(sizes))) > terms / 2 * np.log(count))


def bent(state: Flashlights, evidence: Evidence) -> Flashlights:
    """Return the state with rings, and with a response where the evidence is of pictures that may have one."""
    beam = np.r_[state.beam, np.zeros(SMOOTH_TERMS + RING_TERMS - len(state.beam))]
    response = np.zeros(0 if evidence.exposure is None else TERMS)
    return replace(state, beam=beam, response=response, oval=None)


_Found = tuple[float, Flashlights, Float[np.ndarray, "photos cells"]]  # cost, state, weight of its samples


def _round(state: Flashlights, thin: Evidence) -> _Found:
    state, weight = refine(state, thin, ALIKE_POWER, without_wall, FAR + NEAR)
    return cost(state, thin, weight, ALIKE_POWER), state, weight


def _to_rest(found: _Found, thin: Evidence) -> _Found:
    for _ in range(ROUNDS):
        before, found = found, min(found, _round(found[1], thin), key=lambda one: one[0])
        if found[0] > STILL * before[0]:
            break
    return found


def as_pictured(fit: FlashlightFit) -> FlashlightFit:
    """Fit beam, aims and powers to the pictures as they are, the places held: what comes after knows no response."""
    if not len(fit.flashlights.response):
        return fit
    evidence, state = replace(fit.evidence, exposure=None), replace(fit.flashlights, response=np.zeros(0))
    flashlights, weight = refine(state, replace(evidence, outlines=None), fit.priors, places_held, FAR[:2] + NEAR)
    return replace(fit, flashlights=flashlights, weight=weight, evidence=evidence)


def without_wall(flashlights: Flashlights) -> Float[np.ndarray, "full reduced"]:
    """Return free_tangent, without the wall where there is none: one is found from near its place only."""
    basis = free_tangent(flashlights)
    if flashlights.wall[2] > 0:
        return basis
    last = basis.shape[1] - 3 - len(flashlights.response)  # and the mean aim
    return np.delete(basis, np.arange(last - WALL_TERMS, last), axis=1)


def places_held(flashlights: Flashlights) -> Float[np.ndarray, "full reduced"]:
    """Return without_wall's columns that move no light."""
    basis = without_wall(flashlights)
    n, free = len(flashlights.positions), flashlights.per_flashlight() - 1
    columns = np.arange(basis.shape[1])
    return basis[:, (columns >= free * n) | (columns % free >= 3)]


def own_tangent(flashlights: Flashlights) -> Float[np.ndarray, "full own"]:
    """Return the columns of free_tangent that move each light by itself, and nothing that all share."""
    return free_tangent(flashlights)[:, : (flashlights.per_flashlight() - 1) * len(flashlights.positions)]
