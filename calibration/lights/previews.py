"""A few small pictures of a scene: enough for one number about all of it."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from capture.photos.photo import PhotoStack, read_stack

LONG_SIDE = 128  # px
MOST_PHOTOS = 24  # evenly chosen: large photos take half a second each


def preview(photos: Sequence[Path], is_linear: bool = False) -> PhotoStack:
    """At most MOST_PHOTOS of the photos, LONG_SIDE px long.

    Raises:
        CaptureError: as read_stack.
    """
    chosen = np.unique(np.linspace(0, len(photos) - 1, min(len(photos), MOST_PHOTOS)).round().astype(int))
    return read_stack([photos[i] for i in chosen], LONG_SIDE, as_linear=is_linear)
