"""How far off the places of flashlights may be that were found by the ground's shading, light by light.

The stated error of a light is made of lengths that its own photo and the fit show:

- ground: the formal error of the fit, of as many independent numbers as a photo's ground tells: what the model lacks is
  smooth over the ground, so that neighbouring cells err alike;
- power: a flashlight has one power. Where the fitted powers differ, distances are wrong instead: light falls with the
  distance squared, so half of a light's own log power, and of the spread of all, is a share of its distance. A photo
  that was exposed otherwise counts only up to where the fit takes it for one;
- starts: fits from other starts that explain a few cells about as well lie elsewhere (fit.FirstFits);
- what no residual shows: a small share of the distance.

The error of the camera's pose is added in calibration.calibrate.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.sparse import csr_array

from calibration.flashlight.fit import OVAL_PHOTOS, FlashlightFit, alike
from calibration.flashlight.model import NOISE, normal_equations
from capture.checks.mixture import STEADY, levels
from capture.checks.robust import spread

HONEST_SHARE = 0.0035  # of the range: what no residual shows
FEW_SHARE = 0.02  # of the range, with too few photos to see whether the beam is round: as 2 % of asymmetry costs


def position_sigma(fit: FlashlightFit) -> Float[np.ndarray, "photos 3"]:
    """Return one sigma per coordinate of the positions, world: of the fit itself, and between fits from other starts.

    The inverse of the normal matrix with priors, its samples weighted by the residuals' spread and by how many cells
    err together [Kish, Survey Sampling (1965), section 5.4].
    """
    n, own = len(fit.flashlights.positions), fit.flashlights.per_flashlight()
    known = fit.weight > 0
    noise = max(spread((np.sqrt(fit.evidence.weight) * fit.residual())[known]), NOISE)
    trust = 1 / (noise**2 * alike(fit.weight))
    evidence = replace(fit.evidence, weight=trust * fit.evidence.weight)
    matrix, _ = normal_equations(fit.flashlights, evidence, trust * fit.weight, fit.priors)
    basis = csr_array(fit.tangent(fit.flashlights))
    covariance = basis @ np.linalg.pinv(basis.T @ matrix @ basis, hermitian=True) @ basis.T
    variance = np.diag(covariance)[: own * n].reshape(n, own)[:, :3]
    return np.sqrt(np.maximum(variance, 0) + fit.between)


def unseen_error(fit: FlashlightFit) -> Float[np.ndarray, " photos"]:
    """Return the position error (world unit) that no residual of positions from shading alone shows."""
    reach = np.linalg.norm(fit.flashlights.positions - fit.evidence.cells.centre, axis=1)
    own = fit.flashlights.log_power - levels(fit.flashlights.log_power, STEADY)
    by_power = 0.5 * np.hypot(np.minimum(np.abs(own), fit.priors.power_outlier), spread(own))
    return np.hypot(HONEST_SHARE if len(reach) >= OVAL_PHOTOS else FEW_SHARE, by_power) * reach
