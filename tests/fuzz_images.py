"""Pictures that are damaged, odd or not pictures at all, drawn from a seed: what phones, editors and disks produce."""

import io
import random
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import OpenEXR
import pillow_heif
from PIL import Image

pillow_heif.register_heif_opener()
SUFFIXES = (".jpg", ".png", ".tif", ".heic", ".exr", ".avif", ".dng", ".nef", ".webp")
MODES = ("RGB", "L", "RGBA", "CMYK", "1", "P", "I;16", "LA", "F")
FORMATS = {".jpg": "JPEG", ".png": "PNG", ".tif": "TIFF", ".heic": "HEIF", ".avif": "AVIF", ".webp": "WEBP"}


def _pixels(draw: random.Random, mode: str) -> Image.Image:
    width, height = draw.choice([(1, 1), (1, 64), (7, 5), (64, 48), (33, 64), (97, 61)])
    rng = np.random.default_rng(draw.randrange(1 << 30))
    colour = Image.fromarray(rng.integers(0, 256, (height, width, 3), np.uint8))
    if mode == "I;16":
        return Image.fromarray(rng.integers(0, 65536, (height, width), np.uint16))
    return colour.convert(mode)


def whole(draw: random.Random, suffix: str) -> bytes:
    """A picture as its format allows: any mode, rotation tag, ICC profile, more than one frame."""
    if suffix == ".exr":
        return _exr(draw)
    kind = FORMATS.get(suffix, "TIFF")
    data, picture = io.BytesIO(), _pixels(draw, draw.choice(MODES))
    exif = Image.Exif()
    exif[274] = draw.randrange(0, 10)
    options: dict[str, object] = {"exif": exif}
    if draw.random() < 0.3:
        options["icc_profile"] = draw.randbytes(200)
    if draw.random() < 0.2 and kind in ("TIFF", "PNG", "WEBP"):
        options |= {"save_all": True, "append_images": [picture.copy()]}
    try:
        picture.save(data, format=kind, **options)
    except (OSError, ValueError, KeyError):  # a mode that the format has not
        data = io.BytesIO()
        picture.convert("RGB").save(data, format=kind, exif=exif)
    return data.getvalue()


def _exr(draw: random.Random) -> bytes:
    values = np.random.default_rng(draw.randrange(1 << 30)).normal(size=(9, 12)).astype(np.float32)
    values[0, :3] = [draw.choice([np.nan, np.inf, -np.inf, 1e30, 0.0]) for _ in range(3)]
    names = draw.choice([("R", "G", "B"), ("Y",), ("Z",), ("R", "G"), ("A", "B", "G", "R")])
    path = Path("/dev/shm" if Path("/dev/shm").is_dir() else ".") / f"fuzz_{draw.randrange(1 << 60)}.exr"
    kind = draw.choice([np.float32, np.float16])
    with np.errstate(over="ignore"):
        channels = {name: values.astype(kind) for name in names}
    OpenEXR.File({"type": OpenEXR.scanlineimage}, channels).write(str(path))
    data = path.read_bytes()
    path.unlink()
    return data


def cut(draw: random.Random, data: bytes) -> bytes:
    """The beginning of a file."""
    return data[: draw.randrange(len(data) + 1)]


def flipped(draw: random.Random, data: bytes) -> bytes:
    """Some bytes exchanged; more often in the header."""
    out = bytearray(data)
    for _ in range(draw.randrange(1, 20) if out else 0):
        end = min(len(out), 64) if draw.random() < 0.5 else len(out)
        out[draw.randrange(end)] = draw.randrange(256)
    return bytes(out)


def swollen(draw: random.Random, data: bytes) -> bytes:
    """Somewhere a small number is made huge, as sizes and offsets are."""
    out = bytearray(data)
    if len(out) > 8:
        at = draw.randrange(len(out) - 4)
        out[at : at + 4] = struct.pack(
            draw.choice("<>") + "I", draw.choice([0, 0x7FFFFFFF, 0xFFFFFFFF, 30_000, 1 << 24])
        )
    return bytes(out)


def padded(draw: random.Random, data: bytes) -> bytes:
    """Something stands behind the picture, or in its middle."""
    at = draw.choice([len(data), draw.randrange(len(data) + 1)])
    return data[:at] + draw.randbytes(draw.randrange(1, 3000)) + data[at:]


def empty(draw: random.Random, data: bytes) -> bytes:
    """Zeros, noise or nothing of the same length."""
    return draw.choice([b"", bytes(len(data)), draw.randbytes(len(data)), data[:4] + bytes(len(data))])


DAMAGES: tuple[Callable[[random.Random, bytes], bytes], ...] = (cut, flipped, flipped, swollen, padded, empty)


def fuzzed(folder: Path, count: int, seed: int) -> Iterator[Path]:
    """So many files, one at a time, in the folder; every fourth undamaged, one in ten under a wrong ending."""
    for number in range(count):
        draw = random.Random(f"{seed} {number}")
        suffix = draw.choice(SUFFIXES)
        data = whole(draw, suffix)
        for _ in range(draw.choice([0, 1, 1, 2])):
            data = draw.choice(DAMAGES)(draw, data)
        if draw.random() < 0.1:
            suffix = draw.choice(SUFFIXES)
        path = folder / f"fuzz_{number:04d}{suffix}"
        path.write_bytes(data)
        yield path
