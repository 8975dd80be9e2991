"""Decode a camera's RAW file to linear sensor colour."""

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
import rawpy
from jaxtyping import Float

from capture.decode.limits import check_size, colour_of
from capture.decode.sandbox import Answer, decoding, header_of
from capture.errors import CaptureError

FULL = 65535  # the white level in 16 bits
BYTES_PER_PIXEL = 6


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
