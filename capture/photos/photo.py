"""Read photo files as linear colour; only this module handles channel order and the sRGB curve.

Orientation: arrays are in the frame in which the sensor stored the photo. EXIF tags never rotate it, and the rotation
in a HEIC container is undone, so photos that a phone took upright and sideways share one camera.
"""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped, UInt8
from PIL import Image

from capture.decode.exif import Exposure, exposure_of, focal_of
from capture.decode.formats import decode, decode_small, read_exif, reduction, stored_channels
from capture.decode.sandbox import stop_decoders
from capture.errors import CaptureError
from capture.files.atomic import atomic_file
from capture.photos.channels import largest_channel, mean_of_channels
from capture.photos.store import PhotoRecord, PhotoStore

CLIPPED_SRGB = 254 / 255  # encoded value from which a sample counts as saturated: JPEG rounds 255 down to 254
CLIPPED_RAW = 0.98  # share of the white level from which a RAW value is no longer trusted to be linear
MAX_READERS = 4  # full photos in memory at the same time
PIXELS_AT_ONCE = 65_000_000  # of these photos together, some 20 bytes each
STRIP_ROWS = 256  # of a picture that is too large to be converted at once
JPEG_QUALITY = 92  # no visible blocks at the size of a report
SLOPE_BELOW = 0.04045  # encoded value where the straight part of the sRGB curve ends (IEC 61966-2-1)


@dataclass(frozen=True)
class Photo:
    """A photo as stored by the sensor (never rotated by its EXIF tag), linear RGB, 1.0 = saturation."""

    rgb: Float[np.ndarray, "height width 3"]
    clipped: Bool[np.ndarray, "height width"]
    exposure: Exposure
    path: Path
    focal_35mm: float | None = None  # 35 mm equivalent focal length, mm
    is_linear: bool = False  # True for RAW: no tone curve had to be assumed


@dataclass(frozen=True)
class PhotoStack:
    """All photos of one fixed camera at a common working size: the input of checks, light fit and solver.

    Relative exposure (EXIF) is divided out, so equal radiance has the same value in every photo.
    """

    rgb: Float[np.ndarray, "photos height width 3"]  # linear float32
    clipped: Bool[np.ndarray, "photos height width"]  # any contributing pixel saturated
    paths: tuple[Path, ...]
    full_width: int  # size of the photos as `read_photo` returns them, px
    full_height: int
    gains: tuple[float, ...]  # divisor of each photo
    reference: float | None = None  # Exposure.relative() of gain 1; None if no photo states its exposure
    balance: Float[np.ndarray, "photos 3"] | None = None  # further divisor of each photo's channels
    focal_35mm: float | None = None  # 35 mm equivalent focal length of the first photo, mm
    is_linear: bool = False  # no photo's tone curve had to be assumed: RAW, or files that hold linear numbers

    @property
    def to_file(self) -> float:
        """Pixels of a file for one of the stack."""
        return self.full_width / self.rgb.shape[2]


