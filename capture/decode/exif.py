"""Read camera, exposure and time from a photo file without decoding it."""

import calendar
import re
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from capture.decode.formats import read_exif, read_size

FULL_FRAME_DIAGONAL = 43.27  # mm: what "35 mm equivalent" refers to
ORDINARY_FOCAL_35MM = 27.0  # mm, of photos that do not tell theirs: main cameras of phones have 23 to 28
ORDINARY_FOCAL_MM = 5.6  # of such a camera, on its sensor of 1/1.7 inch
PHONE_STROKE_MM = 0.5  # how far the focus motors of phones move a lens: 0.3 to 0.5 mm
SMALL_SENSOR = 2.5  # full frame's diagonal over the sensor's; the largest in phones, of 1 inch, has 2.7
LONGEST_MAIN_MM = 10.0  # focal length: main cameras of phones have 4 to 9 mm
FAR_AWAY = 1e6  # mm: files write infinity as a huge number
FRONT = re.compile(r"\b(front|truedepth|selfie)\b", re.IGNORECASE)  # in the lens names of phones


@dataclass(frozen=True)
class Exposure:
    """Exposure time, ISO and f-number; None where the file does not state them."""

    time_s: float | None = None
    iso: float | None = None
    f_number: float | None = None

    def relative(self) -> float | None:
        """Return the light gathered per unit of radiance, time * ISO / f^2, in any unit; None without time or ISO."""
        if self.time_s is None or self.iso is None:
            return None
        return self.time_s * self.iso / (self.f_number or 1.0) ** 2


@dataclass(frozen=True)
class Optics:
    """The lens and where it was focused, mm; None where the file does not state it."""

    focal_mm: float | None = None
    focal_35mm: float | None = None
    focus_mm: float | None = None

    def closest_mm(self) -> float:
        """Return how near a thing can be in focus.

        A lens of focal length f that is moved by s from where infinity is sharp is in focus at f + f^2 / s. Larger
        cameras have lenses that show things in life size: at 2 f.
        """
        focal = self.focal_mm or ORDINARY_FOCAL_MM
        is_phone = self.focal_35mm / focal > SMALL_SENSOR if self.focal_35mm else focal < LONGEST_MAIN_MM
        return focal + focal**2 / PHONE_STROKE_MM if is_phone else 2 * focal

    def words(self) -> str:
        """Return what lens that is."""
        return f"its lens of {self.focal_mm:.3g} mm (EXIF)" if self.focal_mm else "the camera of a phone"


@dataclass(frozen=True)
class PhotoHeader:
    """The information in a file's header, read without decoding."""

    camera: tuple[str, ...]  # maker, model, focal length, size in pixels: equal for photos of one phone and lens
    exposure: Exposure
    taken_s: float | None
    size: tuple[int, int]  # width and height, px, as read_size gives them


def read_header(path: Path) -> PhotoHeader:
    """Read camera, exposure and time without decoding the pixels.

    Raises:
        CaptureError: not a photo, or larger than 200 megapixels.
    """
    exif = read_exif(path)
    size = read_size(path)
    camera = (str(exif.get(271, "")), str(exif.get(272, "")), str(tag_of(exif, 37386)), f"{max(size)} x {min(size)}")
    return PhotoHeader(camera, exposure_of(exif), taken_of(exif), size)


def tag_of(exif: Image.Exif, tag: int) -> object:
    """Return a tag of the EXIF directory, or of the main one, where some cameras store it."""
    value = exif.get_ifd(0x8769).get(tag, exif.get(tag))
    return value[0] if isinstance(value, tuple) and value else value


def focal_of(exif: Image.Exif) -> float | None:
    """Return the 35 mm equivalent focal length, mm; None where missing."""
    return _positive(tag_of(exif, 41989))


def optics_of(exif: Image.Exif) -> Optics:
    """Return focal length and focus distance (SubjectDistance)."""
    metres = _positive(tag_of(exif, 37382))
    focus = None if metres is None or 1000 * metres > FAR_AWAY else 1000 * metres
    return Optics(_positive(tag_of(exif, 37386)), focal_of(exif), focus)


def focal_in_pixels(focal_35mm: float | None, width: int, height: int) -> float:
    """Return a focal length in pixels; `focal_35mm`: what EXIF states, mm, None for the main camera of a phone."""
    return (focal_35mm or ORDINARY_FOCAL_35MM) / FULL_FRAME_DIAGONAL * float(np.hypot(width, height))


def front_lens(path: Path) -> str | None:
    """Return the lens that a file names if it is that of a phone's front, which many phones store mirrored."""
    text = str(tag_of(read_exif(path), 42036) or "").strip("\0 ")
    return text if FRONT.search(text) else None


def _positive(value: object) -> float | None:
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if 0 < number < float("inf") else None


def orientation_of(exif: Image.Exif) -> int:
    """Return how a photo is to be turned for a person, 1 to 8 as EXIF counts; 1 (not at all) where it is not stated."""
    value = exif.get(274)
    return value if isinstance(value, int) and 1 <= value <= 8 else 1


def exposure_of(exif: Image.Exif) -> Exposure:
    """Return exposure time, ISO and f-number, each None where missing."""
    return Exposure(
        time_s=_positive(tag_of(exif, 33434)),
        iso=_positive(tag_of(exif, 34855)),
        f_number=_positive(tag_of(exif, 33437)),
    )


def taken_of(exif: Image.Exif) -> float | None:
    """Return DateTimeOriginal with its fraction, in seconds since the epoch, without time zone; None where missing."""
    text, fraction = tag_of(exif, 36867), tag_of(exif, 37521)
    try:
        whole = calendar.timegm(time.strptime(str(text).strip("\0 "), "%Y:%m:%d %H:%M:%S"))
    except ValueError:
        return None
    digits = str(fraction).strip("\0 ")
    return whole + (float(f"0.{digits}") if digits.isdecimal() else 0.0)
