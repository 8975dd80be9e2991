"""Lighting: a lamp, a far lamp or surroundings for the computed picture, from a quick picture to the finest."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Protocol

import numpy as np
from jaxtyping import Float

from calibration.calibration import Calibration
from calibration.light import Light
from reconstruct.render.environment import Sky
from reconstruct.render.g_buffer import RenderView
from reconstruct.render.relight import environment_steps, relight_steps
from viewer.display.layers import CAMERA_DISTANCE, PageScale, light_position

SAME_PLACE = 1e-4  # page units: the page sends places as float32
LAMP_SAMPLES = (4, 16, 64)  # shadow rays per pixel of a lamp of some size, by Quality
DARKNESS = 0.01  # linear: beyond the ground, where only a lamp shines
QUICK_GROUND = 2  # pixels of the ground from one that is computed to the next, in a quick picture under surroundings
SKY_ROWS = (4, 8, 12)  # of patches that surroundings are averaged to, by Quality: 16, 64, 144 shadow rays

Linear = Float[np.ndarray, "height width 3"]


class Quality(IntEnum):
    """The quality of a picture, and so its cost."""

    QUICK = 0
    FINE = 1
    FINEST = 2


class Lighting(Protocol):
    """Something that lights a view."""

    def steps(self, view: RenderView, quality: Quality) -> Iterator[Linear | None]:
        """Yield None while there is more to do, and the linear picture at the end."""
        ...

    def qualities(self) -> tuple[Quality, ...]:
        """Return the qualities whose pictures differ."""
        ...


@dataclass(frozen=True)
class LampLighting:
    """One lamp, near or far, of some size, in the dark of the capture's room."""

    light: Light
    radius: float  # of relight_soft
    calibration: Calibration

    def steps(self, view: RenderView, quality: Quality) -> Iterator[Linear | None]:
        """As Lighting.steps."""
        samples = LAMP_SAMPLES[quality] if self.radius > 0 else 1
        parts = relight_steps(view, self.light, self.radius, samples, self.calibration.beam, self.calibration.ambient)
        return (None if part is None else part.numpy() for part in parts)

    def qualities(self) -> tuple[Quality, ...]:
        """Return one quality for a lamp without size, else all."""
        return tuple(Quality) if self.radius > 0 else (Quality.QUICK,)


@dataclass(frozen=True)
class SkyLighting:
    """Surroundings, turned and made brighter or darker."""

    name: str
    radiance: Sky  # of reconstruct.render.environment: exposed
    turn: float  # rad
    strength: float

    def steps(self, view: RenderView, quality: Quality) -> Iterator[Linear | None]:
        """As Lighting.steps."""
        every = QUICK_GROUND if quality == Quality.QUICK else 1
        parts = environment_steps(view, self.radiance, SKY_ROWS[quality], self.turn, every)
        return (None if part is None else self.strength * part.numpy() for part in parts)

    def qualities(self) -> tuple[Quality, ...]:
        """Return all qualities."""
        return tuple(Quality)


# --- lamps -----------------------------------------------------------------------------------------------------------


def lamp_light(
    calibration: Calibration,
    scale: PageScale,
    place: Float[np.ndarray, "3"],
    brightness: float = 1.0,
    colour: Float[np.ndarray, "3"] | None = None,
) -> Light:
    """Return the light of a lamp at `place`, with the capture's median power, aimed at the middle.

    At the place of a light of the capture it is that light, so that the picture can be compared with the photo.

    Args:
        place: page units.
        brightness: times the power.
        colour: linear factors; None: that of the flashlight.
    """
    tint = brightness * (np.ones(3) if colour is None else colour)
    for light in calibration.lights:
        if light.used and np.allclose(light_position(light, scale), place, rtol=0, atol=SAME_PLACE):
            return replace(light, power=tint * light.power)
    used = _used(calibration)
    power = tint * np.median([light.power for light in used], axis=0)
    position = scale.to_world(place)
    towards = scale.centre - position
    towards = towards / np.linalg.norm(towards)
    if used[0].position is None:
        power = power * (CAMERA_DISTANCE / scale.factor) ** 2  # as bright there as the capture's, see light_position
    axis = towards if any(light.axis is not None for light in used) else None
    return Light("", "point", position=position, power=power, axis=axis)


def far_light(
    calibration: Calibration,
    scale: PageScale,
    direction: Float[np.ndarray, "3"],
    brightness: float = 1.0,
    colour: Float[np.ndarray, "3"] | None = None,
) -> Light:
    """Return a directional light that is as bright in the middle as the capture's median light.

    Args:
        direction: unit, towards the lamp.
        brightness, colour: as for `lamp_light`.
    """
    tint = brightness * (np.ones(3) if colour is None else colour)
    for light in calibration.lights:
        if light.used and light.direction is not None and np.allclose(light.direction, direction, atol=SAME_PLACE):
            return replace(light, power=tint * light.power)
    reaches = [
        light.power / (1.0 if light.position is None else np.sum((light.position - scale.centre) ** 2))
        for light in _used(calibration)
    ]
    return Light("", "directional", direction=direction, power=tint * np.median(reaches, axis=0))


def direction_of(azimuth: float, elevation: float) -> Float[np.ndarray, "3"]:
    """Return the unit direction of these angles, degrees: azimuth from +x towards +y, elevation above the ground."""
    a, e = np.radians(azimuth), np.radians(elevation)
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def angles_of(direction: Float[np.ndarray, "3"]) -> tuple[float, float]:
    """Return azimuth in [0, 360) and elevation of a direction, degrees."""
    azimuth = np.degrees(np.arctan2(direction[1], direction[0])) % 360
    return float(azimuth), float(np.degrees(np.arcsin(np.clip(direction[2] / np.linalg.norm(direction), -1, 1))))


def nearest_light(calibration: Calibration, light: Light, scale: PageScale) -> int:
    """Return the index of the used light nearest to `light`, by their places on the page."""
    ours = light_position(light, scale)
    places = np.array([light_position(other, scale) for other in calibration.lights])
    unused = np.array([not other.used for other in calibration.lights])
    return int(np.argmin(np.linalg.norm(places - ours, axis=1) + np.where(unused, np.inf, 0.0)))


def _used(calibration: Calibration) -> list[Light]:
    return [light for light in calibration.lights if light.used] or list(calibration.lights)


def background(lighting: Lighting, directions: Float[np.ndarray, "*picture 3"]) -> Float[np.ndarray, "*picture 3"]:
    """Return the linear colour seen along world directions beyond object and ground: surroundings or darkness."""
    if not isinstance(lighting, SkyLighting):
        return np.full_like(directions, DARKNESS)
    rows, columns = lighting.radiance.shape[:2]
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    row = np.arccos(np.clip(unit[..., 2], -1, 1)) / np.pi * rows
    column = (np.arctan2(unit[..., 1], unit[..., 0]) - lighting.turn) / (2 * np.pi) % 1.0 * columns
    place = np.minimum(row.astype(int), rows - 1), np.minimum(column.astype(int), columns - 1)
    return lighting.strength * lighting.radiance.numpy()[place]
