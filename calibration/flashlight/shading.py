"""Where the flashlight was in each photo, from the shading of the bare ground alone."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool

from calibration.camera import Camera
from calibration.flashlight.lamp_fit import (
    collect,
    first_guess,
    fit_lamps,
    refit_strays,
    with_oval_beams,
    without_gloss,
)
from calibration.flashlight.lamp_model import free_tangent
from calibration.flashlight.light_estimate import LightFit, describe, honest_share
from calibration.flashlight.tone_curve import compare_curves
from calibration.pose import Pose
from capture.photos.photo import PhotoStack


def locate_lights(
    stack: PhotoStack,
    camera: Camera,
    world_from_camera: Pose,
    usable: Bool[np.ndarray, "photos"],
    ground_height: float = 0.0,
) -> LightFit:
    """One point light per usable photo, with the beam and the ambient light they share.

    Nothing is known beforehand but camera and ground. Steps: mean colour of ground cells, a search over a hemisphere of
    lamps, then a robust fit of all lamps together. The object and its shadows lose their votes.

    Args:
        stack: one fixed camera, relative exposure divided out.
        camera: of the full-size photo.
        usable: photos to look at; the others get no light.

    Raises:
        CalibrationError: fewer than 4 photos or lights, or too little bare ground in view.
    """
    evidence, photos = collect(stack, camera, world_from_camera, usable, ground_height)
    fit = without_gloss(fit_lamps(first_guess(evidence), evidence, free_tangent))
    fit = with_oval_beams(refit_strays(fit), evidence)
    tone = compare_curves(fit, np.array(stack.gains)[photos])
    found = describe(fit, [stack.paths[k].name for k in photos], np.hypot(honest_share(fit), tone.error()))
    return replace(found, residuals=found.residuals | {"tone": tone.document()})
