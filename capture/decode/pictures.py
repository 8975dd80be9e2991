"""Decode in the confined process: a camera's RAW file to linear sensor colour; TIFF at its bit depth, as it is stored.

JPEG and PNG pictures of strangers' run folders (thumbnails and masks), too: those of a capture are the person's own,
but these may come from anybody.
"""

import mmap
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np
import rawpy
from jaxtyping import Float, Shaped, UInt8
from PIL import Image

from capture.decode.limits import broken, check_size, colour_of
from capture.decode.sandbox import SAMPLES, Answer, decoding, header_of
from capture.errors import CaptureError
from capture.files.regular import open_regular, why

FULL = 65535  # the white level in 16 bits
BYTES_PER_PIXEL = 6
ORIENTATION = 274  # tag
STRIP_ROWS = 256
MOST_BYTES_PER_PIXEL = 16  # float32
FORMATS = ("JPEG", "PNG")
LARGEST_FILE = 256 << 20  # bytes
CHANNELS = 3
Image.preinit()  # imports Pillow's formats now: the confined process can open no file later


def raw_size(path: Path) -> tuple[int, int]:
    """Return width and height (px) of the visible part, without decoding it.

    Raises:
        CaptureError: the file is damaged, or its RAW format is unknown.
    """
    with decoding(raw_picture, path) as answer:
        width, height = header_of(path, answer(), 2)
    return width, height


def read_raw(path: Path) -> Float[np.ndarray, "height width 3"]:
    """Return linear sensor colour, see `raw_picture`; 1.0 is the white level.

    Raises:
        CaptureError: as `raw_size`, or the picture is too large or empty.
    """
    with decoding(raw_picture, path) as answer:
        width, height = header_of(path, answer(), 2)
        check_size(path, width, height)
        found = answer(BYTES_PER_PIXEL * width * height, width * height)
    values = colour_of(path, found and found.pixels)
    if not values.any():
        raise CaptureError(f"{path} has no picture in it: every value is 0. Copy the RAW file again, or remove it.")
    return values / np.float32(FULL)


def raw_picture(file: BinaryIO) -> Iterator[Answer]:
    """Task: answer (width, height) of the visible part, then linear sensor colour, FULL = white level, sensor's frame.

    Every sample is (value - black) / (white - black); its other two colours are interpolated bilinearly. White balance
    is 1 1 1, and brightness and white level are not adapted to the picture, so all photos have the same scale.

    Raises:
        LibRawError: the file is damaged, or its RAW format is unknown.
    """
    with rawpy.imread(file) as raw:  # pyright: ignore[reportArgumentType]
        yield Answer((raw.sizes.width, raw.sizes.height))
        values = raw.postprocess(
            gamma=(1, 1),
            no_auto_bright=True,
            output_bps=16,
            use_camera_wb=False,
            user_wb=[1, 1, 1, 1],
            output_color=rawpy.ColorSpace.raw,  # pyright: ignore[reportArgumentType]
            demosaic_algorithm=rawpy.DemosaicAlgorithm.LINEAR,
            highlight_mode=rawpy.HighlightMode.Clip,
            user_flip=0,
            adjust_maximum_thr=0.0,
        )
    yield Answer(pixels=values)


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
