"""Decode JPEG and PNG pictures of strangers' run folders: thumbnails and masks.

The pictures of a capture are the person's own; those of a run folder may come from anybody, so they are decoded in the
confined process, after a check of the size in their header.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from capture.decode.limits import broken, check_size, colour_of
from capture.decode.sandbox import Answer, decoding, header_of
from capture.errors import CaptureError
from capture.files.regular import open_regular, why

FORMATS = ("JPEG", "PNG")
LARGEST_FILE = 256 << 20  # bytes
CHANNELS = 3
Image.preinit()  # imports Pillow's formats now: the confined process can open no file later


def read_small_picture(path: Path, most_pixels: int) -> UInt8[np.ndarray, "height width 3"]:
    """Return a JPEG or PNG as 8-bit RGB.

    Args:
        most_pixels: that it may have by its header.

    Raises:
        CaptureError: it is no regular file, no such picture, damaged, or too large.
    """
    try:
        file = open_regular(path, LARGEST_FILE)
    except OSError as error:
        raise CaptureError(f"{path} cannot be read ({why(error)}). Make the result again.") from error
    with file, decoding(small_picture, path, opened=file) as answer:
        width, height = header_of(path, answer(), 2)
        check_size(path, width, height)
        if width * height > most_pixels:
            size = f"{width} x {height} pixels, at most {most_pixels:,} pixels were needed"
            raise CaptureError(f"{path} is {size}. Make the result again.")
        found = answer(CHANNELS * width * height, width * height)
    pixels = colour_of(path, found and found.pixels)
    if pixels.shape[:2] != (height, width) or pixels.dtype != np.uint8:
        raise broken(path, "another size than its header's")
    return pixels


def small_picture(file: BinaryIO) -> Iterator[Answer]:
    """Task: answer (width, height), then the pixels as 8-bit RGB.

    Raises:
        OSError, SyntaxError, ValueError, EOFError, TypeError: the file is damaged.
    """
    with Image.open(file, formats=FORMATS) as picture:
        yield Answer(picture.size)
        yield Answer(pixels=np.asarray(picture.convert("RGB")))
