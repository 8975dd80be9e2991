"""Turn fitted flashlights into lights with power in colour, a realistic uncertainty and a verdict per photo.

The stated error of a light that was found by the ground's shading is made of lengths that its own photo and the fit
show:

- ground: the formal error of the fit, of as many independent numbers as a photo's ground tells: what the model lacks is
  smooth over the ground, so that neighbouring cells err alike;
- power: a flashlight has one power. Where the fitted powers differ, distances are wrong instead: light falls with the
  distance squared, so half of a light's own log power, and of the spread of all, is a share of its distance. A photo
  that was exposed otherwise counts only up to where the fit takes it for one;
- starts: fits from other starts that explain a few cells about as well lie elsewhere (fit.FirstFits);
- what no residual shows: a small share of the distance.

The error of the camera's pose is added in calibration.calibrate.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from calibration.flashlight.beam_profile import without_splines
from calibration.flashlight.descent import refine
from calibration.flashlight.duplicates import earlier_duplicate
from calibration.flashlight.fit import (
    DROP_RESIDUAL,
    GLOSS_ANGLE,
    LAST,
    LOOSE_POWER,
    OVAL_PHOTOS,
    FlashlightFit,
    alike,
    before_ends,
    collect,
    first_fits,
    fit_flashlights,
    half_angles,
    least_share,
    photo_quality,
    with_oval_beams,
    without_gloss,
)
from calibration.flashlight.model import NOISE, cosines, free_tangent
from calibration.flashlight.outline_lights import OUTLINE_SIDE, outline_sigma, with_outlines
from calibration.flashlight.pictured import as_pictured, with_response
from calibration.light import Light, Vector
from calibration.lights import hand
from calibration.lights.ground_cells import ground_ends
from calibration.outlines.metric_cues import NO_CUES, MetricCues
from calibration.outlines.terms import DROP_OUTLINE
from calibration.posed_camera import PosedCamera
from capture.checks.mixture import STEADY, levels
from capture.checks.robust import spread
from capture.photos.photo import PhotoStack

LOG = logging.getLogger(__name__)
OTHER_POWER = 3.0  # factor between one flashlight's power in two photos
POWER_SIGMAS = 6.0  # or in how much the other photos differ, where they do not tell their exposure
SURE_SIGMA = 0.06 / 1.61  # of the range: 95 % of errors in space are below 1.61 sigma (chi, 3), and a shape bears 6 %
LARGEST_SIGMA = 0.25  # of the range, of a light that is used: the solver's shadow rays take over from there
FEWEST_USED = 2 / 3  # of the photos that shading alone must place
BY_SHADING = "lights: placed by how bright the ground is, and by nothing else"
BY_OUTLINES = (
    "lights: placed by the outlines of shadows and object together with how bright the ground is, which alone leaves "
    "them uncertain; photos in light/, or RAW photos, make them exact"
)
BY_CUES = (
    "lights: placed by the outlines of shadows and object together with how bright the ground is; how far away they "
    "all are, by {}"
)
AMBIGUOUS = 0.1  # of a light's distance, between fits that are about as likely: the user is told
BY_SEVERAL = (
    ". Several placements of the lights explain these photos about as well; they lie {:.0%} of its distance about "
    "the one that was taken. A photo from the side, the object's height, or photos in light/ decide between them"
)
HONEST_SHARE = 0.0035  # of the range: what no residual shows
FEW_SHARE = 0.02  # of the range, with too few photos to see whether the beam is round: as 2 % of asymmetry costs
COLOUR_STEPS = LAST[:4]  # the channels differ from their mean by a few per cent: few steps suffice


@dataclass(frozen=True)
class LightFit:
    """The lights of the examined photos, in their order, and their shared parameters."""

    lights: tuple[Light, ...]
    beam: tuple[float, ...]  # see calibration.light.beam_gain
    ambient: Vector  # irradiance, in the unit of power / distance^2
    residuals: dict[str, Any] = field(default_factory=dict)


def describe(
    fit: FlashlightFit,
    names: list[str],
    floor: Float[np.ndarray, " photos"],
    sigma: Float[np.ndarray, "photos 3"],
    judged: Float[np.ndarray, "photos 3"],
) -> LightFit:
    """Return the lights of a fit.

    Powers and beam are those by which the pictures show the ground, bent as they are, on any common scale. The
    flashlight is taken as white over the session; a colour difference of one photo is a difference of its power.

    Args:
        floor: position error that no residual shows, in all three coordinates together.
        sigma: of the positions, as residuals show it.
        judged: of the positions, by which a light is used or not.
    """
    pictured = as_pictured(fit)
    power, ambient = _colour(pictured)
    off_axis = cosines(pictured.flashlights, pictured.evidence)
    beam, lack = without_splines(pictured.flashlights.beam, off_axis, pictured.weight, pictured.priors.beam)
    power = power * np.exp(lack)
    axes = pictured.flashlights.axes()
    reasons = _verdicts(fit, judged, names)
    honest = np.sqrt(sigma**2 + floor[:, None] ** 2 / 3)
    lights = tuple(
        Light(
            name,
            "point",
            position=fit.flashlights.positions[k].copy(),
            power=power[k],
            axis=axes[k],
            sigma=honest[k],
            used=not reasons[k],
            reason=reasons[k],
        )
        for k, name in enumerate(names)
    )
    return LightFit(lights, beam, ambient, _residuals(fit, names, sigma))


def _colour(fit: FlashlightFit) -> tuple[Float[np.ndarray, "photos 3"], Vector]:
    """Power per photo and channel, and ambient irradiance: the grey fit repeated per channel with fixed geometry."""
    cells = fit.evidence.cells
    n, own, terms = len(fit.flashlights.positions), fit.flashlights.per_flashlight(), len(fit.flashlights.beam)
    vary = [*(own * k + 6 for k in range(n)), own * n + terms]  # powers and ambient light
    held = np.eye(own * n + fit.flashlights.shared())[:, vary]
    powers, ambients = [], []
    for channel in range(3):
        evidence = replace(fit.evidence, log_grey=np.log(np.maximum(cells.rgb[..., channel], 1e-9)))
        flashlights = refine(fit.flashlights, evidence, LOOSE_POWER, lambda _: held, COLOUR_STEPS)[0]
        # into albedo: the session's flashlight is white
        shift = np.mean(flashlights.log_power - fit.flashlights.log_power)
        powers.append(np.exp(flashlights.log_power - shift))
        ambients.append(flashlights.ambient * np.exp(-shift))
    return np.stack(powers, -1) * hand.USUAL**2, np.array(ambients)


def _verdicts(fit: FlashlightFit, sigma: Float[np.ndarray, "photos 3"], names: list[str]) -> list[str]:
    """Return why each photo's light cannot be used; empty if it can."""
    flashlights, cells = fit.flashlights, fit.evidence.cells
    residual, share = photo_quality(fit)
    reach = np.linalg.norm(flashlights.positions - cells.centre, axis=1)
    size = np.linalg.norm(sigma, axis=1) / reach
    outlines = fit.evidence.outlines
    contradiction = np.zeros(len(reach)) if outlines is None else outlines.misfit(flashlights.positions)
    height = flashlights.positions[:, 2] - fit.evidence.height
    brighter = flashlights.log_power - np.median(flashlights.log_power)
    too_bright = max(np.log(OTHER_POWER), POWER_SIGMAS * spread(brighter))
    reasons, duplicate = [], earlier_duplicate(fit.evidence)
    for k in range(len(reach)):
        why = []
        if duplicate[k] != k:
            why.append(f"the ground is lit as in {names[duplicate[k]]}: a copy of it, or the flashlight was not moved")
        if residual[k] > DROP_RESIDUAL:
            why.append(f"the ground's shading misfits {residual[k]:.1f} times as much as usual (limit {DROP_RESIDUAL})")
        if share[k] < least_share(share):
            why.append(
                f"only {share[k]:.0%} of the ground is lit as by one flashlight (limit {least_share(share):.0%})"
            )
        if height[k] < hand.LOWEST:
            why.append(f"the light would be {height[k]:.0f} mm above the ground (limit {hand.LOWEST:.0f} mm)")
        if max(hand.NEAREST - reach[k], reach[k] - hand.FARTHEST) > size[k] * reach[k]:
            why.append(
                f"the light would be {reach[k]:.0f} mm from the middle of the photo: a hand holds it "
                f"{hand.NEAREST:.0f} to {hand.FARTHEST:.0f} mm away. Check the size of the board's squares"
            )
        if size[k] > LARGEST_SIGMA:
            why.append(f"its place is uncertain by {size[k]:.0%} of its distance (limit {LARGEST_SIGMA:.0%})")
        if abs(brighter[k]) > too_bright:
            why.append(
                f"from there its flashlight would be {np.exp(brighter[k]):.2g} times as strong as in the other photos "
                f"(limit {np.exp(too_bright):.2g})"
            )
        if contradiction[k] > DROP_OUTLINE:
            why.append(
                f"its shadow contradicts the other photos' by {contradiction[k]:.1f} px of a picture of "
                f"{OUTLINE_SIDE} px (limit {DROP_OUTLINE})"
            )
        reasons.append("; ".join(why))
    return reasons


