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
from PIL import AvifImagePlugin, Image

from capture.decode.limits import broken, check_size, colour_of
from capture.decode.sandbox import Answer, decoding
from capture.errors import CaptureError

HDR_TRANSFERS = {16: "PQ", 18: "HLG"}  # nclx transfer characteristics (ITU-T H.273) far from the sRGB curve
MOST_BYTES_PER_PIXEL = 6
AVIF_BRANDS = (b"avif", b"avis")
LARGEST_EXIF = 1 << 22  # bytes; most are 64 kB at most, which JPEG allows
_NO_TRANSFER = 2  # "unspecified" (ITU-T H.273)


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
    """Return the pixels of a HEIC or AVIF file, 8 or 16-bit, not rotated.

    Raises:
        CaptureError: the file is damaged, too large, or HDR.
    """
    with decoding(heif_picture, path) as answer:
        header = _header(path, answer(LARGEST_EXIF))
        check_size(path, header.width, header.height)
        curve = HDR_TRANSFERS.get(header.transfer)
        if curve:
            raise CaptureError(
                f"{path} is an HDR photo ({curve} curve), ordinary sRGB is needed. Switch HDR (HLG) off."
            )
        count = header.width * header.height
        found = answer(MOST_BYTES_PER_PIXEL * count, count)
    return colour_of(path, found and found.pixels)


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
    is_avif = file.read(12)[8:] in AVIF_BRANDS
    file.seek(0)
    with AvifImagePlugin.AvifImageFile(file) if is_avif else pillow_heif.HeifImageFile(file) as image:
        transfer = (image.info.get("nclx_profile") or {}).get("transfer_characteristics", _NO_TRANSFER)
        yield Answer((*image.size, transfer), pixels=_exif_block(image))
        if is_avif:  # Pillow ignores its rotation tags
            yield Answer(pixels=np.asarray(image.convert("RGB")))
            return
    file.seek(0)
    content = file.read()
    pixels = np.asarray(pillow_heif.open_heif(content, convert_hdr_to_8bit=False))
    pixels = np.repeat(pixels[..., None], 3, 2) if pixels.ndim == 2 else pixels[..., :3]
    yield Answer(pixels=undo_turns(pixels, container_turns(content)))


def _exif_block(image: Image.Image) -> Shaped[np.ndarray, " bytes"]:
    block = image.info.get("exif") or b""
    return np.frombuffer(block[:LARGEST_EXIF], np.uint8)


def container_turns(file: bytes) -> list[tuple[bytes, int]]:
    """Return the rotations and flips that a HEIF decoder applies to the primary picture, in order.

    Each is (b"irot", quarter turns anti-clockwise) or (b"imir", 0 top-bottom or 1 left-right) [ISO/IEC 23008-12].
    """
    meta = next((body[4:] for name, body in _boxes(file) if name == b"meta"), b"")
    inside = dict(_boxes(meta))
    primary = int.from_bytes(inside.get(b"pitm", b"\0" * 6)[4:], "big")
    iprp = dict(_boxes(inside.get(b"iprp", b"")))
    properties = list(_boxes(iprp.get(b"ipco", b"")))
    indices = _associations(iprp.get(b"ipma", b"\0" * 8)).get(primary, [])
    used = [properties[i - 1] for i in indices if 0 < i <= len(properties)]
    return [(name, body[0]) for name, body in used if name in (b"irot", b"imir") and body]


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
    """Return the properties (1 = the first in ipco) of each picture, in the order in which they apply."""
    id_bytes = 2 if ipma[0] == 0 else 4
    index_bytes = 2 if ipma[3] & 1 else 1
    found, at = {}, 8
    for _ in range(int.from_bytes(ipma[4:8], "big")):
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
