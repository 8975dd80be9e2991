"""What the ground's shading tells of lights with known places: their kind, their power, and the ground's height.

The ground's albedo is unknown; its scale is defined here.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import minimize_scalar

from calibration.calibration import Calibration
from calibration.light import Light, irradiance
from calibration.lights.ground_cells import sample_ground
from calibration.posed_camera import PosedCamera
from capture.checks.robust import column_quantile
from capture.errors import CalibrationError
from capture.photos.channels import mean_of_channels
from capture.photos.photo import PhotoStack, read_stack, reduced

LIT_QUANTILE = 0.6  # over photos: of a cell's brightness over its irradiance, above shadows and below highlights
ROUNDS = 4  # of albedo and power in turn: medians settle at once
BRIGHTEST_ALBEDO, BRIGHT_SHARE = 0.9, 99.0  # the albedo scale of CONVENTIONS.md, per cent
FACING_QUANTILE = 0.75  # over photos: of an object pixel's brightness, and of the light that it would face
SHADING_MISFIT = 0.2  # median of |log brightness - log model|: right lights leave 0.05, the lights of other photos 0.4
LONG_SIDE = 128  # px: enough for one number of a scene
MOST_PHOTOS = 24  # evenly chosen: large photos take half a second each
GROUND_SPREAD = 0.1  # of log albedo between photos, from which a pixel is taken as object
GROUND_LIT_QUANTILE = 0.8  # over photos: above shadows (at most half of the photos), below most highlights
SEARCH_SIDE = 64  # px of the picture in which ground is looked for
HEIGHTS = 32  # tried at first, evenly in the logarithm of the depth below camera and lights
DEEPEST = 4.0  # of the distance from the camera to the middle of the lights: the lowest ground that is tried
SHALLOWEST = 0.02  # of it: the highest
FEWEST_GROUND = 0.1  # of the picture's pixels must show ground for its height to be found


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
    scale = _power_scale(replace(calibration, lights=used), stack)
    return replace(_with_power(calibration, scale), ambient=scale * calibration.ambient)


def with_common_power(calibration: Calibration, stack: PhotoStack) -> Calibration:
    """Return the calibration with powers in the given proportions, on the albedo scale of CONVENTIONS.md.

    Raises:
        CalibrationError: no pixel sees the ground under any light.
    """
    return _with_power(calibration, _power_scale(calibration, stack))


def _with_power(calibration: Calibration, times: float) -> Calibration:
    return replace(calibration, lights=tuple(replace(light, power=times * light.power) for light in calibration.lights))


def _power_scale(calibration: Calibration, stack: PhotoStack) -> float:
    """Return the factor that multiplies power so that the brightest 1 % of ground and object has albedo 0.9.

    Only the product of albedo and power is observed, so one of them is a choice, stated in CONVENTIONS.md and made only
    here. An object's pixel has the albedo of a surface that faces its lights: the upper quartile of its brightness over
    that of its light. The quotient of a single photo whose beam misses the pixel is noise.

    Raises:
        CalibrationError: no pixel sees the ground under any light.
    """
    ground, value, to_facing = albedo_by_photo(reduced(stack, LONG_SIDE), calibration)
    if not ground.size:
        raise CalibrationError(
            f"no pixel shows the ground (z = {calibration.ground_height:g}) under any light; some were needed. Check "
            "camera, ground and lights in the scene's files."
        )
    albedo = np.where(
        spread_between_photos(ground) < GROUND_SPREAD,
        column_quantile(ground, GROUND_LIT_QUANTILE),
        column_quantile(value, FACING_QUANTILE) / column_quantile(to_facing, FACING_QUANTILE),
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
    up = np.broadcast_to([0.0, 0.0, 1.0], cells.points.shape)
    equal = [replace(light, power=np.ones(3)) for light in lights]
    unit = np.stack([_grey_irradiance([x for x in equal if x.photo == name], cells.points, up, ()) for name in names])
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


# --- a scene that brings its lights -----------------------------------------------------------------------------------


def shading_misfit(stack: PhotoStack, calibration: Calibration) -> float:
    """Return the spread of albedo between photos for level ground: median over pixels, log; inf without any pixel."""
    spread = spread_between_photos(albedo_by_photo(stack, calibration)[0])
    return float(np.median(spread)) if spread.size else np.inf


def albedo_by_photo(
    stack: PhotoStack, calibration: Calibration
) -> tuple[Float[np.ndarray, "photos pixels"], Float[np.ndarray, "photos pixels"], Float[np.ndarray, "photos pixels"]]:
    """Return what photos show where rays meet the ground: brightness over the light on level ground, brightness, and
    the light on a surface that faces the flashlight; the room's is part of both.

    nan where clipped. Only pixels that see ground under some light are used, and photos that have a light. The photos
    must be linear.
    """
    posed_camera = calibration.posed_camera.resized(stack.rgb.shape[2], stack.rgb.shape[1])
    rays = posed_camera.rays(posed_camera.camera.pixel_grid().reshape(-1, 2))
    eye = posed_camera.centre
    with np.errstate(divide="ignore"):
        t = (calibration.ground_height - eye[2]) / rays[:, 2]
    meets = (t > 0) & np.isfinite(t)
    points = eye + t[meets, None] * rays[meets]
    up = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    ground, values, facing, room = [], [], [], calibration.ambient.mean()
    for path, rgb, clipped in zip(stack.paths, stack.rgb, stack.clipped, strict=True):
        lights = [light for light in calibration.lights if light.photo == path.name]
        if not lights:
            continue
        to_facing, to_ground = (_grey_irradiance(lights, points, n, calibration.beam) for n in (None, up))
        usable = ~clipped.reshape(-1)[meets] & (to_ground > 0)
        value = mean_of_channels(rgb).reshape(-1)[meets]
        values.append(np.where(usable, value, np.nan))
        facing.append(np.where(usable, to_facing + room, np.nan))
        ground.append(np.where(usable, value / np.where(usable, to_ground + room, 1.0), np.nan))
    seen = np.isfinite(ground).any(0)
    return np.array(ground)[:, seen], np.array(values)[:, seen], np.array(facing)[:, seen]


def find_ground_height(stack: PhotoStack, calibration: Calibration) -> tuple[float, float] | None:
    """Return the world z of level ground that agrees with the lights, and the agreeing share of the picture; else None.

    The ground's albedo, brightness * d^2 / cosine, is the same in every photo that lights it only at the right height,
    because d and the angle change with height. The height at which most of the picture agrees is taken.

    Args:
        stack: a preview; linear.
        calibration: point lights with their places; its ground_height is not used.
    """
    eye = calibration.world_from_camera.translation
    places = np.array([light.position for light in calibration.lights if light.position is not None])
    if not len(places):
        return None
    stack = reduced(stack, SEARCH_SIDE)
    reach = float(np.median(np.linalg.norm(places - eye, axis=1)))
    top = float(min(eye[2], places[:, 2].min()))
    drops = np.geomspace(SHALLOWEST, DEEPEST, HEIGHTS) * max(reach, float(np.linalg.norm(eye)))
    shares = [_ground_share(stack, calibration, top - drop) for drop in drops]
    best = int(np.argmax(shares))
    between = drops[max(best - 1, 0)], drops[min(best + 1, HEIGHTS - 1)]
    found = minimize_scalar(
        lambda drop: -_ground_share(stack, calibration, top - drop), bounds=between, method="bounded"
    )
    return (top - found.x, -found.fun) if -found.fun >= FEWEST_GROUND else None


def _ground_share(stack: PhotoStack, calibration: Calibration, height: float) -> float:
    """Return the share of the picture that behaves as ground at a height; pixels are weighted by their agreement."""
    spread = spread_between_photos(albedo_by_photo(stack, replace(calibration, ground_height=height))[0])
    pixels = stack.rgb.shape[1] * stack.rgb.shape[2]
    return float((1 / (1 + (spread / (GROUND_SPREAD / 2)) ** 4)).sum() / pixels)


def _grey_irradiance(
    lights: Sequence[Light],
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"] | None,
    beam: tuple[float, ...],
) -> Float[np.ndarray, " n"]:
    """Return the total irradiance of one photo's lights, mean of the colours; see calibration.light.irradiance."""
    return np.sum([irradiance(points, normals, light, beam).mean(-1) for light in lights], axis=0)


def spread_between_photos(albedo: Float[np.ndarray, "photos pixels"]) -> Float[np.ndarray, " pixels"]:
    """Return the spread of log albedo between photos that light a pixel; small for ground under the right lights."""
    ordered = np.sort(albedo, axis=0)  # nan comes last
    rank = np.round(GROUND_LIT_QUANTILE * (np.isfinite(albedo).sum(0) - 1)).astype(int)
    lit = albedo > 0.5 * np.take_along_axis(ordered, np.maximum(rank, 0)[None], axis=0)
    dark = ~(lit & (albedo > 0))
    kept = np.ma.masked_array(np.log(np.where(dark, 1.0, albedo)), dark)
    return np.asarray(kept.std(axis=0).filled(np.inf))


def preview(photos: Sequence[Path], is_linear: bool = False) -> PhotoStack:
    """Read at most MOST_PHOTOS of the photos, LONG_SIDE px long.

    Raises:
        CaptureError: as read_stack.
    """
    chosen = np.unique(np.linspace(0, len(photos) - 1, min(len(photos), MOST_PHOTOS)).round().astype(int))
    return read_stack([photos[i] for i in chosen], LONG_SIDE, as_linear=is_linear)
