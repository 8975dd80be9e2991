"""Estimate the power of lights with known places from ground of unknown albedo; define the albedo scale."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from calibration.calibration import Calibration
from calibration.light import Light, irradiance
from calibration.lights.ground_cells import GroundCells, sample_ground
from calibration.lights.known_ground import (
    GROUND_LIT_QUANTILE,
    GROUND_SPREAD,
    LONG_SIDE,
    albedo_by_photo,
    spread_between_photos,
)
from calibration.posed_camera import PosedCamera
from capture.checks.robust import column_quantile
from capture.errors import CalibrationError
from capture.photos.photo import PhotoStack, reduced

LIT_QUANTILE = 0.6  # over photos: of a cell's brightness over its irradiance, above shadows and below highlights
ROUNDS = 4  # of albedo and power in turn: medians settle at once
BRIGHTEST_ALBEDO, BRIGHT_SHARE = 0.9, 99.0  # the albedo scale of CONVENTIONS.md, per cent
FACING_QUANTILE = 0.75  # over photos: of an object pixel, those whose light it faces
SHADING_MISFIT = 0.2  # median of |log brightness - log model|: right lights leave 0.05, the lights of other photos 0.4


@dataclass(frozen=True)
class PoweredLights:
    """The lights with power, and their misfit to the ground's shading (log, median)."""

    lights: tuple[Light, ...]
    misfit: float

    def warning(self) -> str:
        """Return a warning for the user; empty if the shading agrees."""
        if self.misfit < SHADING_MISFIT:
            return ""
        return (
            f"the ground's shading differs by {self.misfit:.0%} from that of the given lights (below "
            f"{SHADING_MISFIT:.0%} is usual): check that they are in the photos' order and in the right axes"
        )


def on_albedo_scale(calibration: Calibration, stack: PhotoStack) -> Calibration:
    """Return the calibration with powers and ambient light on the albedo scale of CONVENTIONS.md.

    The lights that are used tell it; without any the calibration stays as it is.

    Raises:
        CalibrationError: as with_common_power.
    """
    used = tuple(light for light in calibration.lights if light.used)
    if not used:
        return calibration
    scale = _power_scale(replace(calibration, lights=used), reduced(stack, LONG_SIDE))
    lights = tuple(replace(light, power=scale * light.power) for light in calibration.lights)
    return replace(calibration, lights=lights, ambient=scale * calibration.ambient)


def with_common_power(calibration: Calibration, stack: PhotoStack) -> Calibration:
    """Return the calibration with powers in the given proportions, on the albedo scale of CONVENTIONS.md.

    Raises:
        CalibrationError: no pixel sees the ground under any light.
    """
    scale = _power_scale(calibration, stack)
    return replace(calibration, lights=tuple(replace(light, power=scale * light.power) for light in calibration.lights))


def _power_scale(calibration: Calibration, stack: PhotoStack) -> float:
    """Return the factor that multiplies power so that the brightest 1 % of ground and object has albedo 0.9.

    Only the product of albedo and power is observed, so one of them is a choice, stated in CONVENTIONS.md and made only
    here. An object's pixel has the albedo of a surface that faces its lights, in the upper quarter of the photos.

    Raises:
        CalibrationError: no pixel sees the ground under any light.
    """
    ground, facing = albedo_by_photo(stack, calibration)
    if not ground.size:
        raise CalibrationError(
            f"no pixel shows the ground (z = {calibration.ground_height:g}) under any light; some were needed. Check "
            "camera, ground and lights in the scene's files."
        )
    albedo = np.where(
        spread_between_photos(ground) < GROUND_SPREAD,
        column_quantile(ground, GROUND_LIT_QUANTILE),
        column_quantile(facing, FACING_QUANTILE),
    )
    return max(float(np.nanpercentile(albedo, BRIGHT_SHARE)) / BRIGHTEST_ALBEDO, 1e-12)


def with_power_per_photo(
    lights: Sequence[Light], stack: PhotoStack, posed_camera: PosedCamera, usable: Bool[np.ndarray, " photos"]
) -> PoweredLights:
    """Return the lights with power per photo and colour, on any common scale.

    pixel = albedo(cell) power(photo) E(photo, cell), E the irradiance of power 1 on level ground; several lights of one
    photo share its power. Fitted in logarithms by alternating medians over cells and quantiles over photos, which
    reject shadows.

    Args:
        lights: one or several for each photo of the stack, by its name.

    Raises:
        CalibrationError: too little ground in view.
    """
    photos = np.flatnonzero(usable)
    cells = sample_ground(stack, posed_camera, photos)
    names = [stack.paths[k].name for k in photos]
    unit = np.stack([_unit_irradiance([x for x in lights if x.photo == name], cells) for name in names])
    powers, misfits = [], []
    for channel in range(3):
        bright = np.maximum(cells.rgb[..., channel], 1e-9)
        ratio = np.where(cells.usable & (unit > 0), np.log(bright / np.maximum(unit, 1e-12)), np.nan)
        power, misfit = _split(ratio)
        powers.append(power)
        misfits.append(misfit)
    common = [float(np.mean(power)) for power in powers]  # the session's light is white: its colour goes to the albedo
    power = np.exp(np.stack([p - c for p, c in zip(powers, common, strict=True)], -1))
    by_name = dict(zip(names, power, strict=True))
    dark = np.zeros(3)
    return PoweredLights(
        tuple(replace(light, power=by_name.get(light.photo, dark)) for light in lights), float(np.mean(misfits))
    )


def _unit_irradiance(lights: Sequence[Light], cells: GroundCells) -> Float[np.ndarray, " cells"]:
    up = np.broadcast_to([0.0, 0.0, 1.0], cells.points.shape)
    each = [irradiance(cells.points, up, replace(light, power=np.ones(3)))[:, 0] for light in lights]
    return np.sum(each, axis=0)


def _split(ratio: Float[np.ndarray, "photos cells"]):
    """Split log values into log albedo per cell and log power per photo; return that, and the lit samples' misfit.

    The misfit is a median.
    """
    known = np.isfinite(ratio).sum(0) > 0.5 * len(ratio)
    ratio = ratio[:, known]
    power = np.nanmedian(ratio, axis=1)
    albedo = np.zeros(ratio.shape[1])
    for _ in range(ROUNDS):
        albedo = column_quantile(ratio - power[:, None], LIT_QUANTILE)
        power = np.nanmedian(ratio - albedo, axis=1)
    return power, float(np.nanmedian(np.abs(ratio - albedo - power[:, None])))