def _residuals(fit: FlashlightFit, names: list[str], sigma: Float[np.ndarray, "photos 3"]) -> dict[str, Any]:
    """Return numbers for the report: relative residuals, overall and per photo, and the shared parameters."""
    residual = fit.residual()
    voting = fit.weight > 0
    relative, share = photo_quality(fit)
    angle = half_angles(fit.flashlights, fit.evidence.cells)
    mirrored = voting & (angle < GLOSS_ANGLE)
    return {
        "shading_rms": float(np.sqrt(np.average(residual**2, weights=fit.weight))),
        "shading_rms_by_photo": {
            name: float(np.sqrt(np.average(residual[k] ** 2, weights=np.maximum(fit.weight[k], 1e-12))))
            for k, name in enumerate(names)
        },
        "relative_misfit_by_photo": {name: float(relative[k]) for k, name in enumerate(names)},
        "ground_share_by_photo": {name: float(share[k]) for k, name in enumerate(names)},
        "position_sigma_by_photo": {name: float(np.linalg.norm(sigma[k])) for k, name in enumerate(names)},
        "beam_asymmetry": 0.0
        if fit.flashlights.oval is None
        else float(np.linalg.norm(fit.flashlights.oval, axis=1).mean()),
        "power_spread": spread(fit.flashlights.log_power - np.median(fit.flashlights.log_power)),
        "ambient_share": float(fit.flashlights.ambient / np.exp(fit.flashlights.log_power).mean()),
        "ground_cells": fit.ground(),
        "gloss": float(np.median(residual[mirrored])) if mirrored.any() else 0.0,
    }


