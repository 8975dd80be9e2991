"""All lights from outlines and shading together: the search from rough starts, and the motion that outlines leave free,
which the shading of all photos decides."""

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from calibration.flashlight.beam_aims import looked_for_aims, places_by_shading
from calibration.flashlight.beam_profile import EXTRA_TERMS, RING_TERMS
from calibration.flashlight.fit import FAR, NEAR, START_BEAM, FlashlightFit, may_be_misplaced
from calibration.flashlight.model import (
    NOISE,
    Evidence,
    Flashlights,
    Priors,
    Samples,
    cell_residuals,
    free_tangent,
    refine,
)
from calibration.outlines.terms import OutlineTerms
from capture.checks.robust import spread

LOG = logging.getLogger(__name__)
AIM_ROUNDS = 2  # of looking for aims, each with the beam that the last one's aims gave
LEAST_SHARE = 0.2  # of a light's height that a motion leaves
USUAL_MISFIT = 0.03  # log units, before it is measured
BLURS = (8.0, 5.0, 3.0, 2.0, 1.4, 1.0)  # factors of an outline's sigma in one pass of the search, ...
PER_BLUR = 4  # ... and the steps with each
FREE_AIMS = (0.3,) * len(BLURS)  # of the scale: how far beams may miss the common aim, ...
NARROW_AIMS = (0.1, 0.12, 0.15, 0.2, 0.25, 0.3)  # ... and in a pass that begins with all beams aimed alike
FOLLOWED = 2  # starts, the best of one pass, that are followed by further ones
PASSES = 3  # of these, at most, ...
LOST = 1e9  # the cost of lights that no ground follows
NO_GROUND = 1e-6  # log units: a misfit of less is that of no cell
GAIN = 2.0  # ... while each gains more than this of the negative log posterior
SMALL = (-0.1, 0.0, 0.1)  # homologies, of the median 1 / z
MORE_SCANS = 4  # at most, where the best start is the first or the last of its scan
SCATTER = 4.0  # of the negative log posterior between joint fits from near starts: it has many small minima
ALIKE = 80.0  # ground cells that are wrong together: within a photo 14 to 24 by their correlation, and photos err alike
CONTRASTS = (0.7, 0.8, 0.9, 1.0, 1.1)  # of log brightness in the picture over that in the scene, that are tried
CONTRAST_WIDTH = 0.1  # prior sigma of its logarithm about 0: phones lift whole regions that are dark
_Found = tuple[float, FlashlightFit, float]  # cost of its outlines, fit, misfit of its shading (log units)
LOOSE = Priors(log_power=0.1, beam=50.0, power_outlier=0.5)  # a hot centre, rings; a phone's tone differs by photo


def searched(starts: list[Float[np.ndarray, "photos 3"]], evidence: Evidence) -> tuple[FlashlightFit, int]:
    """Fit to outlines and shading together from rough starts; return the best fit, and the number of its start.

    Outlines alone pull all lights too near, and one light that is too near, its beam aimed elsewhere, may agree with
    its photo. So both are fitted from the first step on, with an outline's sigma that falls to its own (graduated
    non-convexity) [Blake and Zisserman, Visual Reconstruction (1987)]; the best are followed by further passes, which
    begin with lights that misfit where shading puts them, and by one that begins with all beams aimed alike. What is
    best is decided by the cost of everything. `between` of the fit holds what the others say that explain the photos
    about as well.

    Args:
        starts: positions, world.
        evidence: with outlines; photos that these do not trust stay about where the starts put them.
    """
    assert evidence.outlines is not None
    trusted = _trusted(evidence, USUAL_MISFIT)
    first = []
    for number, one in enumerate(starts):
        LOG.info("fitting lights to outlines of shadows and shading, start %d of %d", number + 1, len(starts))
        first.append(_pass(one, evidence, USUAL_MISFIT, None, FREE_AIMS))
    order = np.argsort(_posteriors(first, trusted))[:FOLLOWED]
    found = [_followed(first[number], evidence) for number in order]
    posterior = _posteriors(found, trusted)
    best = int(posterior.argmin())
    fit = found[best][1]
    places = np.stack([one[1].flashlights.positions for one in found])
    weight = np.exp((posterior.min() - posterior) / SCATTER)
    between = variance_about(fit.flashlights.positions, places, weight) * evidence.outlines.trusted[:, None]
    return replace(fit, between=between), int(order[best])


