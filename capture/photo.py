"""One photo file becomes linear colour: the only file that knows formats, channel order and the sRGB curve."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float


@dataclass(frozen=True)
class Exposure:
    """How long and how sensitively the sensor looked; None where the file does not say."""

    time_s: float | None = None
    iso: float | None = None
    f_number: float | None = None

    def relative(self) -> float | None:
        """Light gathered per unit of radiance, time * ISO / f^2, in arbitrary units; None when time or ISO is missing."""
        if self.time_s is None or self.iso is None:
            return None
        return self.time_s * self.iso / (self.f_number or 1.0) ** 2


@dataclass(frozen=True)
class Photo:
    """A photo as stored by the sensor (never rotated by its EXIF tag), linear RGB, 1.0 = saturation."""

    rgb: Float[np.ndarray, "height width 3"]
    clipped: Bool[np.ndarray, "height width"]
    exposure: Exposure
    path: Path
    focal_35mm: float | None = None  # 35 mm equivalent focal length, mm
    taken_s: float | None = None  # DateTimeOriginal as seconds since the epoch, no time zone
    is_linear: bool = False  # True for RAW: no tone curve had to be assumed


@dataclass(frozen=True)
class PhotoStack:
    """All photos of one fixed camera, reduced to a common working size: what checks, light fit and solver look at.

    Relative exposure (EXIF) is divided out, so equal radiance has equal value in every photo.
    """

    rgb: Float[np.ndarray, "photos height width 3"]  # linear float32
    clipped: Bool[np.ndarray, "photos height width"]  # any contributing pixel saturated
    paths: tuple[Path, ...]
    full_width: int  # size of the files, px
    full_height: int
    gains: tuple[float, ...]  # what each photo was divided by
