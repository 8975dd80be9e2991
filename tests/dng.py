"""A small DNG file with chosen sensor values, written by hand: what RAW decoding is tested against."""

import struct
from pathlib import Path

import numpy as np

SHORT, LONG, BYTE, ASCII, RATIONAL, SIGNED_RATIONAL = 3, 4, 1, 2, 5, 10
SIZES = {SHORT: "H", LONG: "I", BYTE: "B"}


def write_dng(path: Path, mosaic: np.ndarray, black: int, white: int) -> Path:
    """An uncompressed RGGB mosaic of 16-bit values, with its black and white level."""
    height, width = mosaic.shape
    pixels = mosaic.astype("<u2").tobytes()
    identity = [v for row in np.eye(3, dtype=int) for value in row for v in (int(value), 1)]
    entries = [
        (254, LONG, [0]),
        (256, LONG, [width]),
        (257, LONG, [height]),
        (258, SHORT, [16]),
        (259, SHORT, [1]),
        (262, SHORT, [32803]),
        (271, ASCII, b"Test\0"),
        (272, ASCII, b"Sensor\0"),
        (273, LONG, [8]),
        (277, SHORT, [1]),
        (278, LONG, [height]),
        (279, LONG, [len(pixels)]),
        (33421, SHORT, [2, 2]),
        (33422, BYTE, [0, 1, 1, 2]),
        (50706, BYTE, [1, 4, 0, 0]),
        (50708, ASCII, b"Test Sensor\0"),
        (50714, SHORT, [black]),
        (50717, SHORT, [white]),
        (50721, SIGNED_RATIONAL, identity),
        (50728, RATIONAL, [2, 1, 1, 1, 3, 2]),  # an as-shot white balance that must not be applied
        (50778, SHORT, [21]),
    ]
    directory, extra = b"", b""
    first = 8 + len(pixels)
    after = first + 2 + 12 * len(entries) + 4
    for tag, kind, values in entries:
        data = values if isinstance(values, bytes) else _packed(kind, values)
        count = len(values) // (2 if kind in (RATIONAL, SIGNED_RATIONAL) else 1)
        if len(data) > 4:
            directory += struct.pack("<HHII", tag, kind, count, after + len(extra))
            extra += data + b"\0" * (len(data) % 2)
        else:
            directory += struct.pack("<HHI", tag, kind, count) + data.ljust(4, b"\0")
    head = b"II*\0" + struct.pack("<I", first)
    path.write_bytes(head + pixels + struct.pack("<H", len(entries)) + directory + b"\0" * 4 + extra)
    return path


def _packed(kind: int, values: list[int]) -> bytes:
    code = SIZES.get(kind, "i" if kind == SIGNED_RATIONAL else "I")
    return struct.pack(f"<{len(values)}{code}", *values)