def _followed(found: _Found, evidence: Evidence) -> _Found:
    """Return the best of further passes of the search."""
    trusted = _trusted(evidence, USUAL_MISFIT)
    for number in range(PASSES):
        LOG.info("improving lights from outlines of shadows and shading, pass %d of at most %d", number + 1, PASSES)
        further = _again(found, evidence, FREE_AIMS)
        before, after = _posteriors([found, further], trusted)
        found = further if after < before else found
        if before - after < GAIN:
            break
    LOG.info("improving lights from outlines of shadows and shading, with all beams aimed alike")
    alike = _again(found, evidence, NARROW_AIMS)
    tried = [found, alike, _again(alike, evidence, FREE_AIMS)]
    return tried[int(_posteriors(tried, trusted).argmin())]


def _again(found: _Found, evidence: Evidence, aims: tuple[float, ...]) -> _Found:
    _, fit, misfit = found
    return _pass(_where_shading_puts(fit, evidence), evidence, misfit, fit.flashlights, aims)


def passed_again(flashlights: Flashlights, evidence: Evidence) -> FlashlightFit | None:
    """Return the fit after one more pass of the search, or None if that explains the photos no better."""
    trusted = _trusted(evidence, USUAL_MISFIT)
    found = _settled(flashlights, evidence, trusted, LOOSE)
    further = _again(found, evidence, FREE_AIMS)
    before, after = _posteriors([found, further], trusted)
    return further[1] if before - after > GAIN else None


def _where_shading_puts(fit: FlashlightFit, evidence: Evidence) -> Float[np.ndarray, "photos 3"]:
    """Return the places (world) of a fit; those of trusted photos that misfit are replaced by their shading's best."""
    assert evidence.outlines is not None
    places = fit.flashlights.positions.copy()
    for k in np.flatnonzero(may_be_misplaced(fit) & evidence.outlines.trusted).tolist():
        places[k] = [*places_by_shading(fit.flashlights, fit.evidence, fit.weight, k, 1), places[k]][0]
    return places


def _pass(
    places: Float[np.ndarray, "photos 3"],
    evidence: Evidence,
    misfit: float,
    like: Flashlights | None,
    aims: tuple[float, ...],
) -> _Found:
    """Fit as _joint does, after steps with blurred outlines; aims: prior sigmas, one for each blur."""
    assert evidence.outlines is not None
    weighted = _trusted(evidence, misfit)
    state = _held(places, weighted, like)[0]
    if aims[0] < aims[-1]:
        state = replace(state, targets=np.repeat(state.aim[None], len(places), 0))
    for blur, aim in zip(BLURS, aims, strict=True):
        blurred = replace(weighted, outlines=replace(evidence.outlines, blur=blur))
        state = refine(state, blurred, replace(LOOSE, aim=aim), free_tangent, FAR[:PER_BLUR])[0]
    return _settled(state, evidence, weighted, LOOSE)


def best_common_motion(
    lights: Float[np.ndarray, "photos 3"], evidence: Evidence, sizes: tuple[float, ...], like: Flashlights
) -> FlashlightFit:
    """Fit to outlines and shading together from several starts that cast the same shadows; return the mean of these.

    The homology x -> (x + m h eye) / (1 + m h) of heights h leaves all shadows and the silhouette as they are [Kriegman
    and Belhumeur 2001, What shadows reveal about object structure], and with it go joint motions that outlines fix only
    loosely. Only shading decides, and it moves a light alone no farther than its outline lets it: so m is scanned, and
    its posterior mean is taken. Where the first or the last m is the best, the scan goes on from there.

    Args:
        lights: positions, world.
        evidence: with outlines.
        sizes: of the motions that are tried first; see same_shadows.
        like: a state with aims, powers and beam to begin with.
    """
    assert evidence.outlines is not None
    found, goes_on = _scan(lights, evidence, sizes, like)
    for _ in range(MORE_SCANS):
        if not goes_on:
            break
        further, goes_on = _scan(found[1].flashlights.positions, evidence, SMALL, found[1].flashlights)
        before, after = _posteriors([found, further], evidence)
        if after >= before:
            break
        found = further
    return found[1]


