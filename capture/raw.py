"""A camera's RAW file as linear numbers."""

from pathlib import Path

import numpy as np
import rawpy
from jaxtyping import Float

LibRawError = rawpy.LibRawError  # what the two functions below raise for files that cannot be decoded


def raw_size(path: Path) -> tuple[int, int]:
    """Width and height of the visible part, without decoding it.

    Raises:
        LibRawError: no RAW file that is known, or a damaged one.
    """
    with rawpy.imread(str(path)) as raw:
        return raw.sizes.width, raw.sizes.height


def read_raw(path: Path) -> Float[np.ndarray, "height width 3"]:
    """Linear sensor colour: black level subtracted, 1.0 = white level, in the sensor's frame.

    (value - black) / (white - black) at every sample, the other two colours by bilinear interpolation. White balance is
    left at 1 1 1, and neither brightness nor white level is adapted to the picture, so every photo has the same scale.

    Raises:
        LibRawError: as `raw_size`.
    """
    with rawpy.imread(str(path)) as raw:
        values = raw.postprocess(
            gamma=(1, 1),
            no_auto_bright=True,
            output_bps=16,
            use_camera_wb=False,
            user_wb=[1, 1, 1, 1],
            output_color=rawpy.ColorSpace.raw,  # pyright: ignore[reportArgumentType]
            demosaic_algorithm=rawpy.DemosaicAlgorithm.LINEAR,
            highlight_mode=rawpy.HighlightMode.Clip,
            user_flip=0,
            adjust_maximum_thr=0.0,
        )
    return values.astype(np.float32) / np.float32(65535)
