"""Photo files as pixels in the sensor's frame: what a file is, decided by its content, and how it is decoded.

No rotation is applied, by whatever means it is recorded: EXIF tags are ignored, and the container rotation of HEIC,
which its decoder applies by itself, is undone. So one camera is one grid, however the phone was held.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Shaped, UInt8
from PIL import Image

from capture.decode.exr import exr_size, read_exr
from capture.decode.heif import read_heif, read_heif_header
from capture.decode.limits import broken, check_size
from capture.decode.raw import raw_size, read_raw
from capture.decode.sandbox import DAMAGED
from capture.decode.tiff import opencv_channels, read_tiff, read_tiff_alpha
from capture.decode.video import read_clip, read_frame
from capture.errors import CaptureError
from capture.files.names import clip_of

LARGEST_WHOLE = 65_000_000  # pixels: a photo takes 13 bytes for each, and what looks at it as much again
STRIP_ROWS = 256  # of a picture that is taken over piece by piece

Image.MAX_IMAGE_PIXELS = None  # replaced by PIXEL_CAP, tested after every open and before every decode

_DNG_VERSION = 50706  # TIFF tag that only DNG files have
_PNG_DEPTH_AT = 24  # byte of the header chunk with the bits per sample
_SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".heic", ".heif", ".hif", ".avif", ".exr"}
_RAW_SUFFIXES = {".dng", ".nef", ".cr2", ".cr3", ".arw", ".raf", ".rw2", ".orf", ".pef", ".srw", ".kdc"}
_RAW_STARTS = (b"IIU\0", b"IIRO", b"IIRS", b"MMOR", b"FUJIFILMCCD-RAW", b"FOVb", b"\0MRM", b"II\x1a\0\0\0HEAPCCDR")
_HEIF_BRANDS = {b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1"}


@dataclass(frozen=True)
class DecodedPhoto:
    """Pixels as stored by the sensor, RGB: uint8 or uint16 on the sRGB curve, or float32 that is linear already."""

    pixels: Shaped[np.ndarray, "height width 3"]
    is_linear: bool
    exif: Image.Exif


def is_photo_name(path: Path) -> bool:
    """Whether the name ends as photos do and is not hidden."""
    return path.suffix.lower() in _SUFFIXES | _RAW_SUFFIXES and not path.name.startswith(".")


def format_of(path: Path) -> str:
    """One of jpeg, png, tiff, heif, avif, exr, raw, decided by the file's first bytes; or clip, for a frame of one.

    Raises:
        CaptureError: the file cannot be read, or is none of these.
    """
    if clip_of(path):
        return "clip"
    if path.exists() and not path.is_file():
        raise CaptureError(f"{path} is a folder or a device, a photo's file is needed. Remove it from the folder.")
    try:
        with path.open("rb") as file:
            start = file.read(32)
    except OSError as error:
        raise CaptureError(f"{path} cannot be read ({error.strerror}). Check the file and its permissions.") from error
    kind = _format_of_start(start, path)
    if kind is None:
        raise _unknown(path, "no photo that can be read" if start else "nothing")
    if path.suffix.lower() in _RAW_SUFFIXES and kind != "raw":
        raise _unknown(path, f"{kind.upper()} data under the name of a RAW file")
    return kind


def _format_of_start(start: bytes, path: Path) -> str | None:
    if start.startswith(b"\xff\xd8\xff"):
        return "jpeg"
    if start.startswith(b"\x89PNG\r\n\x1a\n"):
        return "png"
    if start.startswith((b"II*\0", b"MM\0*")):
        is_tiff = path.suffix.lower() not in _RAW_SUFFIXES and _DNG_VERSION not in read_exif(path)
        return "tiff" if is_tiff else "raw"
    if start.startswith(_RAW_STARTS):
        return "raw"
    if start.startswith(b"v/1\x01"):
        return "exr"
    if start[4:8] == b"ftyp":
        brand = start[8:12]
        return {b"avif": "avif", b"avis": "avif", b"crx ": "raw"}.get(brand, "heif" if brand in _HEIF_BRANDS else None)
    return None


def _unknown(path: Path, content: str) -> CaptureError:
    return CaptureError(
        f"{path} holds {content}; JPEG, PNG, TIFF, HEIC, AVIF, EXR or a camera's RAW is needed. "
        "Remove it from the folder, or copy the photo again."
    )


def read_exif(path: Path) -> Image.Exif:
    """The file's EXIF tags, without decoding pixels; empty where there are none or they cannot be understood."""
    exif = Image.Exif()
    if clip_of(path):
        return exif
    try:
        with path.open("rb") as file:
            start = file.read(12)
        if start.startswith((b"II*\0", b"MM\0*")):  # TIFF and most RAW files: the tags are the file itself
            exif.load(path.read_bytes())
        elif start.startswith((b"\xff\xd8", b"\x89PNG")):
            with Image.open(path) as image:
                exif = image.getexif()
        elif _format_of_start(start, path) in ("heif", "avif"):
            exif.load(read_heif_header(path).exif)
    except (OSError, SyntaxError, ValueError, KeyError, CaptureError):
        return Image.Exif()
    return exif


def reduction(width: int, height: int) -> int:
    """1; 2 for pictures so large that they are used at half their width and height, which keeps memory below 2 GB.

    Sensors of so many pixels share one colour filter among four of them.
    """
    return 1 if width * height <= LARGEST_WHOLE else 2


