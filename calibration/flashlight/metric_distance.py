"""The common distance of all lights, from photos of the side: from each light compared with these alone.

Fitted together, lights have precise directions and ratios of distances, but share an error of distance: a light that is
too near proves space empty that others need, so that they come nearer, too. Compared alone with silhouettes of posed
cameras, each distance is rough and the errors are not shared. So ratios come from the first, and their scale is the
median of the second.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from calibration.flashlight.common_motion import LOOSE
from calibration.flashlight.fit import FAR, NEAR, FlashlightFit
from calibration.flashlight.model import Flashlights, Tangent, across, free_tangent, refine
from calibration.outlines.fit import fit_alone
from calibration.outlines.shadow_start import starts_by_distance
from calibration.posed_camera import PosedCamera

TRIED = (1, 3, 4)  # of shadow_start.DISTANCES
USUAL, SPREAD = 1.1, 0.4  # of the camera's distance; log units: where a hand holds a flashlight
MIDDLE = 0.35  # of the object's size above its foot: what lights are turned about
DROP_ALONE = 30.0  # twice a cost: this shadow agrees with nothing
FEWEST = 5  # lights that tell the scale


def with_metric_distance(
    fit: FlashlightFit, mask: Bool[np.ndarray, "height width"], posed_camera: PosedCamera
) -> FlashlightFit:
    """Return the fit with all distances from the object scaled; unchanged where too few lights tell by how much.

    Args:
        mask: the object, on the pixel grid of the ground field.
    """
    terms = fit.evidence.outlines
    assert terms is not None
    maps = terms.maps
    starts = starts_by_distance(maps, mask, posed_camera)
    if starts is None:
        return fit
    middle = maps.foot + np.array([0.0, 0.0, MIDDLE * maps.size])
    usual = USUAL * float(np.linalg.norm(posed_camera.centre - maps.foot))
    places = fit.flashlights.positions
    logs = []
    for number, photo in enumerate(np.flatnonzero(terms.used)):
        if not terms.trusted[number]:
            continue
        tries = [fit_alone(maps, int(photo), starts[k, photo], terms.eye, terms.ground) for k in TRIED]
        distance = np.log([np.linalg.norm(place - middle) for place, _ in tries])
        cost = np.array([one for _, one in tries]) + ((distance - np.log(usual)) / SPREAD) ** 2
        if cost.min() > DROP_ALONE:
            continue
        weight = np.exp(-0.5 * (cost - cost.min()))
        own = float(np.log(np.linalg.norm(places[number] - middle)))
        logs.append(float((weight * distance).sum() / weight.sum()) - own)
    if len(logs) < FEWEST:
        return fit
    scaled = middle + np.exp(np.median(logs)) * (places - middle)
    flashlights = replace(fit.flashlights, positions=scaled)
    flashlights, weight = refine(flashlights, fit.evidence, LOOSE, _turning(middle), FAR[:8] + NEAR)
    return replace(fit, flashlights=flashlights, weight=weight)


def _turning(middle: Float[np.ndarray, "3"]) -> Tangent:
    """Return a tangent like free_tangent's in which places turn about a point, at their distance from it."""

    def tangent(flashlights: Flashlights) -> Float[np.ndarray, "full reduced"]:
        basis = free_tangent(flashlights)
        own, free = flashlights.per_flashlight(), flashlights.per_flashlight() - 1
        arm = flashlights.positions - middle
        first, second = across(arm / np.linalg.norm(arm, axis=1, keepdims=True))
        for k in range(len(arm)):
            basis[own * k : own * k + 3, free * k : free * k + 3] = np.stack([first[k], second[k], 0 * arm[k]], 1)
        columns = np.arange(basis.shape[1])
        return basis[:, (columns >= free * len(arm)) | (columns % free != 2)]

    return tangent
