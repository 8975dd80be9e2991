"""Decode HEIC and AVIF pictures in the sensor's frame: the rotation in a HEIC container is undone.

The HEIC decoder always applies this rotation. EXIF states an orientation in files with and without it, so only the
container's boxes determine whether the pixels were rotated.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pillow_heif
from jaxtyping import Shaped
from PIL import AvifImagePlugin

from capture.decode.limits import broken, check_size, colour_of
from capture.decode.sandbox import Answer, decoding
from capture.errors import CaptureError

# nclx transfer characteristics (ITU-T H.273)
HDR_TRANSFERS = {16: "PQ", 18: "HLG"}
LIKE_SRGB = {0, 1, 2, 3, 6, 7, 11, 12, 13, 14, 15}  # sRGB, "unspecified", and video's, which cameras state for sRGB
POWERS = {4: 2.2, 5: 2.8, 8: 1.0}  # light is this power of the stored value
MOST_BYTES_PER_PIXEL = 6
AVIF_BRANDS = (b"avif", b"avis")
LARGEST_EXIF = 1 << 22  # bytes; most are 64 kB at most, which JPEG allows
_NO_TRANSFER = 2  # "unspecified"


@dataclass(frozen=True)
class HeifHeader:
    """The content of a file's header; width and height after the container's rotation."""

    width: int
    height: int
    transfer: int  # ITU-T H.273
    exif: bytes


def read_heif_header(path: Path) -> HeifHeader:
    """Return size, transfer curve and EXIF block of a HEIC or AVIF file.

    Raises:
        CaptureError: the file is damaged.
    """
    with decoding(heif_picture, path) as answer:
        return _header(path, answer(LARGEST_EXIF))


def read_heif(path: Path) -> Shaped[np.ndarray, "height width 3"]:
    """Return the pixels of a HEIC or AVIF file, not rotated: 8 or 16-bit as sRGB, or linear float32.

    Raises:
        CaptureError: the file is damaged, too large, HDR, or has another curve that is not known here.
    """
    with decoding(heif_picture, path) as answer:
        header = _header(path, answer(LARGEST_EXIF))
        check_size(path, header.width, header.height)
        if header.transfer not in LIKE_SRGB | set(POWERS):
            curve = HDR_TRANSFERS.get(header.transfer)
            kind = f"is an HDR photo ({curve} curve)" if curve else f"has the transfer curve {header.transfer} of H.273"
            raise CaptureError(f"{path} {kind}, ordinary sRGB is needed. Switch HDR (HLG) off, or export it as sRGB.")
        count = header.width * header.height
        found = answer(MOST_BYTES_PER_PIXEL * count, count)
    pixels = colour_of(path, found and found.pixels)
    power = POWERS.get(header.transfer)
    if power is None or pixels.dtype == np.float32:
        return pixels
    return (pixels / np.float32(np.iinfo(pixels.dtype).max)) ** np.float32(power)


def _header(path: Path, answer: Answer | None) -> HeifHeader:
    if answer is None or len(answer.numbers) != 3 or answer.pixels is None:
        raise broken(path, "no header")
    width, height, transfer = (int(number) for number in answer.numbers)
    return HeifHeader(width, height, transfer, answer.pixels.tobytes())


def heif_picture(file: BinaryIO) -> Iterator[Answer]:
    """Task: answer (width, height, transfer), rotated, and the EXIF block; then the pixels, 8 or 16-bit, not rotated.

    Raises:
        OSError, SyntaxError, ValueError, EOFError, RuntimeError: the file is damaged.
    """
    content = file.read()
    is_avif = content[8:12] in AVIF_BRANDS
    file.seek(0)
    with AvifImagePlugin.AvifImageFile(file) if is_avif else pillow_heif.HeifImageFile(file) as image:
        exif = np.frombuffer((image.info.get("exif") or b"")[:LARGEST_EXIF], np.uint8)
        yield Answer((*image.size, container_transfer(content)), pixels=exif)
        if is_avif:  # Pillow ignores its rotation tags
            yield Answer(pixels=np.asarray(image.convert("RGB")))
            return
    pixels = np.asarray(pillow_heif.open_heif(content, convert_hdr_to_8bit=False))
    pixels = np.repeat(pixels[..., None], 3, 2) if pixels.ndim == 2 else pixels[..., :3]
    yield Answer(pixels=undo_turns(pixels, container_turns(content)))


def container_turns(file: bytes) -> list[tuple[bytes, int]]:
    """Return the rotations and flips that a HEIF decoder applies to the primary picture, in order.

    Each is (b"irot", quarter turns anti-clockwise) or (b"imir", 0 top-bottom or 1 left-right) [ISO/IEC 23008-12].
    """
    return [(name, body[0]) for name, body in _properties(_meta(file)) if name in (b"irot", b"imir") and body]


def container_transfer(file: bytes) -> int:
    """Return the transfer characteristics (ITU-T H.273) that the container states for the primary picture or its tiles.

    Pillow keeps them from us in AVIF files. A gain map may state others; it is no part of the picture that is decoded.
    """
    inside = _meta(file)
    for item in (None, *_tiles(inside)):
        colours = [body for name, body in _properties(inside, item) if name == b"colr" and body[:4] == b"nclx"]
        if colours:
            return int.from_bytes(colours[0][6:8], "big")
    return _NO_TRANSFER


def _meta(file: bytes) -> dict[bytes, bytes]:
    return dict(_boxes(next((body[4:] for name, body in _boxes(file) if name == b"meta"), b"")))


def _primary(inside: dict[bytes, bytes]) -> int:
    return int.from_bytes(inside.get(b"pitm", b"\0" * 6)[4:], "big")


def _properties(inside: dict[bytes, bytes], item: int | None = None) -> list[tuple[bytes, bytes]]:
    """Return the properties (type, body) of a picture, in the order in which they apply; None: of the primary one."""
    iprp = dict(_boxes(inside.get(b"iprp", b"")))
    properties = list(_boxes(iprp.get(b"ipco", b"")))
    used = _associations(iprp.get(b"ipma", b"\0" * 8)).get(_primary(inside) if item is None else item, [])
    return [properties[i - 1] for i in used if 0 < i <= len(properties)]


def _tiles(inside: dict[bytes, bytes]) -> list[int]:
    """Return the pictures that the primary one is put together from."""
    iref = inside.get(b"iref", b"\0" * 4)
    size = 4 if iref[:1] > b"\0" else 2  # bytes of an item's number
    rows = [
        [int.from_bytes(body[at : at + size], "big") for at in (0, *range(size + 2, len(body), size))]
        for name, body in _boxes(iref[4:])
        if name == b"dimg"
    ]
    return [item for first, *items in rows if first == _primary(inside) for item in items]


def _boxes(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yield (type, body) of each box of an ISO base media file [ISO/IEC 14496-12]."""
    at = 0
    while at + 8 <= len(data):
        size, head = int.from_bytes(data[at : at + 4], "big"), 8
        if size == 1:
            size, head = int.from_bytes(data[at + 8 : at + 16], "big"), 16
        size = len(data) - at if size == 0 else size
        if size < head:
            return
        yield data[at + 4 : at + 8], data[at + head : at + size]
        at += size


