"""The rotation that a HEIC file carries in its container, read from the boxes and taken back from decoded pixels.

The HEIC decoder applies this rotation and cannot be told not to. EXIF gives an orientation in the same files, but also
in files without it, so only the boxes tell whether the pixels were turned.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Shaped


def container_turns(file: bytes) -> list[tuple[bytes, int]]:
    """How a HEIF decoder turns the primary picture, in order.

    Each is (b"irot", quarter turns anti-clockwise) or (b"imir", 0 top-bottom or 1 left-right), ISO/IEC 23008-12.
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
    """(type, body) of each box of an ISO base media file, ISO/IEC 14496-12."""
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
    """Which properties (1 = the first in ipco) belong to each picture, in the order in which they apply."""
    id_bytes = 2 if ipma[0] == 0 else 4
    index_bytes = 2 if ipma[3] & 1 else 1
    found, at = {}, 8
    for _ in range(int.from_bytes(ipma[4:8], "big")):
        item, count = int.from_bytes(ipma[at : at + id_bytes], "big"), ipma[at + id_bytes]
        at += id_bytes + 1
        raw = [int.from_bytes(ipma[at + i * index_bytes : at + (i + 1) * index_bytes], "big") for i in range(count)]
        found[item] = [value & (0x7FFF if index_bytes == 2 else 0x7F) for value in raw]  # the top bit says "essential"
        at += count * index_bytes
    return found


def undo_turns(
    pixels: Shaped[np.ndarray, "height width channels"], turns: list[tuple[bytes, int]]
) -> Shaped[np.ndarray, "height2 width2 channels"]:
    """The picture before the container's turns, last one first."""
    for name, value in reversed(turns):
        pixels = np.rot90(pixels, -(value & 3)) if name == b"irot" else np.flip(pixels, value & 1)
    return pixels
