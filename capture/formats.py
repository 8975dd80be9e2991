"""Photo files as pixels in the sensor's frame: what a file is, decided by its content, and how it is decoded.

No rotation is applied, by whatever means it is recorded: EXIF tags are ignored, and the container rotation of HEIC,
which its decoder applies by itself, is undone. So one camera is one grid, however the phone was held.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pillow_heif
from jaxtyping import Float, Shaped
from PIL import Image

from capture.errors import CaptureError
from capture.exr import READ_ERRORS, exr_size, read_exr
from capture.frame_name import clip_of
from capture.heif import container_turns, undo_turns
from capture.raw import LibRawError, raw_size, read_raw
from capture.video import HDR_TRANSFERS, read_clip, read_frame

PIXEL_CAP = 200_000_000  # the largest phone sensors have 200 megapixels; a larger header is a mistake or an attack

Image.MAX_IMAGE_PIXELS = None  # replaced by PIXEL_CAP, tested after every open and before every decode

_DNG_VERSION = 50706  # TIFF tag that only DNG files have
_PNG_DEPTH_AT = 24  # byte of the header chunk with the bits per sample
_SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".heic", ".heif", ".hif", ".avif", ".exr"}
_RAW_SUFFIXES = {".dng", ".nef", ".cr2", ".cr3", ".arw", ".raf", ".rw2", ".orf", ".pef", ".srw", ".kdc"}
_RAW_STARTS = (b"IIU\0", b"IIRO", b"IIRS", b"MMOR", b"FUJIFILMCCD-RAW", b"FOVb", b"\0MRM", b"II\x1a\0\0\0HEAPCCDR")
_HEIF_BRANDS = {b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1"}
_DAMAGED = (OSError, SyntaxError, ValueError, EOFError, cv2.error, LibRawError, *READ_ERRORS)


@dataclass(frozen=True)
class Decoded:
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


def _broken(path: Path, reason: object) -> CaptureError:
    said = " ".join(str(reason).split())  # decoders break lines
    return CaptureError(f"{path} is damaged or cut short ({said}). Copy it again from the phone, or remove it.")


def check_size(path: Path, width: int, height: int) -> None:
    """Refuses sizes that no camera makes, before anything of that size is allocated.

    Raises:
        CaptureError: more than PIXEL_CAP pixels, or fewer than one.
    """
    if not 0 < width * height <= PIXEL_CAP:
        raise CaptureError(
            f"{path} is {width} x {height} pixels, at most {PIXEL_CAP // 1_000_000} megapixels can be read. "
            "Export it smaller, all photos alike."
        )


def read_exif(path: Path) -> Image.Exif:
    """The file's EXIF tags, without decoding pixels; empty where there are none or they cannot be understood."""
    exif = Image.Exif()
    if clip_of(path):
        return exif
    try:
        with path.open("rb") as file:
            start = file.read(4)
        if start in (b"II*\0", b"MM\0*"):  # TIFF and most RAW files: the tags are the file itself
            exif.load(path.read_bytes())
        elif start.startswith((b"\xff\xd8", b"\x89PNG")):
            with Image.open(path) as image:
                exif = image.getexif()
        else:
            with _open_isobmff(path) as image:
                exif = image.getexif()
    except (OSError, SyntaxError, ValueError, KeyError):
        return Image.Exif()
    return exif


def _open_isobmff(path: Path) -> Image.Image:
    pillow_heif.register_heif_opener()
    return Image.open(path)


def read_size(path: Path) -> tuple[int, int]:
    """Width and height from the file's header; a HEIC container's rotation is not undone.

    Raises:
        CaptureError: unknown format, damaged, or larger than PIXEL_CAP.
    """
    kind = format_of(path)
    found = clip_of(path)
    if found:
        clip = read_clip(found[0])
        return clip.width, clip.height
    try:
        if kind == "raw":
            size = raw_size(path)
        elif kind == "exr":
            size = exr_size(path)
        else:
            with _open_isobmff(path) as image:
                size = image.size
    except _DAMAGED as error:
        raise _broken(path, error) from error
    check_size(path, *size)
    return size


