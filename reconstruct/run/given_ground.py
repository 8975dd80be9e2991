"""The ground as the user gives it: as the folder says, at a height, or unknown."""

from dataclasses import replace

import numpy as np

from calibration.calibration import Calibration
from capture.errors import CalibrationError

WORDS = ("auto", "unknown")


def check_ground(option: str) -> None:
    """Refuse a --ground that is neither one of WORDS nor a height.

    Raises:
        CalibrationError: naming the option.
    """
    if option not in WORDS:
        _height(option)


def with_ground(calibration: Calibration, option: str, is_known: bool) -> Calibration:
    """The calibration with the ground that `option` asks for.

    Args:
        option: "auto", "unknown", or the world z of the ground.
        is_known: whether there is a ground then; if not, calibration.ground_height is only where the surface is
            assumed, and the result says so.

    Raises:
        CalibrationError: the camera or a light in use is not above the ground.
    """
    if option not in WORDS:
        calibration = replace(calibration, ground_height=_height(option))
        _check_above(calibration, option)
    if is_known:
        return calibration
    away = calibration.world_from_camera.translation[2] - calibration.ground_height
    unit = "" if calibration.unit == "scene" else f" {calibration.unit}"
    note = f"ground: unknown; the surface is assumed to lie about {away:.4g}{unit} below the camera"
    warning = (
        "The ground is unknown: the scale of the result is an assumption, and slow changes of depth over the picture "
        "may be wrong, most of all under distant lights. Give the ground's height with --ground if you can."
    )
    residuals = calibration.residuals
    lists = {key: [*residuals.get(key, []), text] for key, text in (("notes", note), ("warnings", warning))}
    return replace(calibration, residuals=residuals | lists)


def _height(option: str) -> float:
    try:
        height = float(option)
    except ValueError:
        height = np.nan
    if not np.isfinite(height):
        raise CalibrationError(
            f"--ground {option} is no height; auto, unknown, or the world z of the ground was needed."
        )
    return height


def _check_above(calibration: Calibration, option: str) -> None:
    eye = float(calibration.world_from_camera.translation[2])
    used = [light for light in calibration.lights if light.used and light.position is not None]
    lights = [(float(np.asarray(light.position)[2]), f"the light of {light.photo}") for light in used]
    lowest, name = min([(eye, "the camera"), *lights])
    if lowest <= float(option):
        raise CalibrationError(
            f"--ground {option}: {name} stands at z = {lowest:.4g}, above the ground was needed. Give a lower one."
        )
