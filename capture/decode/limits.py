"""Checks shared by all readers of photos: impossible picture sizes and damaged files are refused."""

from pathlib import Path

import numpy as np
from jaxtyping import Shaped

from capture.errors import CaptureError

PIXEL_CAP = 200_000_000  # the largest phone sensors have 200 megapixels; a larger header is a mistake or an attack


def check_size(path: Path, width: int, height: int) -> None:
    """Refuse sizes that no camera makes, before memory of that size is allocated.

    Raises:
        CaptureError: more than PIXEL_CAP pixels, or none.
    """
    if min(width, height) < 1 or width * height > PIXEL_CAP:
        raise CaptureError(
            f"{path} is {width} x {height} pixels, at most {PIXEL_CAP // 1_000_000} megapixels can be read. "
            "Export it smaller, all photos alike."
        )


class BrokenFile(CaptureError):
    """A damaged file; `reason` is its decoder's message, in one line."""

    def __init__(self, path: Path, reason: str):
        """Make the sentence that names the file."""
        super().__init__(f"{path} is damaged or cut short ({reason}). Copy it again from the phone, or remove it.")
        self.reason = reason


def broken(path: Path, reason: object) -> BrokenFile:
    """Return the error for a damaged file."""
    return BrokenFile(path, " ".join(str(reason).split()))  # decoders break lines


def colour_of(path: Path, pixels: Shaped[np.ndarray, "..."] | None) -> Shaped[np.ndarray, "height width 3"]:
    """Return the array after a check that it is a picture of three channels.

    Raises:
        CaptureError: it is not.
    """
    if pixels is None or pixels.ndim != 3 or pixels.shape[2] != 3 or not pixels.size:
        raise broken(path, "no picture in it")
    return pixels
