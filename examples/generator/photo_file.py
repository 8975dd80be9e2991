"""From linear light to a phone's JPEG file: noise, sRGB, EXIF."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from PIL import Image

from capture.photos.photo import encode_srgb

from .options import Setup

ELECTRONS = 10_000.0  # that fill a pixel after the phone's own averaging: 1.4 % noise at 0.5
READ_NOISE = 3.0  # electrons
EXIF_IFD = 0x8769
SHUTTER_S, F_NUMBER = 1 / 30, 1.85
ROOM_ISO, DARK_ISO = 50, 250
CLOCK = "2024:05:04 {:02d}:{:02d}:{:02d}"
START_S, BETWEEN_S = 10 * 3600, 7


@dataclass(frozen=True)
class PhotoFile:
    """Name and moment of one photo."""

    path: Path
    number: int  # in the order taken
    iso: int


def developed(linear: Float[np.ndarray, "height width 3"], setup: Setup, rng: np.random.Generator) -> np.ndarray:
    """Return the 8-bit sRGB picture of the sensor's counts."""
    exposure = setup.exposure
    if exposure.lens_blur > 0:
        linear = cv2.GaussianBlur(linear, (0, 0), exposure.lens_blur)
    if exposure.noise > 0:
        variance = np.maximum(linear, 0) / ELECTRONS + (READ_NOISE / ELECTRONS) ** 2
        linear = linear + exposure.noise * np.sqrt(variance) * rng.standard_normal(linear.shape)
    return encode_srgb(linear.astype(np.float32))


def write_photo(file: PhotoFile, pixels: np.ndarray, setup: Setup) -> None:
    """Write the JPEG file with the metadata that a phone adds."""
    second = START_S + BETWEEN_S * file.number
    taken = CLOCK.format(second // 3600, second // 60 % 60, second % 60)
    tags = Image.Exif()
    tags.update({271: "Generated", 272: "Simulated phone", 274: 1, 306: taken})
    height, width = pixels.shape[:2]
    details = {33434: SHUTTER_S, 33437: F_NUMBER, 34855: file.iso, 36867: taken, 36868: taken, 37385: 16}
    details |= {37386: setup.phone.focal / 5.5, 41989: round(setup.phone.focal), 40962: width, 40963: height}
    tags.get_ifd(EXIF_IFD).update(details)
    file.path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(file.path, quality=setup.exposure.jpeg, subsampling=0, exif=tags.tobytes())
