"""Lights from the shadows of solids declared in session.toml: combined with those from shading, or a sun alone."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from calibration.flashlight.light_estimate import LightFit
from calibration.flashlight.solid_shadows import (
    GroundPixels,
    ShadowLight,
    distance_outside,
    fit_light,
    near_solids,
    search_direction,
)
from calibration.light import Light, irradiance
from calibration.lights.fusion import fuse
from calibration.lights.ground_cells import ground_points
from calibration.lights.power import with_power_per_photo
from calibration.posed_camera import PosedCamera
from capture.checks.robust import column_quantile
from capture.errors import CalibrationError, Remedy
from capture.photos.channels import mean_of_channels
from capture.photos.photo import PhotoStack
from capture.session.declared_objects import Solid

LIT_QUANTILE = 0.7  # over photos, of brightness over irradiance: above the shadows of up to two thirds of the photos
MOST_PIXELS = 12_000  # around the solids; more say nothing new
MIN_SUNS = 4  # directions that a reconstruction needs at least


def fuse_shadow_lights(
    fit: LightFit, stack: PhotoStack, posed_camera: PosedCamera, solids: tuple[Solid, ...]
) -> tuple[LightFit, list[str]]:
    """Combine a fit's lights with those from the solids' shadows, weighted by covariance; return also notes.

    Args:
        fit: point lights found by shading or phone, for some photos of the stack.
    """
    by_name = {path.name: k for k, path in enumerate(stack.paths)}
    pixels = _around(stack, posed_camera, solids, _flash_levels(fit, stack, posed_camera))
    ground = np.array([0, 0, posed_camera.ground_height])
    lights, used, apart = [], 0, []
    for light in fit.lights:
        at = light.position if light.used else None
        found = None if at is None else fit_light(pixels, by_name[light.photo], solids, np.append(at - ground, 1.0))
        if at is None or found is None:
            lights.append(light)
            continue
        place = found.light[:3] + ground
        mean, covariance, contradict = fuse([at, place], [np.diag(light.sigma**2), found.covariance])
        reason = light.reason
        if contradict:
            by = float(np.linalg.norm(at - place))
            reason = f"shading and the shadows of the declared objects place it {by:.0f} mm apart"
            apart.append(light.photo)
        lights.append(replace(light, position=mean, sigma=np.sqrt(np.diag(covariance)), reason=reason))
        used += 1
    notes = [f"lights: {used} of {len(lights)} also from the shadows of {len(solids)} declared objects"]
    if apart:
        notes.append(f"shading and declared objects contradict each other in {', '.join(apart)}: check their sizes")
    return replace(fit, lights=tuple(lights), residuals=fit.residuals | {"lights_from_declared": used}), notes


def locate_sun(
    stack: PhotoStack, posed_camera: PosedCamera, usable: Bool[np.ndarray, " photos"], solids: tuple[Solid, ...]
) -> LightFit:
    """A directional light per usable photo from the solids' shadows; its power from the ground.

    Raises:
        CalibrationError: no solid is declared, or fewer than 4 photos show its shadow.
    """
    if not solids:
        raise CalibrationError(
            'session.toml says light = "sun" and declares no object; the direction comes from a shadow.',
            "declare a [[pegs]] or [[cubes]] that stands on the table",
            Remedy.LIGHTS_FILE,
        )
    grey = np.where(stack.clipped, np.nan, mean_of_channels(stack.rgb))
    even = grey / np.nanmedian(grey, axis=(1, 2), keepdims=True)  # a sun lights level ground evenly
    pixels = _around(stack, posed_camera, solids, even)
    lights = []
    for k in np.flatnonzero(usable):
        start = search_direction(pixels, int(k), solids)
        found = fit_light(pixels, int(k), solids, start)
        lights.append(_sun(stack.paths[k].name, found))
    seen = [light for light in lights if light.used]
    if len(seen) < MIN_SUNS:
        raise CalibrationError(
            f"the shadow of the declared objects is seen in {len(seen)} of {len(lights)} photos, {MIN_SUNS} needed. "
            "Check at_mm and the height in session.toml, and keep the shadow on the bare table."
        )
    kept = np.zeros(len(stack.paths), bool)
    kept[[k for k, light in zip(np.flatnonzero(usable), lights, strict=True) if light.used]] = True
    powered = with_power_per_photo(seen, stack, posed_camera, kept)
    by_name = {light.photo: light for light in powered.lights}
    lights = tuple(by_name.get(light.photo, light) for light in lights)
    return LightFit(lights, (), np.zeros(3), {"given_lights_misfit": powered.misfit})


def _sun(photo: str, found: ShadowLight | None) -> Light:
    if found is None:
        up = np.array([0.0, 0.0, 1.0])
        why = "no shadow of the declared objects where one could be"
        return Light(photo, "directional", direction=up, power=np.zeros(3), used=False, reason=why)
    length = float(np.linalg.norm(found.light[:3]))
    direction = found.light[:3] / length
    turn = (np.eye(3) - np.outer(direction, direction)) / length  # of the unit vector by the slopes
    sigma = np.sqrt(np.diag(turn @ found.covariance @ turn.T))
    return Light(photo, "directional", direction=direction, sigma=sigma)


def _around(
    stack: PhotoStack,
    posed_camera: PosedCamera,
    solids: tuple[Solid, ...],
    levels: Float[np.ndarray, "photos height width"],
) -> GroundPixels:
    """Return the ground around the solids in every photo over its lit brightness, without what the solids hide.

    Args:
        levels: brightness of every pixel over the irradiance at its ground point.
    """
    height, width = stack.rgb.shape[1:3]
    points, down = ground_points(posed_camera.resized(width, height))
    flat = points[..., :2].reshape(-1, 2)
    chosen = np.flatnonzero(down.reshape(-1) & near_solids(flat, solids))
    chosen = chosen[:: max(len(chosen) // MOST_PIXELS, 1)]
    if not len(chosen):
        raise CalibrationError(
            "the declared objects stand where the photos do not show the table; check at_mm in session.toml."
        )
    rows = points[:, :, :2].reshape(height, width, 2)
    steps = np.linalg.norm(np.diff(rows, axis=1), axis=-1)[down[:, 1:] & down[:, :-1]]
    size = float(np.median(steps[np.isfinite(steps)]))
    eye = np.append(posed_camera.centre - np.array([0, 0, posed_camera.ground_height]), 1.0)
    seen = distance_outside(flat[chosen], solids, eye) > 2 * size
    chosen = chosen[seen]
    value = levels.reshape(len(levels), -1)[:, chosen]
    lit = column_quantile(value, LIT_QUANTILE)
    return GroundPixels(flat[chosen], size, np.where(lit > 0, value / np.maximum(lit, 1e-9), np.nan))


def _flash_levels(
    fit: LightFit, stack: PhotoStack, posed_camera: PosedCamera
) -> Float[np.ndarray, "photos height width"]:
    """Grey value over the irradiance of each photo's fitted flashlight and the ambient light; NaN without one."""
    height, width = stack.rgb.shape[1:3]
    points, down = ground_points(posed_camera.resized(width, height))
    points = np.where(down[..., None], points, 0.0)
    up = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    out = np.full(stack.rgb.shape[:3], np.nan)
    by_name = {light.photo: light for light in fit.lights}
    for k, path in enumerate(stack.paths):
        light = by_name.get(path.name)
        if light is not None and light.used:
            sent = (irradiance(points, up, light, fit.beam) + fit.ambient).mean(-1)
            value = mean_of_channels(stack.rgb[k]) / np.maximum(sent, 1e-12)
            out[k] = np.where(down & ~stack.clipped[k], value, np.nan)
    return out
