"""The calibration of a source: found from its photos, or given."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from calibration.calibrate import WAYS, calibrate
from calibration.calibrate_with_file import calibrate_with_file, scene_with_file
from calibration.calibration import Calibration
from capture.errors import CalibrationError
from reconstruct.source.memory import keep_spread
from reconstruct.source.options import RunOptions, ground_option
from reconstruct.source.photos import Photos
from reconstruct.source.source import Source


def calibrate_source(source: Source, photos: Photos, options: RunOptions) -> Calibration:
    """Return a scene's given calibration, or calibrate the photos, with the lights from a file if --lights names one.

    Photos beyond what fits into memory (`photos.plan`) are marked as not used.

    Raises:
        CalibrationError, CaptureError: the board, the ground or the lights cannot be found, or the file lacks a light.
    """
    calibration = _calibrated(source, photos, options)
    has_scale = source.scale(options) is not None
    calibration = with_ground(calibration, options.ground, source.ground_is_known(options), has_scale)
    calibration = with_light_error(calibration, options.light_error)
    return calibration if photos.plan is None else keep_spread(calibration, photos.plan.photos)


def with_light_error(calibration: Calibration, relative: float) -> Calibration:
    """Return the calibration with each light's uncertainty, in any direction, raised to at least `relative`.

    `relative` is a fraction of the light's distance from the point where the camera looks at the ground, or radians
    for a directional light.
    """
    if relative == 0:
        return calibration
    middle, lights = calibration.posed_camera.looked_at(), []
    for light in calibration.lights:
        distance = 1.0 if light.position is None else float(np.linalg.norm(light.position - middle))
        lights.append(replace(light, sigma=np.maximum(light.sigma, relative * distance / np.sqrt(3))))
    return replace(calibration, lights=tuple(lights))


def _calibrated(source: Source, photos: Photos, options: RunOptions) -> Calibration:
    if source.known is not None:
        if options.lights in WAYS or source.known.lights_from == Path(options.lights):
            return source.known.with_notes()
        return scene_with_file(source.known, photos.stack, Path(options.lights))
    assert source.session is not None and photos.stack is not None
    if options.lights in WAYS:
        return calibrate(source.session, photos.stack, options.board, options.lights, photos.findings)
    named = (Path(options.lights), options.board)
    return calibrate_with_file(source.session, photos.stack, *named, photos.findings)


def with_ground(calibration: Calibration, option: str, is_known: bool, has_scale: bool = False) -> Calibration:
    """Return the calibration with the ground that `option` asks for.

    Args:
        option: "auto", "unknown", or the world z of the ground.
        is_known: True if there is a ground then; if not, calibration.ground_height is only the assumed height of
            the surface, and the result states this.
        has_scale: one length of the object is known.

    Raises:
        CalibrationError: the camera or a light in use is not above the ground.
    """
    height = ground_option(option)
    if height is not None:
        calibration = replace(calibration, ground_height=height)
        _check_above(calibration, option)
    if is_known:
        return calibration
    away = calibration.world_from_camera.translation[2] - calibration.ground_height
    unit = "" if calibration.unit == "scene" else f" {calibration.unit}"
    note = f"ground: unknown; the surface is assumed to lie about {away:.4g}{unit} below the camera"
    warning = (
        f"The ground is unknown: {'' if has_scale else 'the scale of the result is an assumption, and '}slow changes "
        "of depth over the picture may be wrong, most of all under distant lights. Give the ground's height with "
        "--ground if you can."
    )
    residuals = calibration.residuals
    lists = {key: [*residuals.get(key, []), text] for key, text in (("notes", note), ("warnings", warning))}
    return replace(calibration, residuals=residuals | lists)


def _check_above(calibration: Calibration, option: str) -> None:
    eye = float(calibration.world_from_camera.translation[2])
    used = [light for light in calibration.lights if light.used and light.position is not None]
    lights = [(float(np.asarray(light.position)[2]), f"the light of {light.photo}") for light in used]
    lowest, name = min([(eye, "the camera"), *lights])
    if lowest <= float(option):
        raise CalibrationError(
            f"--ground {option}: {name} stands at z = {lowest:.4g}, above the ground was needed. Give a lower one."
        )