def at_best_contrast(start: Flashlights, evidence: Evidence, contrasts: tuple[float, ...] = CONTRASTS) -> FlashlightFit:
    """Fit to outlines and shading together under the contrast that explains the photos best; see best_common_motion.

    A phone that evens out brightness over whole regions shows a share of the differences of log brightness that the
    light makes. Taken for the light's, these place all lights too far away. The share is one number for all photos: its
    posterior mean is taken, and `between` of the fit holds what other shares would give. The fit that is returned has
    beam and powers as they are in the pictures.

    Args:
        start: places, aims, powers and beam near the answer.
        evidence: with outlines.
        contrasts: that are tried; 1 alone where the photos are linear.
    """
    assert evidence.outlines is not None
    found = []
    for number, one in enumerate(contrasts):
        LOG.info("fitting the lights under contrast %d of %d", number + 1, len(contrasts))
        found.append(_joint(start.positions, _flattened(evidence, one), USUAL_MISFIT, LOOSE, start))
    shown = [(cost, fit, one * misfit) for one, (cost, fit, misfit) in zip(contrasts, found, strict=True)]
    surprise = np.log(contrasts) / CONTRAST_WIDTH
    cost = _posteriors(shown, evidence) + 0.5 * surprise**2  # of the misfit in the pictures
    weight = np.exp(cost.min() - cost)
    best = float(weight @ contrasts / weight.sum())
    near = found[int(np.abs(np.array(contrasts) - best).argmin())][1].flashlights
    fit = best_common_motion(near.positions, _flattened(evidence, best), SMALL, near)
    places = np.stack([one.flashlights.positions for _, one, _ in found])
    middle = np.einsum("f,fkx->kx", weight / weight.sum(), places)
    return _as_pictured(replace(fit, between=fit.between + variance_about(middle, places, weight)), evidence)


def _flattened(evidence: Evidence, contrast: float) -> Evidence:
    return replace(evidence, log_grey=evidence.log_grey / contrast)


def _as_pictured(fit: FlashlightFit, evidence: Evidence) -> FlashlightFit:
    """Fit beam, aims and powers to the evidence with the places held, so that they say what the pictures show."""
    weighted = _weighted(evidence, USUAL_MISFIT)
    flashlights, weight = _held(fit.flashlights.positions, weighted, fit.flashlights)
    misfit = spread(cell_residuals(flashlights, weighted, weight)[weighted.weight > 0])
    return replace(fit, flashlights=flashlights, weight=weight, evidence=_weighted(evidence, misfit))


def _posteriors(found: Sequence[_Found], evidence: Evidence) -> Float[np.ndarray, " found"]:
    """Return the negative log posteriors of fits to the same evidence, up to a constant that they share.

    The shading counts as cells whose errors are independent, as many as in the fits themselves: log(misfit) for each.
    """
    misfit = np.maximum([one[2] for one in found], NO_GROUND)
    cells = (evidence.weight > 0).sum() / ALIKE
    return np.array([one[0] for one in found]) + cells * np.log(misfit)


def _scan(
    lights: Float[np.ndarray, "photos 3"], evidence: Evidence, sizes: tuple[float, ...], like: Flashlights
) -> tuple[_Found, bool]:
    """Fit from each start and from their mean; return the mean's fit, and whether the best start was the first or the
    last, so that a better one may lie beyond."""
    terms = evidence.outlines
    assert terms is not None
    found = [_joint(same_shadows(lights, size, terms), evidence, USUAL_MISFIT, LOOSE, like) for size in sizes]
    cost = _posteriors(found, evidence)
    weight = np.exp((cost.min() - cost) / SCATTER)
    mean = float((weight * sizes).sum() / weight.sum())
    best = int(cost.argmin())
    misfit = found[best][2]
    nearest = min(sizes, key=lambda size: abs(size - mean))
    near = found[sizes.index(nearest)][1].flashlights
    middle = _joint(same_shadows(near.positions, mean - nearest, terms), evidence, misfit, LOOSE, near)
    places = np.stack([one[1].flashlights.positions for one in found])
    fit = replace(middle[1], between=variance_about(middle[1].flashlights.positions, places, weight))
    return (middle[0], fit, middle[2]), best in (0, len(sizes) - 1)


