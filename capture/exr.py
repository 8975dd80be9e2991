"""OpenEXR pictures: channels of linear numbers."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from jaxtyping import Float

READ_ERRORS = (OSError, RuntimeError, ValueError, TypeError)  # what OpenEXR raises for damaged files


def exr_size(path: Path) -> tuple[int, int]:
    """Width and height of the picture that is stored, without reading it.

    Raises:
        READ_ERRORS: no readable OpenEXR file.
    """
    with OpenEXR.File(str(path), header_only=True) as file:
        low, high = file.header()["dataWindow"]
    return int(high[0] - low[0] + 1), int(high[1] - low[1] + 1)


def read_exr(path: Path) -> dict[str, Float[np.ndarray, "height width"]]:
    """The channels of the first part, by name, float32.

    Raises:
        READ_ERRORS: no readable OpenEXR file.
    """
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: np.array(channel.pixels, np.float32) for name, channel in file.channels().items()}


def write_exr(path: Path, channels: Mapping[str, Float[np.ndarray, "height width"]], header: Mapping[str, Any]) -> None:
    """Channels of 32-bit floats, by name, compressed without loss.

    Args:
        header: more attributes, such as "comments".
    """
    compressed: dict[str, Any] = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    pixels = {name: np.ascontiguousarray(values, np.float32) for name, values in channels.items()}
    with OpenEXR.File(compressed | dict(header), pixels) as file:
        file.write(str(path))
