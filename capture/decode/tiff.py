"""Decode TIFF pictures at their bit depth, in the frame in which they are stored."""

import mmap
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np
from jaxtyping import Shaped

from capture.decode.limits import check_size, colour_of
from capture.decode.sandbox import SAMPLES, Answer, decoding

ORIENTATION = 274  # tag
STRIP_ROWS = 256
MOST_BYTES_PER_PIXEL = 16  # float32


def read_tiff(
    path: Path, width: int, height: int
) -> tuple[Shaped[np.ndarray, "height width 3"], Shaped[np.ndarray, "height width"] | None]:
    """Return RGB of 8 or 16 bits or float32, and alpha (None if absent); width and height (px) are those in its tags.

    Raises:
        CaptureError: the file is too large or damaged, or has samples of another type.
    """
    check_size(path, width, height)
    with decoding(tiff_picture, path) as answer:
        found = answer(MOST_BYTES_PER_PIXEL * width * height, width * height)
    if found is None or found.pixels is None or found.pixels.shape[2:] != (4,):
        return colour_of(path, found and found.pixels), None
    return np.ascontiguousarray(found.pixels[..., :3]), found.pixels[..., 3]


def opencv_channels(
    file: bytes | mmap.mmap,
) -> tuple[Shaped[np.ndarray, "height width 3"], Shaped[np.ndarray, "height width"] | None]:
    """Return colour (RGB) and alpha (None if absent) of a PNG or TIFF file, at the file's bit depth.

    Raises:
        OSError: the file cannot be decoded.
    """
    stored = cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_UNCHANGED)
    if stored is None:
        raise OSError("no picture could be decoded")
    if stored.ndim == 2:
        return np.repeat(stored[..., None], 3, 2), None
    if stored.shape[2] == 4:
        return np.ascontiguousarray(stored[..., 2::-1]), stored[..., 3]
    for top in range(0, len(stored), STRIP_ROWS):  # in place: large pictures are in memory once
        strip = stored[top : top + STRIP_ROWS]
        strip[:] = strip[..., ::-1].copy()
    return stored, None


def tiff_picture(file: BinaryIO) -> Iterator[Answer]:
    """Task: answer RGB, with alpha as a fourth channel if there is one; 8 or 16-bit, or float32.

    Raises:
        OSError: the file cannot be decoded, or has samples of another type.
    """
    data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
    _ignore_orientation(data)
    colour, alpha = opencv_channels(data)
    pixels = colour if alpha is None else np.dstack([colour, alpha])
    if pixels.dtype == np.float64:
        pixels = pixels.astype(np.float32)
    if pixels.dtype.name not in SAMPLES:
        raise OSError(f"{pixels.dtype} samples")
    yield Answer(pixels=pixels)


def _ignore_orientation(tiff: mmap.mmap) -> None:
    """Set the orientation tag in memory to 1, because decoders rotate the pixels or fail; the file is unchanged."""
    order = "little" if tiff[:2] == b"II" else "big"
    first = int.from_bytes(tiff[4:8], order)
    end = first + 2 + 12 * int.from_bytes(tiff[first : first + 2], order)
    for at in range(first + 2, min(end, len(tiff) - 11), 12):
        if int.from_bytes(tiff[at : at + 2], order) == ORIENTATION:
            tiff[at + 8 : at + 10] = (1).to_bytes(2, order)
