"""How far off the places of flashlights may be that were found by the ground's shading, light by light.

The stated error of a light is made of lengths that its own photo and the fit show:

- noise: the formal error of the fit;
- ground: the delete-a-group jackknife over the four quadrants of the ground. It sees errors that are smooth over the
  ground, such as a beam that the model does not have; the formal error takes these for information;
- power: a flashlight has one power. Where the fitted powers differ, distances are wrong instead: light falls with the
  distance squared, so half of a light's own log power, and of the spread of all, is a share of its distance. A photo
  that was exposed otherwise counts only up to where the fit takes it for one;
- beam: a beam may have a hot centre and rings, which a smooth one cannot follow: it moves all lights together, and each
  photo's residuals stay small. How far the lights move when the beam gets splines tells. Counted where the shading of
  most photos places no light surely; elsewhere the beam is smooth, as the other errors show;
- starts: fits from other starts that explain a few cells about as well lie elsewhere (fit.FirstFits);
- what no residual shows: a small share of the distance.

The error of the camera's pose is added in calibration.calibrate, that of the tone curve by calibration.flashlight.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.sparse import csr_array

from calibration.flashlight.beam_profile import RING_TERMS
from calibration.flashlight.descent import refine
from calibration.flashlight.fit import FAR, LAST, NEAR, OVAL_PHOTOS, FlashlightFit
from calibration.flashlight.model import NOISE, normal_equations
from capture.checks.mixture import STEADY, levels
from capture.checks.robust import spread

QUADRANTS = 4
SPENT_PHOTOS = 3  # that the albedo of the ground and what all beams share take up: few photos hide their own errors
DOUBTFUL = 1.5  # times the spread over the quadrants, in the verdict whether a light is used
BEAM_STEPS = 2.0  # errors of lights over how far splines move them, on rendered captures: 1.3 to 2
HONEST_SHARE = 0.0035  # of the range: what no residual shows
FEW_SHARE = 0.02  # of the range, with too few photos to see whether the beam is round: as 2 % of asymmetry costs


def position_sigma(fit: FlashlightFit) -> tuple[Float[np.ndarray, "photos 3"], Float[np.ndarray, "photos 3"]]:
    """Return one sigma per coordinate by noise and ground, and a wider one, by which lights are used or not; world."""
    n, own = len(fit.flashlights.positions), fit.flashlights.per_flashlight()
    matrix, _ = normal_equations(fit.flashlights, fit.evidence, fit.weight, fit.priors)
    basis = csr_array(fit.tangent(fit.flashlights))
    known = fit.weight > 0
    noise = spread((np.sqrt(fit.evidence.weight) * fit.residual())[known])
    reduced = basis.T @ matrix @ basis
    covariance = basis @ np.linalg.pinv(reduced, hermitian=True) @ basis.T * max(noise, NOISE) ** 2
    formal = np.maximum(np.diag(covariance)[: own * n].reshape(n, own)[:, :3], 0)
    jackknife = n / max(n - SPENT_PHOTOS, 1) * _between_quadrants(fit)
    return np.sqrt(formal + jackknife), np.sqrt(formal + DOUBTFUL**2 * jackknife)


def _between_quadrants(fit: FlashlightFit) -> Float[np.ndarray, "photos 3"]:
    """Return the jackknife's variance of the positions [Efron and Stein, The Jackknife Estimate of Variance (1981)]."""
    offset = fit.evidence.cells.points - fit.evidence.cells.centre
    quadrant = 2 * (offset[:, 0] > 0) + (offset[:, 1] > 0)
    moved = []
    for q in range(QUADRANTS):
        evidence = replace(fit.evidence, weight=fit.evidence.weight * (quadrant != q))
        moved.append(refine(fit.flashlights, evidence, fit.priors, fit.tangent, LAST[:5])[0].positions)
    return (QUADRANTS - 1) / QUADRANTS * ((np.stack(moved) - np.mean(moved, axis=0)) ** 2).sum(0)


def unseen_error(fit: FlashlightFit) -> Float[np.ndarray, " photos"]:
    """Return the position error (world unit) that no residual of positions from shading alone shows."""
    reach = np.linalg.norm(fit.flashlights.positions - fit.evidence.cells.centre, axis=1)
    own = fit.flashlights.log_power - levels(fit.flashlights.log_power, STEADY)
    by_power = 0.5 * np.hypot(np.minimum(np.abs(own), fit.priors.power_outlier), spread(own))
    return np.hypot(HONEST_SHARE if len(reach) >= OVAL_PHOTOS else FEW_SHARE, by_power) * reach


def beam_error(fit: FlashlightFit) -> Float[np.ndarray, " photos"]:
    """Return the position error (world unit) of a smooth beam's fit if the beam has a hot centre and rings."""
    beam = np.r_[fit.flashlights.beam, np.zeros(RING_TERMS)]
    start = replace(fit.flashlights, beam=beam)
    found, _ = refine(start, fit.evidence, fit.priors, fit.tangent, FAR[:8] + NEAR)
    return BEAM_STEPS * np.linalg.norm(found.positions - fit.flashlights.positions, axis=1)
