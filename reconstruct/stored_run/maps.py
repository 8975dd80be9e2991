"""Read the maps and pictures of a run: depth.npy, normal.npy, mask.png, thumbs/*.jpg."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from capture.decode.formats import LARGEST_WHOLE
from capture.decode.pictures import read_small_picture
from capture.errors import CaptureError, ReconstructionError
from capture.files.arrays import parse_npy
from capture.files.regular import is_own_folder, is_regular, read_regular
from reconstruct.stored_run.documents import refusal

DEPTH, NORMALS, MASK, THUMBS = "depth.npy", "normal.npy", "mask.png", "thumbs"
LARGEST_FILE = 1 << 30  # bytes
LARGEST_THUMBNAIL = 1 << 20  # px; ours have a tenth
MOST_PIXELS = 1 << 27  # of all thumbnails that are held at a time: 400 MB
NORMAL_ATOL = 1e-3  # of a normal's length, which is 1 or 0
LARGEST_DEPTH = 1e12  # world length
BRIGHT = 127  # above this a pixel of a mask is inside


@dataclass(frozen=True)
class Maps:
    """What the calibrated camera sees of the result, on the pixels of the photos."""

    depth: Float32[np.ndarray, "height width"]  # z-depth, world length; inf where the object is not seen
    normals: Float32[np.ndarray, "height width 3"]  # unit, world; 0 where the object is not seen
    mask: Bool[np.ndarray, "height width"]


def read_maps(folder: Path, size: tuple[int, int] | None = None) -> Maps:
    """Read depth, normals and mask of a run.

    Args:
        size: height and width (px) that they must have; those of each other unless given.

    Raises:
        UserError: one is missing or damaged, or they are of other sizes.
    """
    depth, normals = _numbers(folder / DEPTH, ()), _numbers(folder / NORMALS, (3,))
    mask = read_mask(folder / MASK)
    sizes = (depth.shape, normals.shape[:2], mask.shape)
    wanted = mask.shape if size is None else size
    if set(sizes) != {wanted}:
        raise ReconstructionError(
            f"{DEPTH}, {NORMALS} and {MASK} in {folder} are {sizes[0]}, {sizes[1]} and {sizes[2]} pixels (rows, "
            f"columns), {wanted} were needed. They have to be of the same photos."
        )
    seen = depth[depth != np.inf]
    if not (seen.min(initial=1) > 0 and seen.max(initial=1) <= LARGEST_DEPTH):  # false of NaN, too
        said = "it holds something else than depths: positive numbers, or inf where no object is seen"
        raise refusal(folder / DEPTH, said)
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.sqrt(np.einsum("hwc,hwc->hw", normals, normals))
    if not ((length == 0) | (np.abs(length - 1) <= NORMAL_ATOL)).all():
        said = "it holds something else than normals: vectors of length 1, or 0 where no object is seen"
        raise refusal(folder / NORMALS, said)
    return Maps(depth, normals, mask)


def read_mask(path: Path) -> Bool[np.ndarray, "height width"]:
    """Read mask.png: True where the camera sees the object.

    Raises:
        CaptureError: it cannot be read.
    """
    return read_small_picture(path, LARGEST_WHOLE)[..., 0] > BRIGHT


def thumbnail_name(photo: str) -> str:
    """Return the file in thumbs/ of a photo, by its name; of a further view by VIEW/NAME, as two may share a name."""
    *view, name = photo.split("/")
    return "-".join([*view, f"{Path(name).stem}.jpg"])


def read_thumbnail(folder: Path, photo: str) -> UInt8[np.ndarray, "height width 3"]:
    """Read the small sRGB picture of a photo, named as thumbnail_name takes it.

    Raises:
        CaptureError: it cannot be read, or is too large for a small copy.
        FileNotFoundError: there is none.
    """
    path = folder / THUMBS / thumbnail_name(photo)
    if not is_own_folder(folder / THUMBS) or "\0" in photo or not is_regular(path):
        raise FileNotFoundError(path)
    return read_small_picture(path, LARGEST_THUMBNAIL)


def read_thumbnails(folder: Path, photos: Iterable[str]) -> dict[str, UInt8[np.ndarray, "height width 3"]]:
    """Read the small pictures of these photos, by their names, as far as they can be read and fit in MOST_PIXELS."""
    found, pixels = {}, 0
    for photo in photos:
        try:
            picture = read_thumbnail(folder, photo)
        except (OSError, CaptureError):
            continue
        pixels += picture.shape[0] * picture.shape[1]
        if pixels > MOST_PIXELS:
            break
        found[photo] = picture
    return found


def _numbers(path: Path, channels: tuple[int, ...]) -> Float32[np.ndarray, "..."]:
    """Read pixels of so many channels from a .npy file of floats."""
    try:
        values = parse_npy(read_regular(path, LARGEST_FILE))
    except Exception as error:
        raise refusal(path, error) from error
    shape = values.shape
    if values.dtype.kind != "f" or len(shape) != 2 + len(channels) or shape[2:] != channels or not values.size:
        raise refusal(path, f"{values.dtype} numbers of shape {shape} were found, pixels of floats were needed")
    if shape[0] * shape[1] > LARGEST_WHOLE:
        raise refusal(path, f"{shape[:2]} pixels were found, at most {LARGEST_WHOLE:,} were needed")
    with np.errstate(over="ignore"):
        return values.astype(np.float32)
