"""The flashlight's beam: its intensity and colour over the angle from its axis, and where its LEDs sit."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from .options import Flashlight

WARM_WHITE = (1.0, 0.965, 0.9)
WIDEST_DEG = 86.0  # off the beam's axis; beyond it is dark
LEDS_MM = 9.0  # between the two LEDs
TINT = (0.03, 0.0, -0.07)  # of the warmer LED; the colder one has the opposite
LED_PROFILE = (
    "0.58 exp(-(t/17)^2) + 0.42 exp(-(t/46)^2) - 0.06 exp(-((t-24)/5)^2) + 0.07 exp(-((t-34)/6)^2), t in degrees from "
    "axis; times 1 - smoothstep(60, 84, t); blue times 1 - 0.14 min(t/45, 1), green times 1 - 0.04 min(t/45, 1)"
)


@dataclass(frozen=True)
class Led:
    """One of the flashlight's emitters: its place beside the flashlight's middle, its colour and share of the power."""

    aside_mm: float
    colour: tuple[float, float, float]
    share: float


def leds(light: Flashlight) -> list[Led]:
    """Return the LEDs; their colours have the mean WARM_WHITE."""
    if light.optics != "two-leds":
        return [Led(0.0, WARM_WHITE, 1.0)]
    tinted = [tuple(float(c + sign * t) for c, t in zip(WARM_WHITE, TINT, strict=True)) for sign in (1, -1)]
    return [Led(aside, colour, 0.5) for aside, colour in zip((-LEDS_MM / 2, LEDS_MM / 2), tinted, strict=True)]


def beam(cosine: Float[np.ndarray, "*batch"], light: Flashlight) -> Float[np.ndarray, "*batch 3"]:
    """Return the share of the intensity on the axis, per colour; dark beyond WIDEST_DEG.

    Args:
        cosine: of the angle from the axis.
        light: even: 2 ** -(angle / half angle)^2; LEDs: LED_PROFILE.
    """
    t = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    if light.optics == "even":
        share = np.where(t < WIDEST_DEG, np.exp2(-((t / light.beam) ** 2)), 0.0)
        return np.repeat(share[..., None], 3, -1)
    share = 0.58 * np.exp(-((t / 17) ** 2)) + 0.42 * np.exp(-((t / 46) ** 2))
    share += 0.07 * np.exp(-(((t - 34) / 6) ** 2)) - 0.06 * np.exp(-(((t - 24) / 5) ** 2))
    end = np.clip((t - 60) / 24, 0, 1)
    share *= 1 - end * end * (3 - 2 * end)
    off = np.minimum(t / 45, 1)[..., None]
    return share[..., None] * (1 - off * np.array([0.0, 0.04, 0.14]))


def profile(light: Flashlight) -> str:
    """Return the formula of `beam` in words, for lights.json."""
    if light.optics == "even":
        return f"I0 2^-(theta/half_angle)^2, theta from axis, dark beyond {WIDEST_DEG:g} deg"
    return LED_PROFILE
