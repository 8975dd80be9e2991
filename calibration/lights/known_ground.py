"""Estimate the kind of known lights, and the ground's height, from the ground's shading."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from calibration.calibration import Calibration
from calibration.light import Light, irradiance
from capture.photos.channels import mean_of_channels
from capture.photos.photo import PhotoStack, read_stack, reduced

LONG_SIDE = 128  # px
MOST_PHOTOS = 24  # evenly chosen: large photos take half a second each


GROUND_SPREAD = 0.1  # of log albedo between photos, from which a pixel is taken as object
GROUND_LIT_QUANTILE = 0.8  # over photos: above shadows (at most half of the photos), below most highlights
SEARCH_SIDE = 64  # px of the picture in which ground is looked for
HEIGHTS = 32  # tried at first, evenly in the logarithm of the depth below camera and lights
DEEPEST = 4.0  # of the distance from the camera to the middle of the lights: the lowest ground that is tried
SHALLOWEST = 0.02  # of it: the highest
REFINED = 12  # steps of a golden section about the best height: below a thousandth of it
FEWEST_GROUND = 0.1  # of the picture's pixels must show ground for its height to be found
GOLDEN = (np.sqrt(5) - 1) / 2


def shading_misfit(stack: PhotoStack, calibration: Calibration) -> float:
    """Return the spread of albedo between photos for level ground: median over pixels, log; inf without any pixel."""
    spread = spread_between_photos(albedo_by_photo(stack, calibration)[0])
    return float(np.median(spread)) if spread.size else np.inf


def albedo_by_photo(
    stack: PhotoStack, calibration: Calibration
) -> tuple[Float[np.ndarray, "photos pixels"], Float[np.ndarray, "photos pixels"]]:
    """Return brightness over irradiance where rays meet the ground: on level ground, and on a surface facing the light.

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
    ground, facing = [], []
    for path, rgb, clipped in zip(stack.paths, stack.rgb, stack.clipped, strict=True):
        lights = [light for light in calibration.lights if light.photo == path.name]
        if not lights:
            continue
        to_facing, to_ground = (_grey_irradiance(lights, points, n, calibration.beam) for n in (None, up))
        usable = ~clipped.reshape(-1)[meets] & (to_ground > 0)
        value = mean_of_channels(rgb).reshape(-1)[meets]
        facing.append(np.where(usable, value / to_facing, np.nan))
        ground.append(np.where(usable, value / np.where(usable, to_ground, 1.0), np.nan))
    seen = np.isfinite(ground).any(0)
    return np.array(ground)[:, seen], np.array(facing)[:, seen]


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
    low, high = drops[max(best - 1, 0)], drops[min(best + 1, HEIGHTS - 1)]
    for _ in range(REFINED):
        a, b = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
        if _ground_share(stack, calibration, top - a) >= _ground_share(stack, calibration, top - b):
            high = b
        else:
            low = a
    height = top - (low + high) / 2
    share = _ground_share(stack, calibration, height)
    return (height, share) if share >= FEWEST_GROUND else None


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
