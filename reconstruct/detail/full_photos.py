"""Photos at full resolution, read one at a time: object pixels go to a file on disk and are read back in blocks."""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from capture.errors import CaptureError, Remedy
from capture.files.atomic import TEMPORARY
from capture.photos.photo import Photo, PhotoStack, gain_of, read_photo
from reconstruct.detail.surface import Window

CHANNELS = 3
BYTES_PER_SAMPLE = 2  # float16: its step, 1 part in 1000, is below that of an 8-bit photo


@dataclass(frozen=True)
class FullPhotos:
    """The photo files, and the corrections that a stack of their smaller copies received."""

    paths: tuple[Path, ...]  # in the order of a scene's photos
    gains: Float[np.ndarray, " photos"]  # exposure that each was divided by
    balance: Float[np.ndarray, "photos 3"]  # white balance that each was divided by after that
    dark: tuple[Path, ...] = ()  # photos without flashlight; their mean was taken off between the two
    reference: float | None = None  # of the stack: what the dark ones' exposure relates to
    as_linear: bool = False  # the files hold linear numbers


def full_photos(
    stack: PhotoStack, names: Sequence[str], dark: tuple[Path, ...] = (), as_linear: bool = False
) -> FullPhotos:
    """Return the files and corrections of some of a stack's photos, by name."""
    place = {path.name: i for i, path in enumerate(stack.paths)}
    chosen = [place[name] for name in names]
    balance = np.ones((len(stack.paths), CHANNELS)) if stack.balance is None else stack.balance
    paths, gains = tuple(stack.paths[i] for i in chosen), np.array(stack.gains)[chosen]
    return FullPhotos(paths, gains, balance[chosen], dark, stack.reference, as_linear)


class PixelFile:
    """A temporary file of linear colours of n pixels in every photo; nan where saturated. Deleted when closed."""

    def __init__(self, folder: Path, photos: int, pixels: int):
        """Create an empty file in a folder with room for photos * pixels * 6 bytes."""
        self.photos, self.pixels = photos, pixels
        self._file = tempfile.TemporaryFile(dir=folder, prefix=".detail", suffix=TEMPORARY)  # noqa: SIM115 (close)

    def __enter__(self) -> "PixelFile":
        return self

    def __exit__(self, *error: object) -> None:
        self._file.close()

    def append(self, colours: Float[np.ndarray, "n 3"]) -> None:
        """Append the linear colours of the next photo.

        Raises:
            OSError: the disk is full.
        """
        self._file.write(colours.astype(np.float16).tobytes())

    def read(self, part: slice) -> Float[np.ndarray, "n photos 3"]:
        """Read some pixels in every photo."""
        count = min(part.stop, self.pixels) - part.start
        out = np.empty((self.photos, count, CHANNELS), np.float16)
        size = CHANNELS * BYTES_PER_SAMPLE
        for k in range(self.photos):
            self._file.seek((k * self.pixels + part.start) * size)
            data = self._file.read(count * size)
            out[k] = np.frombuffer(data, np.float16).reshape(count, CHANNELS)
        return np.ascontiguousarray(out.transpose(1, 0, 2), np.float32)


def colours_of(
    files: FullPhotos, window: Window, index: Int[np.ndarray, " n"], size: tuple[int, int]
) -> Iterator[Float[np.ndarray, "n 3"]]:
    """Yield linear colours of pixels of the window, photo by photo, corrected as in a stack; nan where saturated.

    Args:
        size: expected width and height of the photos, px.

    Raises:
        CaptureError: a photo cannot be read, or has another size by now.
    """
    ambient = np.zeros((len(index), CHANNELS), np.float32)
    for path in files.dark:
        photo = read_photo(path, files.as_linear)
        colour, _ = _inside(photo, window, index, size)
        ambient += colour / np.float32(gain_of(photo.exposure, files.reference) * len(files.dark))
    for path, gain, balance in zip(files.paths, files.gains, files.balance, strict=True):
        colour, clipped = _inside(read_photo(path, files.as_linear), window, index, size)
        colour = np.maximum(colour / np.float32(gain) - ambient, 0) / balance.astype(np.float32)
        colour[clipped] = np.nan
        yield colour


def _inside(
    photo: Photo, window: Window, index: Int[np.ndarray, " n"], size: tuple[int, int]
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Colour and saturation of pixels of the window."""
    height, width = photo.clipped.shape
    if (width, height) != size:
        raise CaptureError(
            f"{photo.path} is {width} x {height} pixels, {size[0]} x {size[1]} was needed, as when it was calibrated.",
            "put the photos back as they were",
            Remedy.START_AGAIN,
        )
    part = slice(window.top, window.top + window.height), slice(window.left, window.left + window.width)
    return photo.rgb[part].reshape(-1, CHANNELS)[index], photo.clipped[part].reshape(-1)[index]