def variance_about(
    chosen: Float[np.ndarray, "photos 3"],
    places: Float[np.ndarray, "fits photos 3"],
    weight: Float[np.ndarray, " fits"],
) -> Float[np.ndarray, "photos 3"]:
    """Return the variance of a mixture of fits about the one that is chosen, without the variance of each by itself."""
    return np.einsum("f,fkx->kx", weight / weight.sum(), (places - chosen) ** 2)


def same_shadows(
    lights: Float[np.ndarray, "photos 3"], size: float, terms: OutlineTerms
) -> Float[np.ndarray, "photos 3"]:
    """Move lights by the homology with m = size times the median of 1 / z, about the foot."""
    foot = np.array([*terms.maps.foot[:2], terms.ground])
    arm, eye = lights - foot, terms.eye - foot
    m = size * float(np.median(1 / arm[:, 2]))
    share = 1 + m * arm[:, 2:]
    moved = (arm + m * arm[:, 2:] * eye) / np.maximum(share, LEAST_SHARE)
    moved[:, 2] = np.maximum(moved[:, 2], LEAST_SHARE * arm[:, 2])
    return foot + moved


def _joint(
    places: Float[np.ndarray, "photos 3"], evidence: Evidence, misfit: float, priors: Priors, like: Flashlights
) -> _Found:
    """Fit from given places near the answer; return the cost of outlines, the fit and the shading's misfit.

    Shading alone places the photos whose outlines are not trusted.
    """
    weighted = _weighted(evidence, misfit)
    return _settled(_held(places, weighted, like)[0], evidence, weighted, priors)


def _settled(start: Flashlights, evidence: Evidence, weighted: Evidence, priors: Priors) -> _Found:
    """Refine a state; weighted: the evidence as its misfit allows. Returns what _joint does."""
    terms = evidence.outlines
    assert terms is not None
    flashlights, weight = refine(start, weighted, priors, free_tangent, FAR[:8] + NEAR)
    misfit = spread(cell_residuals(flashlights, weighted, weight)[weighted.weight > 0])
    return (
        terms.cost(flashlights.positions) if (weight > 0).any() else LOST,
        FlashlightFit(flashlights, _weighted(evidence, misfit), weight, priors, free_tangent),
        misfit,
    )


def _weighted(evidence: Evidence, misfit: float) -> Evidence:
    """Weight all photos' cells as their misfit (log units) and their likeness allow."""
    trust = (NOISE / max(misfit, NOISE)) ** 2 / ALIKE
    return replace(evidence, weight=evidence.weight * trust)


def _trusted(evidence: Evidence, misfit: float) -> Evidence:
    """Weight the cells of those photos that the outlines trust."""
    assert evidence.outlines is not None
    weighted = _weighted(evidence, misfit)
    return replace(weighted, weight=weighted.weight * evidence.outlines.trusted[:, None])


def _held(
    places: Float[np.ndarray, "photos 3"], evidence: Evidence, like: Flashlights | None
) -> tuple[Flashlights, Samples]:
    """Fit beam, aims and powers with the places held; return also the samples' weights.

    Where nothing is known of them yet, aims are looked for.
    """
    n, centre = len(places), evidence.cells.centre
    evidence = replace(evidence, outlines=None)
    if like is not None:
        return refine(replace(like, positions=places), evidence, LOOSE, _places_held, FAR[:2] + NEAR)
    beam = np.r_[START_BEAM, np.zeros(EXTRA_TERMS + RING_TERMS)]
    state = Flashlights(places, np.repeat(centre[None], n, 0), np.zeros(n), beam, 0.02, centre)
    for _ in range(AIM_ROUNDS):
        state, weight = refine(state, evidence, LOOSE, _places_held, FAR[:8] + NEAR)
        state = looked_for_aims(state, evidence, weight)
    return refine(state, evidence, LOOSE, _places_held, FAR[:8] + NEAR)


def _places_held(flashlights: Flashlights) -> Float[np.ndarray, "full reduced"]:
    basis = free_tangent(flashlights)
    n, free = len(flashlights.positions), flashlights.per_flashlight() - 1
    columns = np.arange(basis.shape[1])
    return basis[:, (columns >= free * n) | (columns % free >= 3)]