def surely_placed(found: LightFit, centre: Float[np.ndarray, "3"]) -> float:
    """Return the share of lights that are used and whose stated error stays below SURE_SIGMA of their distance.

    A flashlight has one power. Powers that differ by tens of per cent, or a tone curve in doubt, contradict the shading
    of all photos, however well each photo's own is fitted.
    """
    sigma = np.array([np.linalg.norm(light.sigma) for light in found.lights])
    reach = np.linalg.norm([light.homogeneous()[:3] - centre for light in found.lights], axis=1)
    return float(np.mean(np.array([light.used for light in found.lights]) & (sigma < SURE_SIGMA * reach)))


def position_sigma(fit: FlashlightFit) -> Float[np.ndarray, "photos 3"]:
    """Return one sigma per coordinate of the positions, world: of the fit itself, and between fits from other starts.

    Samples are weighted by the residuals' spread and by how many cells err together [Kish, Survey Sampling (1965),
    section 5.4].
    """
    known = fit.weight > 0
    noise = max(spread((np.sqrt(fit.evidence.weight) * fit.residual())[known]), NOISE)
    return np.sqrt(fit.variance(1 / (noise**2 * alike(fit.weight))))


def unseen_error(fit: FlashlightFit) -> Float[np.ndarray, " photos"]:
    """Return the position error (world unit) that no residual of positions from shading alone shows."""
    reach = np.linalg.norm(fit.flashlights.positions - fit.evidence.cells.centre, axis=1)
    own = fit.flashlights.log_power - levels(fit.flashlights.log_power, STEADY)
    by_power = 0.5 * np.hypot(np.minimum(np.abs(own), fit.priors.power_outlier), spread(own))
    return np.hypot(HONEST_SHARE if len(reach) >= OVAL_PHOTOS else FEW_SHARE, by_power) * reach


