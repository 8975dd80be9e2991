"""Lights that a phone of known pose carries: the LED's offset from its lens, by the outlines of shadows.

Outlines do not depend on brightness, so tone curve and beam do not mislead them.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from calibration.outlines.terms import OutlineTerms
from calibration.pose import Pose

USUAL_MM = np.array([18.0, 18.0, 5.0])  # one sigma of the offset before a photo was seen: on the same back
BLURS = (8.0, 5.0, 3.0, 2.0, 1.4, 1.0, 1.0)  # factors of an outline's sigma, one after the other
STEPS = 6  # with each
HONEST = 1.7  # errors over formal sigmas: outlines of one series err alike, and three numbers answer for all of them
ROUGH_MM = 2.0  # between small minima of the outlines' cost


def offset_by_outlines(
    terms: OutlineTerms, poses: Sequence[Pose | None], places: Float[np.ndarray, "photos 3"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Return the LED's offset in the lens's camera frame and its covariance, mm.

    The phones' poses are known, so all lights together have three free numbers. Least squares (Levenberg and
    Marquardt) over the outlines' residuals, whose sigma falls to its own [graduated non-convexity, Blake and Zisserman,
    Visual Reconstruction (1987)]: dr/d(offset) = sum over photos of dr/d(light) R, R the phone's rotation.

    Args:
        terms: the outlines of these photos, of which those without a pose are not trusted.
        poses: world_from_phone per photo, mm.
        places: the lights of photos without a pose, world; the others are not read.
    """
    turns = np.array([np.zeros((3, 3)) if pose is None else pose.rotation for pose in poses])

    def lights(offset: Float[np.ndarray, "3"]) -> Float[np.ndarray, "photos 3"]:
        known = zip(poses, places, strict=True)
        return np.array([place if pose is None else pose.apply(offset) for pose, place in known])

    offset, system = np.zeros(3), np.eye(3)
    for blur in BLURS:
        blurred, damping = replace(terms, blur=blur), 1e-3
        for _ in range(STEPS):
            value, slopes = blurred.rows(lights(offset))
            by_offset = np.einsum("rki,kij->rj", slopes, turns)
            system = by_offset.T @ by_offset + np.diag(USUAL_MM**-2.0)
            uphill = by_offset.T @ value + offset / USUAL_MM**2
            before = _cost(blurred, lights(offset), offset)
            for _ in range(STEPS):
                trial = offset - np.linalg.solve(system + damping * np.diag(np.diag(system)), uphill)
                if _cost(blurred, lights(trial), trial) <= before:
                    offset, damping = trial, damping / 8
                    break
                damping *= 4
    return offset, HONEST**2 * np.linalg.inv(system) + ROUGH_MM**2 * np.eye(3)


def _cost(terms: OutlineTerms, lights: Float[np.ndarray, "photos 3"], offset: Float[np.ndarray, "3"]) -> float:
    return terms.cost(lights) + 0.5 * float(((offset / USUAL_MM) ** 2).sum())
