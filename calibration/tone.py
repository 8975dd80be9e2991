"""Whether the sRGB curve assumed for 8-bit photos explains the ground's shading better than other curves do.

Shading cannot measure a tone curve: a power of brightness looks like another beam and another distance. But with the
wrong curve falloff, beam and ambient light no longer fit together everywhere, so the residual of the light fit is
smallest near the true curve. Measured on two rendered captures: for files on the BT.709 curve or with a shoulder it
falls to 0.76 to 0.86 under another curve, for sRGB files to 0.91 to 0.99, as film to 0.87. A pure power is not found.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from calibration.camera import Camera
from calibration.pose import Pose
from calibration.shading import locate_lights
from capture.photo import PhotoStack, srgb_of

PHOTOS = 12  # evenly chosen: a dozen lights fix the beam, more take longer
CLEARLY_BETTER = 0.85  # residual of another curve over that of sRGB: below, sRGB is doubted
STEEPER, FLATTER = 1.1, 1 / 1.1  # contrast settings of phones; 10 % costs 4 to 5 % of a light's distance
BT709_KNEE, BT709_SLOPE = 0.081, 4.5  # ITU-R BT.709, encoded side

Linear = Float[np.ndarray, "*shape"]


@dataclass(frozen=True)
class ToneTest:
    """The light fit's residual (relative) under each curve; `best` is sRGB unless another one is clearly better."""

    residuals: dict[str, float]
    best: str

    def sentence(self) -> str:
        """What a user should know about it; empty where nothing speaks against the assumption."""
        if self.best == "sRGB":
            return ""
        return (
            f"tone curve: the ground's shading fits {self.best} better than the sRGB curve that was assumed "
            f"(residual {100 * self.residuals[self.best]:.2f} % against {100 * self.residuals['sRGB']:.2f} %): lights "
            "may be off by some 5 % of their distance. Switch HDR and photo styles off, or take RAW photos"
        )


def _from_bt709(encoded: Linear) -> Linear:
    return np.where(encoded < BT709_KNEE, encoded / BT709_SLOPE, ((encoded + 0.099) / 1.099) ** (1 / 0.45))


CURVES: dict[str, Callable[[Linear], Linear]] = {
    "sRGB": lambda linear: linear,
    "BT.709": lambda linear: _from_bt709(srgb_of(linear)),
    "a steeper curve": lambda linear: linear**FLATTER,
    "a flatter curve": lambda linear: linear**STEEPER,
}


def compare_curves(
    stack: PhotoStack, camera: Camera, world_from_camera: Pose, usable: Bool[np.ndarray, "photos"]
) -> ToneTest:
    """Fit the lights of a dozen photos under every curve.

    Args:
        stack: decoded by the sRGB curve.
        usable: photos to look at.

    Raises:
        CalibrationError: as `locate_lights`.
    """
    chosen = np.flatnonzero(usable)
    chosen = chosen[np.linspace(0, len(chosen) - 1, min(len(chosen), PHOTOS)).round().astype(int)]
    some = replace(
        stack,
        rgb=stack.rgb[chosen],
        clipped=stack.clipped[chosen],
        paths=tuple(stack.paths[i] for i in chosen),
        gains=tuple(stack.gains[i] for i in chosen),
    )
    residuals = {}
    for name, curve in CURVES.items():
        gains = np.array(some.gains, np.float32)[:, None, None, None]
        rgb = curve(np.clip(some.rgb * gains, 0, 1)).astype(np.float32) / gains
        fit = locate_lights(replace(some, rgb=rgb), camera, world_from_camera, np.ones(len(chosen), bool))
        residuals[name] = float(fit.residuals["shading_rms"])
    best = min(residuals, key=lambda name: residuals[name])
    return ToneTest(residuals, best if residuals[best] < CLEARLY_BETTER * residuals["sRGB"] else "sRGB")