def told_doubt(fit: FlashlightFit) -> str:
    """Return what to add to the sentence about the lights where fits that are about as likely lie far apart, or ""."""
    reach = np.linalg.norm(fit.flashlights.positions - fit.evidence.cells.centre, axis=1)
    between = np.broadcast_to(fit.between, fit.flashlights.positions.shape)
    apart = float(np.median(np.sqrt(between.sum(1)) / reach))
    return BY_SEVERAL.format(apart) if apart > AMBIGUOUS else ""


def locate_lights(
    stack: PhotoStack,
    posed_camera: PosedCamera,
    usable: Bool[np.ndarray, " photos"],
    cues: MetricCues = NO_CUES,
    is_spoilt: Callable[[LightFit], bool] = lambda _: False,
) -> LightFit:
    """Estimate one point light per usable photo (world), with the beam and the ambient light they share.

    Only camera and ground are known. Steps: mean colour of ground cells, fits of a few of them from several
    starts, then a robust fit of all flashlights together, with the pictures' response and rings in the beam where the
    photos ask for them. The object and its shadows are rejected as outliers, and what
    lies beyond the ground's end is left out. Where that places too few lights, outlines of shadows and shading are
    fitted together.

    Args:
        stack: one fixed camera, relative exposure divided out.
        posed_camera: of the full-size photo.
        usable: photos to use; the others get no light.
        cues: what fixes the scale of lights from outlines.
        is_spoilt: whether the lights by shading tell that photos have to go: then outlines, which cost most, wait.

    Raises:
        CalibrationError: fewer than 4 photos or lights, or too little bare ground in view.
    """
    LOG.info("reading the ground's light in %d photos", usable.sum())
    evidence, photos = collect(stack, posed_camera, usable)
    edges = ground_ends(stack, posed_camera, usable)
    evidence = before_ends(evidence, edges)
    LOG.info("fitting the lights to the ground's shading")
    first = first_fits(evidence)
    plain = with_oval_beams(without_gloss(fit_flashlights(first.best(), evidence, free_tangent)), evidence)
    fit = with_response(first, replace(plain, between=first.variance_about(plain.flashlights.positions)), evidence)
    names = [stack.paths[k].name for k in photos]
    sigma = position_sigma(fit)
    found = describe(fit, names, unseen_error(fit), sigma, sigma)
    found = replace(found, residuals=found.residuals | {"cue": BY_SHADING})
    if surely_placed(found, evidence.cells.centre) >= FEWEST_USED or is_spoilt(found):
        return found
    joint = with_outlines(evidence, stack, posed_camera, usable, fit.flashlights, edges, cues)
    if joint is None:
        return found
    sigma = outline_sigma(joint)
    # lights whose shadows contradict the others' tell how often outlines mislead, also where nothing contradicts
    agree = np.mean([not reason for reason in _verdicts(joint, sigma, names)])
    other = describe(joint, names, np.zeros(len(names)), sigma / max(agree, 1 / len(names)), sigma)
    by_outlines, by_shading = (np.mean([light.used for light in one.lights]) for one in (other, found))
    if by_outlines < min(FEWEST_USED, by_shading):
        return found
    cue = (BY_CUES.format(cues.sentence()) if cues else BY_OUTLINES) + told_doubt(joint)
    return replace(other, residuals=other.residuals | {"cue": cue})
