"""From linear light to a phone's JPEG file: noise, sRGB, EXIF."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from PIL import Image

from capture.photos.photo import encode_srgb

from .options import Setup
from .pipeline import Developed, Shutter, develop, metered

ELECTRONS = 10_000.0  # that fill a pixel after the phone's own averaging: 1.4 % noise at 0.5
READ_NOISE = 3.0  # electrons
EXIF_IFD = 0x8769
SHUTTER_S, F_NUMBER = 1 / 30, 1.85
ROOM_ISO, DARK_ISO = 50, 250
CLOCK = "2024:05:04 {:02d}:{:02d}:{:02d}"
START_S, BETWEEN_S = 10 * 3600, 7


@dataclass(frozen=True)
class PhotoFile:
    """Name and moment of one photo, and the phone that took it."""

    path: Path
    number: int  # in the order taken
    phone: str = "Simulated phone"
    focal: float | None = None  # for 35 mm film, where it is not the setup's
    clock_s: float = 0.0  # by which the phone's clock is ahead


def developed(
    linear: Float[np.ndarray, "height width 3"],
    setup: Setup,
    rng: np.random.Generator,
    iso: int,
    name: str,
    metering: float = 0.0,
) -> Developed:
    """Return the 8-bit picture of the sensor's counts: of the phone's pipeline if that is on, plain sRGB otherwise.

    Args:
        iso: of the exposure at which `linear` 1 is saturation.
        name: whose random numbers the pipeline takes.
        metering: of plain sRGB: share of a change in brightness that auto exposure evens out.
    """
    exposure, own, usual = setup.exposure, setup.stream(f"pipeline {name}"), Shutter(SHUTTER_S, iso)
    if setup.pipeline.pipeline:
        grain = rng.standard_normal(linear.shape) if exposure.noise > 0 else np.zeros(linear.shape)
        return develop(linear, setup.pipeline, usual, exposure.lens_blur, (exposure.noise, grain), own)
    shutter = metered(linear, metering, usual, own)
    linear = shutter.gain(usual) * linear
    if exposure.lens_blur > 0:
        linear = cv2.GaussianBlur(linear, (0, 0), exposure.lens_blur)
    if exposure.noise > 0:
        variance = np.maximum(linear, 0) / ELECTRONS + (READ_NOISE / ELECTRONS) ** 2
        linear = linear + exposure.noise * np.sqrt(variance) * rng.standard_normal(linear.shape)
    return Developed(encode_srgb(linear.astype(np.float32)), shutter, shutter.gain(usual), (1.0, 1.0, 1.0))


def write_photo(file: PhotoFile, picture: Developed, setup: Setup) -> None:
    """Write the JPEG file with the metadata that a phone adds."""
    moment = START_S + BETWEEN_S * file.number + file.clock_s
    second = int(moment)
    taken = CLOCK.format(second // 3600, second // 60 % 60, second % 60)
    tags = Image.Exif()
    tags.update({271: "Generated", 272: file.phone, 274: 1, 306: taken})
    height, width = picture.pixels.shape[:2]
    focal, shutter = file.focal or setup.phone.focal, picture.shutter
    details = {33434: shutter.seconds, 33437: F_NUMBER, 34855: shutter.iso, 36867: taken, 36868: taken, 37385: 16}
    details |= {37386: focal / 5.5, 41989: round(focal), 40962: width, 40963: height}
    if file.clock_s:
        details[37521] = f"{round(1000 * (moment - second)):03d}"
    tags.get_ifd(EXIF_IFD).update(details)
    file.path.parent.mkdir(parents=True, exist_ok=True)
    quality, halved = (setup.pipeline.pipeline_jpeg, 2) if setup.pipeline.pipeline else (setup.exposure.jpeg, 0)
    Image.fromarray(picture.pixels).save(file.path, quality=quality, subsampling=halved, exif=tags.tobytes())
