"""Lights and their irradiance: one description for calibration, solver and relighting."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

Vector = Float[np.ndarray, "3"]


@dataclass(frozen=True)
class Light:
    """The light of one photo, world frame.

    Irradiance on a surface with normal n at x, per colour channel, in linear pixel value for albedo 1:
    point: power * g(c) * max(n . l, 0) / d^2, with d = |position - x|, l towards the light and c = cos of the angle
    between the beam axis and -l; directional: power * max(n . l, 0). The factor 1/pi of a diffuse surface is in power.
    """

    photo: str
    kind: str  # "point" | "directional"
    position: Vector | None = None  # point lights, world
    direction: Vector | None = None  # directional lights: unit vector from the scene towards the light
    power: Vector = field(default_factory=lambda: np.ones(3))
    axis: Vector | None = None  # unit beam axis of a flashlight, world; None = isotropic
    sigma: Vector = field(default_factory=lambda: np.zeros(3))  # one sigma: world length, or radians if directional
    used: bool = True
    reason: str = ""  # why not used, or a warning

    def __post_init__(self):
        if (self.kind == "point") != (self.position is not None) or (self.kind == "directional") != (
            self.direction is not None
        ):
            raise ValueError("a Light is a point with a position or directional with a direction")

    def homogeneous(self) -> Float[np.ndarray, "4"]:
        """Return (x, y, z, w), world: w = 1 for a point light at x, y, z; w = 0 for a direction towards the light."""
        if self.position is not None:
            return np.append(self.position, 1.0)
        assert self.direction is not None
        return np.append(self.direction, 0.0)

    def seen_from(self, point: Vector) -> tuple[Vector, float]:
        """Return the unit vector from a point to the light, and its distance: world length, 1 if directional."""
        place = self.homogeneous()
        way = place[:3] - place[3] * point
        distance = float(np.linalg.norm(way))
        return way / distance, distance if self.position is not None else 1.0


def beam_gain(cosine: Float[np.ndarray, "*batch"], beam: tuple[float, ...]) -> Float[np.ndarray, "*batch"]:
    """Return g(c) of a radially symmetric flashlight: log g = m log c + r2 u^2 + r3 u^3 + ..., u = 1 - c.

    Args:
        cosine: of the angle between beam axis and the direction to the surface; values below 0.02 are clamped.
        beam: (m, r2, r3, ...), shared by all photos of a session; () for an isotropic light, whose gain is 1.
    """
    if not beam:
        return np.ones_like(cosine)
    return np.exp(log_beam_gain(np.clip(cosine, 0.02, 1.0), beam))


def log_beam_gain(
    cosine: Float[np.ndarray, "*batch"], beam: Sequence[float] | Float[np.ndarray, " terms"]
) -> Float[np.ndarray, "*batch"]:
    """Return log g(c) of beam_gain, for cosines above 0 and at least one term."""
    log_gain = beam[0] * np.log(cosine)
    for power, r in enumerate(beam[1:], start=2):
        log_gain = log_gain + r * (1 - cosine) ** power
    return log_gain


def irradiance(
    points: Float[np.ndarray, "*batch 3"],
    normals: Float[np.ndarray, "*batch 3"] | None,
    light: Light,
    beam: tuple[float, ...] = (),
) -> Float[np.ndarray, "*batch 3"]:
    """Return a light's irradiance at surface points, per channel in linear pixel value for albedo 1, without shadows.

    The formula is that of Light. Without normals the surface is assumed to face the light.

    Args:
        points: world.
        normals: unit, world.
        beam: as of beam_gain.
    """
    if light.position is None:
        assert light.direction is not None
        toward, falloff = np.broadcast_to(light.direction, points.shape), np.ones(points.shape[:-1])
    else:
        offset = light.position - points
        distance = np.linalg.norm(offset, axis=-1)
        toward, falloff = offset / distance[..., None], 1 / distance**2
        if light.axis is not None:
            falloff = falloff * beam_gain(-toward @ light.axis, beam)
    if normals is not None:
        falloff = falloff * np.maximum((normals * toward).sum(-1), 0)
    return falloff[..., None] * light.power
