"""Decode photo files to pixels in the sensor's frame; the format is decided by the file's content.

No rotation is applied: EXIF orientation tags are ignored, and the rotation in a HEIC container, which its decoder
applies, is undone. So all photos of one camera have one pixel grid, however the phone was held.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Shaped, UInt8
from PIL import Image

from capture.decode.exr import colour_channels, exr_header, read_exr
from capture.decode.heif import read_heif, read_heif_header
from capture.decode.limits import broken, check_size
from capture.decode.pictures import opencv_channels, raw_size, read_raw, read_tiff
from capture.decode.sandbox import DAMAGED
from capture.decode.video import read_clip, read_frame
from capture.errors import CaptureError
from capture.files.names import clip_of, is_shown

LARGEST_WHOLE = 65_000_000  # pixels: a photo takes 13 bytes for each, and its processing as much again
STRIP_ROWS = 256  # of a picture that is copied piece by piece

Image.MAX_IMAGE_PIXELS = None  # replaced by PIXEL_CAP, tested after every open and before every decode

_DNG_VERSION = 50706  # TIFF tag that only DNG files have
_CAMERA_TAGS = (0x010F, 0x0110, 0x8769)  # Make, Model, the EXIF directory: a camera's own file
_PNG_DEPTH_AT = 24  # byte of the header chunk with the bits per sample
_SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".heic", ".heif", ".hif", ".avif", ".exr"}
_RAW_SUFFIXES = {".dng", ".nef", ".cr2", ".cr3", ".arw", ".raf", ".rw2", ".orf", ".pef", ".srw", ".kdc"}
_RAW_STARTS = (b"IIU\0", b"IIRO", b"IIRS", b"MMOR", b"FUJIFILMCCD-RAW", b"FOVb", b"\0MRM", b"II\x1a\0\0\0HEAPCCDR")
_HEIF_BRANDS = {b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1"}


@dataclass(frozen=True)
class DecodedPhoto:
    """Pixels as stored by the sensor, RGB: uint8 or uint16 encoded as sRGB, or linear float32."""

    pixels: Shaped[np.ndarray, "height width 3"]
    is_linear: bool
    exif: Image.Exif


def is_photo_name(path: Path) -> bool:
    """Return whether a name has the suffix of a photo and is shown."""
    return path.suffix.lower() in _SUFFIXES | _RAW_SUFFIXES and is_shown(path)


def format_of(path: Path, suffix: str | None = None) -> str:
    """Return jpeg, png, tiff, heif, avif, exr or raw, by the file's first bytes; "clip" for the path of a clip's frame.

    Args:
        suffix: of the name that the file will have, where it has another one now.

    Raises:
        CaptureError: the file cannot be read, or has another format.
    """
    if clip_of(path):
        return "clip"
    if path.exists() and not path.is_file():
        raise CaptureError(f"{path} is a folder or a device, a photo's file is needed. Leave it out.")
    try:
        with path.open("rb") as file:
            start = file.read(32)
    except OSError as error:
        raise CaptureError(f"{path} cannot be read ({error.strerror}). Check the file and its permissions.") from error
    is_named_raw = (path.suffix if suffix is None else suffix).lower() in _RAW_SUFFIXES
    kind = _format_of_start(start, path, is_named_raw)
    if kind is None:
        raise _unknown(path, "no photo that can be read" if start else "nothing")
    if is_named_raw and kind != "raw":
        raise _unknown(path, f"{kind.upper()} data under the name of a RAW file")
    return kind


def _format_of_start(start: bytes, path: Path, is_named_raw: bool = False) -> str | None:
    if start.startswith(b"\xff\xd8\xff"):
        return "jpeg"
    if start.startswith(b"\x89PNG\r\n\x1a\n"):
        return "png"
    if start.startswith((b"II*\0", b"MM\0*")):
        is_tiff = not is_named_raw and _DNG_VERSION not in read_exif(path)
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
        "Copy the photo again, or leave it out."
    )


def read_exif(path: Path) -> Image.Exif:
    """Return the file's EXIF tags, without decoding pixels; empty if there are none or they cannot be read."""
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


