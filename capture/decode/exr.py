"""OpenEXR pictures: channels of linear numbers."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import OpenEXR
from jaxtyping import Float

from capture.decode.limits import broken, check_size
from capture.decode.sandbox import Answer, decoding, header_of

MOST_PIXELS = 2**31  # beyond it a header is nonsense; readers allow far less


@dataclass(frozen=True)
class ExrHeader:
    """The content of a file's header; `names` are the channels of its first part."""

    width: int
    height: int
    parts: int
    names: tuple[str, ...]


def exr_header(path: Path) -> ExrHeader:
    """Return size (px) and channels, without reading the pixels.

    Raises:
        CaptureError: no readable OpenEXR file.
    """
    with decoding(exr_picture, path, in_memory=True) as answer:
        return _header(path, answer())


def exr_size(path: Path) -> tuple[int, int]:
    """Return width and height (px) of the stored picture, without reading it.

    Raises:
        CaptureError: no readable OpenEXR file.
    """
    header = exr_header(path)
    return header.width, header.height


def read_exr(path: Path) -> dict[str, Float[np.ndarray, "height width"]]:
    """Return the channels of the first part, by name, float32, read-only.

    Raises:
        CaptureError: no readable OpenEXR file, or larger than PIXEL_CAP.
    """
    with decoding(exr_picture, path, in_memory=True) as answer:
        header = _header(path, answer())
        check_size(path, header.width, header.height)
        count = header.width * header.height
        found = answer(4 * count * len(header.names), count * len(header.names))
    if found is None or found.pixels is None or len(found.pixels) != len(found.names):
        raise broken(path, "no channels")
    return dict(zip(found.names, found.pixels, strict=True))


def colour_channels(channels: Mapping[str, Float[np.ndarray, "height width"]]) -> Float[np.ndarray, "h w 3"] | None:
    """Return R, G and B, or Y for all three; None where there are neither."""
    names = ("R", "G", "B") if {"R", "G", "B"} <= set(channels) else ("Y", "Y", "Y")
    return np.stack([channels[name] for name in names], 2) if names[0] in channels else None


def _header(path: Path, answer: Answer | None) -> ExrHeader:
    width, height, parts = header_of(path, answer, 3)
    if min(width, height) < 1 or width * height > MOST_PIXELS:
        raise broken(path, f"{width} x {height} pixels")
    return ExrHeader(width, height, parts, answer.names if answer else ())


def exr_picture(file: BinaryIO) -> Iterator[Answer]:
    """Task: answer (width, height, parts) and the channels' names, then the channels of the first part, float32.

    Raises:
        OSError, RuntimeError, ValueError, TypeError: the file is no readable OpenEXR file.
    """
    name = file.name if isinstance(file.name, str) else f"/proc/self/fd/{file.fileno()}"  # OpenEXR reads names only
    with OpenEXR.File(name, header_only=True) as exr:
        low, high = exr.header()["dataWindow"]
        names = tuple(str(channel.name) for channel in exr.header()["channels"])
        yield Answer((int(high[0] - low[0] + 1), int(high[1] - low[1] + 1), len(exr.parts)), names)
    with OpenEXR.File(name, separate_channels=True) as exr:
        channels = {name: np.asarray(channel.pixels, np.float32) for name, channel in exr.channels().items()}
        yield Answer(names=tuple(channels), pixels=np.stack(list(channels.values())))


def write_exr(path: Path, channels: Mapping[str, Float[np.ndarray, "height width"]], header: Mapping[str, Any]) -> None:
    """Write channels of 32-bit floats, by name, with lossless compression.

    Args:
        header: further attributes, such as "comments".

    Raises:
        OSError, RuntimeError: the file cannot be written.
    """
    compressed: dict[str, Any] = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    pixels = {name: np.ascontiguousarray(values, np.float32) for name, values in channels.items()}
    with OpenEXR.File(compressed | dict(header), pixels) as file:
        file.write(str(path))
