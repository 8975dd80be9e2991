"""Uneven ground of a known scene: a depth map of the bare ground, on the grid of the photos."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from calibration.camera import Camera
from capture.decode.exr import exr_size, read_exr
from capture.decode.formats import check_size
from capture.errors import CalibrationError
from capture.files.arrays import read_npy

PATTERN = "floor/*_depth_*"  # of the authors' bumpy scenes
LARGEST_DEPTH = 2**30  # bytes: float64 of 130 megapixels
KINDS = (".exr", ".npy")
FEWEST_KNOWN = 0.02  # of the picture: with less ground nothing can be bounded by shadows on it
NOTHING = 1e6  # renderers write 1e10 or so where they hit nothing


def find_ground_depth(folder: Path) -> Path | None:
    """Return the first floor/*_depth_*.exr or .npy of a scene, by name; None if the ground is a plane."""
    paths = sorted(path for path in folder.glob(PATTERN) if path.suffix.lower() in KINDS)
    return paths[0] if paths else None


def read_ground_depth(path: Path, camera: Camera) -> Float[np.ndarray, "height width"]:
    """Return z-depth of the bare ground at pixel centres, OpenCV camera axes, scene units; nan without ground.

    Args:
        path: .npy, or .exr whose first channel is read.
        camera: of the photos, whose size the map must have.

    Raises:
        CaptureError: not readable.
        CalibrationError: another size than the photos, or hardly any ground in it.
    """
    depth = _read_exr(path) if path.suffix.lower() == ".exr" else read_npy(path, LARGEST_DEPTH)
    if depth.shape != (camera.height, camera.width):
        raise CalibrationError(
            f"{path} is {' x '.join(map(str, depth.shape[::-1]))}, {camera.width} x {camera.height} pixels as the "
            "photos was needed. Render the bare ground with the camera of the photos."
        )
    known = np.isfinite(depth) & (depth > 0) & (depth < NOTHING)
    if known.mean() < FEWEST_KNOWN:
        raise CalibrationError(
            f"{path}: {100 * known.mean():.2g} % of the pixels have a positive, finite depth, {100 * FEWEST_KNOWN:g} % "
            "were needed. It must hold the z-depth of the bare ground in the unit of the scene."
        )
    return np.where(known, depth, np.nan)


def _read_exr(path: Path) -> Float[np.ndarray, "..."]:
    check_size(path, *exr_size(path))
    channels = read_exr(path)
    name = next((n for n in ("Z", "R", "V", "Y", "B") if n in channels), min(channels))
    return channels[name].astype(float)