def _associations(ipma: bytes) -> dict[int, list[int]]:
    """Return the properties (1 = the first in ipco) of each picture, in the order in which they apply.

    Raises:
        ValueError: the table is cut short.
    """
    if len(ipma) < 8:
        raise ValueError("a table of properties that is cut short")
    id_bytes = 2 if ipma[0] == 0 else 4
    index_bytes = 2 if ipma[3] & 1 else 1
    found, at = {}, 8
    for _ in range(int.from_bytes(ipma[4:8], "big")):
        if at + id_bytes >= len(ipma):
            raise ValueError("a table of properties that is cut short")
        item, count = int.from_bytes(ipma[at : at + id_bytes], "big"), ipma[at + id_bytes]
        at += id_bytes + 1
        raw = [int.from_bytes(ipma[at + i * index_bytes : at + (i + 1) * index_bytes], "big") for i in range(count)]
        found[item] = [value & (0x7FFF if index_bytes == 2 else 0x7F) for value in raw]  # the top bit means "essential"
        at += count * index_bytes
    return found


def undo_turns(
    pixels: Shaped[np.ndarray, "height width channels"], turns: list[tuple[bytes, int]]
) -> Shaped[np.ndarray, "height2 width2 channels"]:
    """Undo the container's rotations and flips, the last one first."""
    for name, value in reversed(turns):
        pixels = np.rot90(pixels, -(value & 3)) if name == b"irot" else np.flip(pixels, value & 1)
    return pixels
