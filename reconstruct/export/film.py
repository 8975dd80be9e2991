"""Presentation pictures of an object: a still, a video of the turning object, a video of the light moving around it.

Writers raise ReconstructionError for a width or a number of frames that cannot be made, OSError if a file cannot be
written.
"""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from PIL import Image

from capture.errors import ReconstructionError
from capture.photos.photo import encode_srgb
from reconstruct.export.export import Contents, ExportOptions, OnProgress
from reconstruct.export.video import FPS, Frames, write_film
from reconstruct.render.studio import light_orbit, studio_of, turntable
from reconstruct.stored_run.stored_run import StoredRun

WIDTH = 960  # px, unless another is asked for: two minutes on two cores
WIDTHS = (16, 4096)  # px: what video encoders take
STILL_WIDTH = 1920
STILL_SAMPLES = 64  # shadow rays per pixel: no grain
MAX_FRAMES = 3600  # two minutes


def turn(run: StoredRun, path: Path, options: ExportOptions, on_progress: OnProgress) -> Contents:
    """Write a video of the object turning once in front of camera and lamp."""
    return _film(run, path, options, on_progress, turntable)


def orbit(run: StoredRun, path: Path, options: ExportOptions, on_progress: OnProgress) -> Contents:
    """Write a video, seen from the capture camera, of the lamp moving once around the object."""
    return _film(run, path, options, on_progress, light_orbit)


def still(run: StoredRun, path: Path, options: ExportOptions, on_progress: OnProgress) -> Contents:
    """Write one picture of the object on even ground, sRGB."""
    on_progress(0, 1, "computing the picture")
    studio, width = studio_of(np.asarray(run.mesh.bounds)), checked_width(options.width, STILL_WIDTH)
    picture = next(iter(turntable(run.fields, studio, width, 1, options.lamp_size, STILL_SAMPLES)))
    Image.fromarray(encode_srgb(picture)).save(path)
    return Contents(pixels=(picture.shape[1], picture.shape[0]), note="sRGB")


def checked_width(asked: int | None, otherwise: int) -> int:
    """Return the requested width (px), or `otherwise` if none is given.

    Raises:
        ReconstructionError: no picture of that size can be made.
    """
    width = otherwise if asked is None else asked
    if not WIDTHS[0] <= width <= WIDTHS[1]:
        raise ReconstructionError(f"a width of {width} px was asked for; {WIDTHS[0]} to {WIDTHS[1]} px can be made.")
    return width


def film(path: Path, frames: Frames, total: int, on_progress: OnProgress) -> Contents:
    """Write so many pictures as a video, and report progress at the start and after each.

    Raises:
        ReconstructionError: a video cannot have that many.
    """
    if not 2 <= total <= MAX_FRAMES:
        raise ReconstructionError(f"{total} pictures were asked for; 2 to {MAX_FRAMES} make a video.")

    def counted() -> Iterator[np.ndarray]:
        on_progress(0, total, "picture by picture")
        for done, frame in enumerate(frames, start=1):
            yield frame
            on_progress(done, total, "picture by picture")

    return Contents(pixels=write_film(path, counted()), frames=total, note=f"{total / FPS:.1f} s, loops")


def _film(
    run: StoredRun, path: Path, options: ExportOptions, on_progress: OnProgress, pictures: Callable[..., Frames]
) -> Contents:
    studio, width = studio_of(np.asarray(run.mesh.bounds)), checked_width(options.width, WIDTH)
    frames = pictures(run.fields, studio, width, options.frames, options.lamp_size)
    return film(path, frames, options.frames, on_progress)