def decode_srgb(values: Shaped[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Decode sRGB (IEC 61966-2-1) to linear float32; uint8 is divided by 255, uint16 by 65535, floats are in 0..1."""
    if values.dtype == np.uint8:
        return _SRGB_8[values] if values.ndim < 2 else cv2.LUT(values, _SRGB_8).reshape(values.shape)
    full = 65535 if values.dtype == np.uint16 else 1
    encoded = values.astype(np.float32) / np.float32(full)
    return np.where(encoded <= SLOPE_BELOW, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4).astype(np.float32)


def encode_srgb(linear: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Encode linear values as 8-bit sRGB (IEC 61966-2-1); values outside 0..1 are clipped."""
    return (srgb_of(linear) * 255 + 0.5).astype(np.uint8)


def srgb_of(linear: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Encode linear values as sRGB in 0..1, not rounded; values outside 0..1 are clipped."""
    x = np.clip(linear, 0, 1).astype(np.float32)
    return np.where(x <= SLOPE_BELOW / 12.92, x * 12.92, 1.055 * x ** (1 / 2.4) - 0.055)


_SRGB_8 = decode_srgb(np.arange(256, dtype=np.float32) / np.float32(255))


def read_photo(path: Path, as_linear: bool = False) -> Photo:
    """Read a photo in linear colour, with its saturated pixels and its EXIF exposure.

    8 and 16-bit files are read as sRGB-encoded, float TIFF and RAW as linear. RAW colour is the sensor's own, with one
    fixed white balance for every photo. Pictures of more than 65 megapixels are reduced to half their width and height.

    Args:
        as_linear: 8 and 16-bit files hold linear numbers, as in some scenes of other programs.

    Raises:
        CaptureError: the file is no photo, damaged, larger than 200 megapixels, or a RAW file without picture data.
    """
    decoded = decode(path)
    height, width = decoded.pixels.shape[:2]
    if reduction(width, height) == 1:
        rgb, clipped = _linear(decoded.pixels, as_linear)
    else:
        rgb, clipped = _halved(decoded.pixels, as_linear)
    if decoded.is_linear:
        # Demosaicking mixes each pixel with its neighbours, so the neighbours of saturated pixels are wrong, too.
        clipped = cv2.dilate(clipped.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    return Photo(
        rgb=rgb,
        clipped=clipped,
        exposure=exposure_of(decoded.exif),
        path=path,
        focal_35mm=focal_of(decoded.exif),
        is_linear=decoded.is_linear,
    )


def _linear(
    pixels: Shaped[np.ndarray, "height width 3"], as_linear: bool
) -> tuple[Float[np.ndarray, "height width 3"], Bool[np.ndarray, "height width"]]:
    """Return linear colour, and which pixels have a saturated sample."""
    if pixels.dtype == np.float32:
        return pixels, largest_channel(pixels) >= CLIPPED_RAW
    full = np.iinfo(pixels.dtype).max
    rgb = pixels / np.float32(full) if as_linear else decode_srgb(pixels)
    return rgb, largest_channel(pixels) >= CLIPPED_SRGB * full


def _halved(
    pixels: Shaped[np.ndarray, "height width 3"], as_linear: bool
) -> tuple[Float[np.ndarray, "half_height half_width 3"], Bool[np.ndarray, "half_height half_width"]]:
    """Return the same as `_linear` at half size: means of four pixels, saturated if one sample of them is."""
    height, width = pixels.shape[0] // 2, pixels.shape[1] // 2
    rgb, clipped = np.empty((height, width, 3), np.float32), np.empty((height, width), bool)
    for top in range(0, height, STRIP_ROWS):
        strip = slice(top, min(top + STRIP_ROWS, height))
        colour, saturated = _linear(pixels[2 * top : 2 * strip.stop, : 2 * width], as_linear)
        size = (width, strip.stop - top)
        rgb[strip] = cv2.resize(colour, size, interpolation=cv2.INTER_AREA)
        clipped[strip] = cv2.resize(saturated.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0
    return rgb, clipped


def read_stack(
    paths: Sequence[Path],
    long_side: int,
    reference: float | None = None,
    as_linear: bool = False,
    kept: Path | None = None,
) -> PhotoStack:
    """Read all photos of one fixed camera, area-averaged so that the longer side is at most `long_side` px.

    Relative EXIF exposure is divided out: gain 1 is that of the median photo, and of photos without EXIF.

    Args:
        paths: photos of equal size.
        long_side: px; smaller photos keep their size.
        reference: another stack's `reference`, to bring both to one scale.
        as_linear: as for `read_photo`.
        kept: a folder for the reduced photos of this stack. Photos that it holds are not read again, and the stack is
            mapped from there instead of filling memory. The caller removes it, and must ensure that the files in
            `paths` did not change in the meantime.

    Raises:
        CaptureError: there is no photo, one cannot be read, or they have different pixel sizes.
        OSError: the disk of `kept` is full.
    """
    if not paths:
        raise CaptureError("no photos were given, at least one is needed. Check the capture folder.")
    store = PhotoStore([str(p) for p in paths], kept, {"long_side": long_side, "as_linear": as_linear})

    def fill(index: int) -> None:
        store.put(index, *_read_reduced(paths[index], long_side, as_linear))

    missing = [index for index in range(len(paths)) if index not in store.taken]
    for index in missing[:1]:  # the first photo gives the size of all
        fill(index)
    first = store.taken.get(0)
    with ThreadPoolExecutor(readers_at_once(first.width * first.height if first else 1)) as readers:
        list(readers.map(fill, missing[1:]))
    stop_decoders()
    taken = [store.taken[index] for index in range(len(paths))]
    _refuse_mixed_sizes(paths, [(one.width, one.height) for one in taken])
    gains, reference = _gains([one.exposure for one in taken], reference)
    rgbs, masks = store.arrays()
    for rgb, gain in zip(rgbs, gains, strict=True):
        if gain != 1:
            rgb /= np.float32(gain)
    size, focal = (taken[0].width, taken[0].height), taken[0].focal_35mm
    is_linear = as_linear or all(one.is_linear for one in taken)
    return PhotoStack(rgbs, masks, tuple(paths), *size, gains, reference, None, focal, is_linear)


def readers_at_once(pixels: int) -> int:
    """Return how many photos of so many pixels to read at a time: one per core, but fewer of large photos."""
    return max(1, min(MAX_READERS, os.cpu_count() or 1, PIXELS_AT_ONCE // max(pixels, 1)))


def reduced(stack: PhotoStack, long_side: int) -> PhotoStack:
    """Return the same stack, area-averaged so that the longer side is at most `long_side` px."""
    small = [_reduce(rgb, clipped, long_side) for rgb, clipped in zip(stack.rgb, stack.clipped, strict=True)]
    rgb, clipped = (np.stack(planes) for planes in zip(*small, strict=True))
    return replace(stack, rgb=rgb, clipped=clipped)


def _read_reduced(
    path: Path, long_side: int, as_linear: bool
) -> tuple[Float[np.ndarray, "height width 3"], Bool[np.ndarray, "height width"], PhotoRecord]:
    """Return reduced colour and saturation, and the photo's size and exposure."""
    photo = read_photo(path, as_linear)
    height, width = photo.clipped.shape
    taken = PhotoRecord(width, height, photo.exposure, photo.focal_35mm, photo.is_linear)
    return *_reduce(photo.rgb, photo.clipped, long_side), taken


def _reduce(
    rgb: Float[np.ndarray, "height width 3"], clipped: Bool[np.ndarray, "height width"], long_side: int
) -> tuple[Float[np.ndarray, "small_height small_width 3"], Bool[np.ndarray, "small_height small_width"]]:
    """Return both at most `long_side` px long: a saturated pixel taints every reduced one that it contributes to."""
    if max(clipped.shape) <= long_side:
        return rgb, clipped
    return smaller(rgb, long_side), smaller(clipped.astype(np.float32), long_side) > 0


def smaller(picture: Shaped[np.ndarray, "height width *channels"], long_side: int) -> Shaped[np.ndarray, "..."]:
    """Return a picture, area-averaged so that the longer side is at most `long_side` px."""
    height, width = picture.shape[:2]
    scale = min(1.0, long_side / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return picture if scale == 1 else np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))


def _refuse_mixed_sizes(paths: Sequence[Path], sizes: Sequence[tuple[int, int]]) -> None:
    usual = max(set(sizes), key=sizes.count)
    others = [f"{path.name} ({w} x {h})" for path, (w, h) in zip(paths, sizes, strict=True) if (w, h) != usual]
    if others:
        listed = ", ".join(others[:5]) + (", ..." if len(others) > 5 else "")
        raise CaptureError(
            f"{len(others)} of {len(paths)} photos in {paths[0].parent} are not {usual[0]} x {usual[1]} pixels "
            f"like the others: {listed}. One fixed camera gives one size: remove these photos, "
            "or move them to the folder they belong to."
        )


def _gains(exposures: Sequence[Exposure], reference: float | None) -> tuple[tuple[float, ...], float | None]:
    """Return the divisor of each photo, and the relative exposure of gain 1."""
    relative = [exposure.relative() for exposure in exposures]
    known = [value for value in relative if value is not None]
    if reference is None and known:
        reference = float(np.median(known))
    return tuple(gain_of(exposure, reference) for exposure in exposures), reference


def gain_of(exposure: Exposure, reference: float | None) -> float:
    """Return the divisor that puts a photo on the scale of a stack with that `reference`."""
    relative = exposure.relative()
    return 1.0 if relative is None or reference is None else relative / reference


def read_small_photo(path: Path, long_side: int) -> Photo:
    """Read a photo as `read_photo` does, but at about `long_side` px and fast: a JPEG is decoded at a fraction.

    Raises:
        CaptureError: as `read_photo`.
    """
    pixels = decode_small(path, long_side)
    rgb, clipped = _reduce(*_linear(pixels, False), long_side)
    exif = read_exif(path)
    return Photo(rgb, clipped, exposure_of(exif), path, focal_of(exif), pixels.dtype == np.float32)


def stack_of(photos: Sequence[Photo], full_size: tuple[int, int]) -> PhotoStack:
    """Return photos of one small size as a stack; relative EXIF exposure is divided out, as `read_stack` does.

    Args:
        full_size: width and height of the photos' files, px.
    """
    gains, reference = _gains([photo.exposure for photo in photos], None)
    rgb = np.stack([photo.rgb / np.float32(gain) for photo, gain in zip(photos, gains, strict=True)])
    paths = tuple(photo.path for photo in photos)
    clipped = np.stack([photo.clipped for photo in photos])
    is_linear = all(photo.is_linear for photo in photos)
    return PhotoStack(rgb, clipped, paths, *full_size, gains, reference, None, photos[0].focal_35mm, is_linear)


def read_thumbnail(path: Path, long_side: int) -> UInt8[np.ndarray, "height width 3"]:
    """Read a small 8-bit sRGB copy, about `long_side` px long, in the sensor's frame; fast, for display and comparison.

    Raises:
        CaptureError: as `read_photo`.
    """
    small = smaller(decode_small(path, long_side), long_side)
    if small.dtype == np.float32:
        return encode_srgb(small)
    return small if small.dtype == np.uint8 else (small / np.uint16(257)).astype(np.uint8)


def read_grey(path: Path) -> Float[np.ndarray, "height width"]:
    """Read a visibility map or mask as its stored values in 0..1, no curve applied; colour is averaged, alpha ignored.

    Raises:
        CaptureError: the file does not exist or cannot be decoded.
    """
    return _as_floats(stored_channels(path)[0])


def read_alpha(path: Path) -> Float[np.ndarray, "height width"] | None:
    """Read the alpha channel in 0..1; None for a file without one.

    Raises:
        CaptureError: the file does not exist or cannot be decoded.
    """
    alpha = stored_channels(path)[1]
    return None if alpha is None else _as_floats(alpha[..., None])


def _as_floats(stored: Shaped[np.ndarray, "height width channels"]) -> Float[np.ndarray, "half_height half_width"]:
    """Return the mean of the channels in 0..1, reduced as photos are."""
    height, width = stored.shape[:2]
    step = reduction(width, height)
    full = np.float32(np.iinfo(stored.dtype).max if stored.dtype.kind == "u" else 1)
    grey = np.empty((height // step, width // step), np.float32)
    for top in range(0, len(grey), STRIP_ROWS):
        strip = grey[top : top + STRIP_ROWS]
        values = stored[step * top : step * (top + len(strip)), : step * strip.shape[1]].astype(np.float32) / full
        mean = mean_of_channels(values)
        strip[:] = mean if step == 1 else cv2.resize(mean, strip.shape[::-1], interpolation=cv2.INTER_AREA)
    return grey


def write_picture(path: Path, linear_rgb: Float[np.ndarray, "height width 3"]) -> None:
    """Write linear colour as 8-bit sRGB, JPEG or PNG by the name's ending, atomically.

    Raises:
        OSError: the file cannot be written.
    """
    with atomic_file(path) as temporary:
        Image.fromarray(encode_srgb(linear_rgb)).save(temporary, quality=JPEG_QUALITY)
