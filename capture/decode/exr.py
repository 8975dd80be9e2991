"""OpenEXR pictures: channels of linear numbers.

read_panorama: an environment map (.hdr or .exr) from untrusted bytes, checked before it is decoded.
"""

import re
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
import OpenEXR
from jaxtyping import Float

from capture.decode.limits import BrokenFile, broken, check_size
from capture.decode.sandbox import Answer, decoding, header_of
from capture.errors import CaptureError

MOST_PIXELS = 2**31  # beyond it a header is nonsense; readers allow far less
LARGEST_FILE = 64 * 2**20  # bytes: an uncompressed map of 4096 x 2048 in half floats is 50 MB
LARGEST_PICTURE = 2**23  # pixels, 4096 x 2048: 100 MB once decoded
MOST_CHANNELS = 8  # colour, alpha and a few layers more: memory grows with each
SHAPE = (1.9, 2.1)  # width over height: a map of the whole sphere is twice as wide as high
LEAST_ROWS = 4  # fewer do not show where light comes from
HDR_MAGIC, EXR_MAGIC = b"#?", b"\x76\x2f\x31\x01"
HDR_HEADER = 2**14  # bytes within which a header ends; it is a few lines
SMALLER = "save it with at most 4096 x 2048 pixels (1024 x 512 shows no difference)"


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


def read_panorama(data: bytes, name: str) -> Float[np.ndarray, "rows columns 3"]:
    """Return linear radiance over the sphere: row 0 is around straight up, column j at azimuth 2 pi (j + 0.5) / n.

    Azimuth is counted from +x to +y. In a panorama as photographed, seen from inside, azimuth falls from left to right,
    so its n columns are returned in reverse order.

    Args:
        data: the content of a Radiance .hdr or an OpenEXR file, distinguished by their first bytes.
        name: for messages only.

    Raises:
        CaptureError: the file is of another kind, damaged, too large, not twice as wide as high, or not finite.
    """
    if len(data) > LARGEST_FILE:
        raise CaptureError(
            f"{name}: {len(data) / 2**20:.0f} MB, at most {LARGEST_FILE // 2**20} MB were expected; {SMALLER}."
        )
    if data.startswith(HDR_MAGIC):
        picture = _read_hdr(data, name)
    elif data.startswith(EXR_MAGIC):
        picture = _read_exr(data, name)
    else:
        raise CaptureError(f"{name}: neither a Radiance .hdr nor an OpenEXR file; choose an environment map of these.")
    if not np.isfinite(picture).all():
        bad = int((~np.isfinite(picture)).any(-1).sum())
        raise CaptureError(f"{name}: {bad} pixels are infinite or not a number; save it again with a finite sun.")
    return np.ascontiguousarray(np.maximum(picture, 0)[:, ::-1], dtype=np.float32)


def _check_size(width: int, height: int, name: str) -> None:
    if width * height > LARGEST_PICTURE:
        raise CaptureError(f"{name}: {width} x {height} pixels, at most 4096 x 2048 are read; {SMALLER}.")
    if height < LEAST_ROWS or not SHAPE[0] <= width / height <= SHAPE[1]:
        raise CaptureError(
            f"{name}: {width} x {height} pixels; an environment map shows the whole sphere, twice as wide as high "
            "(equirectangular)."
        )


def _read_hdr(data: bytes, name: str) -> Float[np.ndarray, "rows columns 3"]:
    size = re.search(rb"\n-Y (\d{1,7}) \+X (\d{1,7})\n", data[:HDR_HEADER].replace(b"\r\n", b"\n"))
    if size is None:
        raise CaptureError(f"{name}: the header gives no size of the form '-Y rows +X columns'; save it again.")
    height, width = int(size[1]), int(size[2])
    _check_size(width, height, name)
    try:
        bgr = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_COLOR)
    except cv2.error:
        bgr = None
    if bgr is None or bgr.shape != (height, width, 3):
        raise CaptureError(f"{name}: the pixels cannot be read, the file is cut off or damaged; copy it again.")
    return bgr[..., ::-1].astype(np.float32)


def _read_exr(data: bytes, name: str) -> Float[np.ndarray, "rows columns 3"]:
    with tempfile.TemporaryDirectory(prefix="shadowgraph-") as folder:
        path = Path(folder) / "panorama.exr"  # OpenEXR reads files only; the visitor's own name never reaches the disk
        path.write_bytes(data)
        try:
            header = exr_header(path)
            if header.parts != 1:
                said = f"{header.parts} pictures in one file, one was needed; save the map on its own."
                raise CaptureError(f"{name}: {said}")
            _check_size(header.width, header.height, name)
            if len(header.names) > MOST_CHANNELS:
                said = f"{len(header.names)} channels, at most {MOST_CHANNELS} are read; save it as RGB."
                raise CaptureError(f"{name}: {said}")
            channels = read_exr(path)
        except BrokenFile as error:
            raise CaptureError(f"{name}: not a readable OpenEXR file ({error.reason}); copy it again.") from error
    if (picture := colour_channels(channels)) is None:
        raise CaptureError(f"{name}: channels {', '.join(sorted(channels))}; R, G and B (or Y) were needed.")
    return picture