def states_curve(path: Path) -> bool:
    """Return whether anything tells how the file's numbers follow from light: its format, EXIF, gamma or ICC profile.

    JPEG, HEIC and AVIF are encoded for display, RAW, EXR and floating point are linear; PNG and TIFF may be either.

    Raises:
        CaptureError: the format is unknown.
    """
    if format_of(path) not in ("png", "tiff"):
        return True
    try:
        with Image.open(path) as image:
            told = {"icc_profile", "gamma", "srgb"} & set(image.info)
            return bool(told) or image.mode == "F" or any(tag in image.getexif() for tag in _CAMERA_TAGS)
    except (OSError, SyntaxError, ValueError, KeyError):
        return False  # of a kind that Pillow does not read


def reduction(width: int, height: int) -> int:
    """Return the factor by which a photo is reduced: 2 for very large ones, which keeps memory below 2 GB, else 1.

    Sensors with so many pixels share one colour filter among four of them.
    """
    return 1 if width * height <= LARGEST_WHOLE else 2


def read_size(path: Path) -> tuple[int, int]:
    """Return width and height (px) after `reduction`, from the header; a HEIC container's rotation is not undone.

    Raises:
        CaptureError: the format is unknown, or the file is damaged or larger than PIXEL_CAP.
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
        if kind == "raw":
            return raw_size(path)
        if kind in ("exr", "heif", "avif"):
            header = exr_header(path) if kind == "exr" else read_heif_header(path)
            return header.width, header.height
        if kind == "tiff":  # Pillow opens no float32 in colour
            return _tiff_size(path)
        with Image.open(path) as image:
            return image.size
    except DAMAGED as error:
        raise broken(path, error) from error


def decode(path: Path) -> DecodedPhoto:
    """Decode the whole photo, in the frame in which the sensor stored it.

    Raises:
        CaptureError: the format is unknown, or the file is larger than PIXEL_CAP, damaged, cut short or without pixels.
    """
    decoders = {
        "raw": read_raw,
        "heif": read_heif,
        "avif": read_heif,
        "tiff": lambda path: read_tiff(path, *_tiff_size(path))[0],
        "exr": _decode_exr,
        "clip": lambda path: read_frame(*(clip_of(path) or (path, 0.0))),
    }
    decoder = decoders.get(format_of(path), _decode_picture)
    try:
        pixels = decoder(path)
    except DAMAGED as error:
        raise broken(path, error) from error
    return DecodedPhoto(pixels, pixels.dtype == np.float32, read_exif(path))


def decode_small(path: Path, long_side: int) -> Shaped[np.ndarray, "height width 3"]:
    """Return `decode(path).pixels`; a JPEG is decoded at a fraction of its size that is not below `long_side` px.

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


def _decode_picture(path: Path) -> Shaped[np.ndarray, "height width 3"]:
    """Decode a JPEG or PNG; Pillow ignores its orientation tag, and does not keep 16 bits per channel."""
    with Image.open(path) as image:
        check_size(path, *image.size)
        if image.format != "PNG" or (not image.mode.startswith("I") and _png_depth(path) == 8):
            return _rgb(image)
    return opencv_channels(path.read_bytes())[0]


def _rgb(image: Image.Image) -> UInt8[np.ndarray, "height width 3"]:
    """Return the pixels, copied in strips: Pillow holds four bytes for each, so a second whole copy is avoided."""
    width, height = image.size
    pixels = np.empty((height, width, 3), np.uint8)
    for top in range(0, height, STRIP_ROWS):
        strip = image.crop((0, top, width, min(top + STRIP_ROWS, height)))
        pixels[top : top + STRIP_ROWS] = np.asarray(strip.convert("RGB"))
    return pixels


def stored_channels(
    path: Path,
) -> tuple[Shaped[np.ndarray, "height width 3"], Shaped[np.ndarray, "height width"] | None]:
    """Return colour (RGB) and alpha (None if absent) of a JPEG, PNG or TIFF file, at the file's bit depth.

    Raises:
        CaptureError: as `decode`, or the file has another format.
    """
    kind = format_of(path)
    if kind == "tiff":
        return read_tiff(path, *_tiff_size(path))
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


def _decode_exr(path: Path) -> Float[np.ndarray, "height width 3"]:
    """Decode the colour. The values are linear: negative ones are noise and become 0."""
    channels = read_exr(path)
    if (pixels := colour_channels(channels)) is None:
        raise CaptureError(
            f"{path} has the channels {', '.join(sorted(channels))}; R, G and B, or Y, are needed. Export a picture."
        )
    if not np.isfinite(pixels).all():
        raise CaptureError(f"{path} holds values that are not finite, numbers are needed. Export it again.")
    return np.maximum(pixels, np.float32(0))