def decode(path: Path) -> Decoded:
    """The whole photo, in the frame in which the sensor stored it.

    Raises:
        CaptureError: unknown format, larger than PIXEL_CAP, damaged or cut short, or no pixel data.
    """
    decoders = {
        "raw": _decode_raw,
        "heif": _decode_heif,
        "png": _decode_png,
        "tiff": _decode_tiff,
        "exr": _decode_exr,
        "clip": _decode_clip,
    }
    decoder = decoders.get(format_of(path), _decode_pillow)
    try:
        pixels = decoder(path)
    except _DAMAGED as error:
        raise _broken(path, error) from error
    return Decoded(pixels, pixels.dtype == np.float32, read_exif(path))


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
        raise _broken(path, error) from error


def _decode_pillow(path: Path) -> Shaped[np.ndarray, "height width 3"]:
    """JPEG and AVIF: Pillow leaves their rotation tags alone."""
    with Image.open(path) as image:
        check_size(path, *image.size)
        return np.asarray(image.convert("RGB"))


def _decode_png(path: Path) -> Shaped[np.ndarray, "height width 3"]:
    with Image.open(path) as image:
        check_size(path, *image.size)
        if not image.mode.startswith("I") and path.read_bytes()[_PNG_DEPTH_AT] == 8:
            return np.asarray(image.convert("RGB"))
    return opencv_channels(path.read_bytes())[0]


def _decode_tiff(path: Path) -> Shaped[np.ndarray, "height width 3"]:
    tags = read_exif(path)
    check_size(path, int(tags.get(256, 0)), int(tags.get(257, 0)))
    pixels = opencv_channels(_without_orientation(path.read_bytes()))[0]
    if pixels.dtype == np.float64:
        pixels = pixels.astype(np.float32)
    if pixels.dtype not in (np.uint8, np.uint16, np.float32):
        raise OSError(f"{pixels.dtype} samples")
    return pixels


def _without_orientation(tiff: bytes) -> bytes:
    """The same TIFF with its orientation tag set to 1, because decoders turn the pixels or fail when it is not."""
    order = "little" if tiff[:2] == b"II" else "big"
    first = int.from_bytes(tiff[4:8], order)
    data = bytearray(tiff)
    for at in range(first + 2, first + 2 + 12 * int.from_bytes(tiff[first : first + 2], order), 12):
        if int.from_bytes(tiff[at : at + 2], order) == 274:
            data[at + 8 : at + 10] = (1).to_bytes(2, order)
    return bytes(data)


def opencv_channels(
    file: bytes,
) -> tuple[Shaped[np.ndarray, "height width 3"], Shaped[np.ndarray, "height width"] | None]:
    """Colour (RGB) and alpha (None where there is none) of a PNG or TIFF file, at its own depth.

    Raises:
        OSError: nothing could be decoded.
    """
    stored = cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_UNCHANGED)
    if stored is None:
        raise OSError("no picture could be decoded")
    if stored.ndim == 2:
        return np.repeat(stored[..., None], 3, 2), None
    alpha = stored[..., 3] if stored.shape[2] == 4 else None
    return np.ascontiguousarray(stored[..., 2::-1]), alpha


def _decode_raw(path: Path) -> Float[np.ndarray, "height width 3"]:
    check_size(path, *raw_size(path))
    values = read_raw(path)
    if not values.any():
        raise CaptureError(f"{path} has no picture in it: every value is 0. Copy the RAW file again, or remove it.")
    return values


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


def _decode_heif(path: Path) -> Shaped[np.ndarray, "height width 3"]:
    heif = pillow_heif.open_heif(path, convert_hdr_to_8bit=False)
    check_size(path, *heif.size)
    transfer = HDR_TRANSFERS.get(heif.info.get("nclx_profile", {}).get("transfer_characteristics", 0))
    if transfer:
        raise CaptureError(f"{path} is an HDR photo ({transfer} curve), ordinary sRGB is needed. Switch HDR (HLG) off.")
    pixels = np.asarray(heif)
    pixels = np.repeat(pixels[..., None], 3, 2) if pixels.ndim == 2 else pixels[..., :3]
    return np.ascontiguousarray(undo_turns(pixels, container_turns(path.read_bytes())))