def read_size(path: Path) -> tuple[int, int]:
    """Width and height at which the photo is used, from its header; a HEIC container's rotation is not undone.

    Raises:
        CaptureError: unknown format, damaged, or larger than PIXEL_CAP.
    """
    kind = format_of(path)
    found = clip_of(path)
    if found:
        clip = read_clip(found[0])
        return clip.width, clip.height
    width, height = _stored_size(path, kind)
    check_size(path, width, height)
    step = reduction(width, height)
    return width // step, height // step


def _stored_size(path: Path, kind: str) -> tuple[int, int]:
    try:
        if kind == "exr":
            return exr_size(path)
        if kind == "raw":
            return raw_size(path)
        if kind in ("heif", "avif"):
            header = read_heif_header(path)
            return header.width, header.height
        if kind == "tiff":  # Pillow opens no float32 in colour
            return _tiff_size(path)
        with Image.open(path) as image:
            return image.size
    except DAMAGED as error:
        raise broken(path, error) from error


def decode(path: Path) -> DecodedPhoto:
    """The whole photo, in the frame in which the sensor stored it.

    Raises:
        CaptureError: unknown format, larger than PIXEL_CAP, damaged or cut short, or no pixel data.
    """
    decoders = {
        "raw": read_raw,
        "heif": read_heif,
        "avif": read_heif,
        "png": _decode_png,
        "tiff": _decode_tiff,
        "exr": _decode_exr,
        "clip": _decode_clip,
    }
    decoder = decoders.get(format_of(path), _decode_jpeg)
    try:
        pixels = decoder(path)
    except DAMAGED as error:
        raise broken(path, error) from error
    return DecodedPhoto(pixels, pixels.dtype == np.float32, read_exif(path))


def decode_small(path: Path, long_side: int) -> Shaped[np.ndarray, "height width 3"]:
    """As `decode(path).pixels`, but JPEG is decoded at a fraction of its size that is not below `long_side` px.

    Raises:
        CaptureError: as `decode`.
    """
    if format_of(path) != "jpeg":
        return decode(path).pixels
    try:
        with Image.open(path) as image:
            check_size(path, *image.size)
            image.draft("RGB", (long_side, long_side))
            return np.asarray(image.convert("RGB"))
    except (OSError, SyntaxError, ValueError) as error:
        raise broken(path, error) from error


def _decode_jpeg(path: Path) -> Shaped[np.ndarray, "height width 3"]:
    """JPEG: Pillow leaves its rotation tag alone."""
    with Image.open(path) as image:
        check_size(path, *image.size)
        return _rgb(image)


def _rgb(image: Image.Image) -> UInt8[np.ndarray, "height width 3"]:
    """The pixels, without a second copy of them all: Pillow holds four bytes for each."""
    width, height = image.size
    pixels = np.empty((height, width, 3), np.uint8)
    for top in range(0, height, STRIP_ROWS):
        strip = image.crop((0, top, width, min(top + STRIP_ROWS, height)))
        pixels[top : top + STRIP_ROWS] = np.asarray(strip.convert("RGB"))
    return pixels


def _decode_png(path: Path) -> Shaped[np.ndarray, "height width 3"]:
    with Image.open(path) as image:
        check_size(path, *image.size)
        if not image.mode.startswith("I") and _png_depth(path) == 8:
            return _rgb(image)
    return opencv_channels(path.read_bytes())[0]


def stored_channels(
    path: Path,
) -> tuple[Shaped[np.ndarray, "height width 3"], Shaped[np.ndarray, "height width"] | None]:
    """Colour (RGB) and alpha (None where there is none) of a JPEG, PNG or TIFF file, at its own depth.

    Raises:
        CaptureError: as `decode`, or another format.
    """
    kind = format_of(path)
    if kind == "tiff":
        return read_tiff(path, *_tiff_size(path)), read_tiff_alpha(path, *_tiff_size(path))
    if kind not in ("jpeg", "png"):
        raise broken(path, f"{kind.upper()}, where a PNG, TIFF or JPEG is needed")
    read_size(path)
    try:
        return opencv_channels(path.read_bytes())
    except DAMAGED as error:
        raise broken(path, error) from error


def _png_depth(path: Path) -> int:
    with path.open("rb") as file:
        return file.read(_PNG_DEPTH_AT + 1)[_PNG_DEPTH_AT]


def _tiff_size(path: Path) -> tuple[int, int]:
    tags = read_exif(path)
    if 256 not in tags or 257 not in tags:
        raise broken(path, "no size in its tags")
    return int(tags[256]), int(tags[257])


def _decode_tiff(path: Path) -> Shaped[np.ndarray, "height width 3"]:
    return read_tiff(path, *_tiff_size(path))


def _decode_exr(path: Path) -> Float[np.ndarray, "height width 3"]:
    """R, G and B, or Y for all three; linear, so negative values are noise and become 0."""
    check_size(path, *exr_size(path))
    channels = read_exr(path)
    names = ("R", "G", "B") if {"R", "G", "B"} <= set(channels) else ("Y", "Y", "Y")
    if names[0] not in channels:
        raise CaptureError(
            f"{path} has the channels {', '.join(sorted(channels))}; R, G and B, or Y, are needed. Export a picture."
        )
    pixels = np.stack([channels[name] for name in names], 2)
    if not np.isfinite(pixels).all():
        raise CaptureError(f"{path} holds values that are not finite, numbers are needed. Export it again.")
    return np.maximum(pixels, np.float32(0))


def _decode_clip(path: Path) -> Shaped[np.ndarray, "height width 3"]:
    found = clip_of(path)
    assert found is not None
    return read_frame(*found)
