"""Presentation pictures of an object: a still, a video of the turning object, a video of the light moving around it.

Writers raise ReconstructionError for a width or a number of frames that cannot be made, OSError if a file cannot be
written.
"""

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image

from capture.errors import ReconstructionError
from capture.photos.photo import encode_srgb
from reconstruct.export.export import Contents, ExportOptions, OnProgress, reading_back
from reconstruct.export.video import FPS, Frames, film_size, write_film
from reconstruct.render.studio import light_orbit, studio_of, turntable
from reconstruct.stored_run.stored_run import StoredRun

WIDTH = 960  # px, unless another is asked for: two minutes on two cores
WIDTHS = (16, 4096)  # px: what video encoders take
STILL_WIDTH = 1920
STILL_SAMPLES = 64  # shadow rays per pixel: no grain
MAX_FRAMES = 3600  # two minutes


def turn(run: StoredRun, path: Path, options: ExportOptions, on_progress: OnProgress) -> None:
    """Write a video of the object turning once in front of camera and lamp."""
    _film(run, path, options, on_progress, turntable)


def orbit(run: StoredRun, path: Path, options: ExportOptions, on_progress: OnProgress) -> None:
    """Write a video, seen from the capture camera, of the lamp moving once around the object."""
    _film(run, path, options, on_progress, light_orbit)


def still(run: StoredRun, path: Path, options: ExportOptions, on_progress: OnProgress) -> None:
    """Write one picture of the object on even ground, sRGB."""
    on_progress(0, 1, "computing the picture")
    studio, width = studio_of(np.asarray(run.mesh.bounds)), checked_width(options, STILL_WIDTH)
    picture = next(iter(turntable(run.fields, studio, width, 1, options.lamp_size, STILL_SAMPLES)))
    Image.fromarray(encode_srgb(picture)).save(path)


def read(run: StoredRun, path: Path) -> Contents:
    """Read back the contents of a still, or of a video, of which every picture is decoded.

    Raises:
        ReconstructionError: it cannot be decoded.
    """
    if path.suffix.lower() != ".png":
        width, height, frames = film_size(path)
        return Contents(pixels=(width, height), frames=frames, note=f"{frames / FPS:.1f} s, loops")
    with reading_back(path), Image.open(path) as picture:
        picture.load()
        return Contents(pixels=picture.size, note="sRGB")


def checked_width(options: ExportOptions, otherwise: int) -> int:
    """Return the requested width (px), or `otherwise` if none is given.

    Raises:
        ReconstructionError: no picture of that size can be made.
    """
    width = otherwise if options.width is None else options.width
    if not WIDTHS[0] <= width <= WIDTHS[1]:
        raise ReconstructionError(f"a width of {width} px was asked for; {WIDTHS[0]} to {WIDTHS[1]} px can be made.")
    return width


def checked_frames(frames: int) -> int:
    """Return the requested number of frames.

    Raises:
        ReconstructionError: a video cannot have that many.
    """
    if not 2 <= frames <= MAX_FRAMES:
        raise ReconstructionError(f"{frames} pictures were asked for; 2 to {MAX_FRAMES} make a video.")
    return frames


def with_progress(frames: Frames, total: int, on_progress: OnProgress) -> Iterator[np.ndarray]:
    """Yield the same pictures, and report progress at the start and after each."""
    on_progress(0, total, "picture by picture")
    for done, frame in enumerate(frames, start=1):
        yield frame
        on_progress(done, total, "picture by picture")


def _film(
    run: StoredRun,
    path: Path,
    options: ExportOptions,
    on_progress: OnProgress,
    pictures: Callable[..., Iterable[np.ndarray]],
) -> None:
    checked_frames(options.frames)
    studio, width = studio_of(np.asarray(run.mesh.bounds)), checked_width(options, WIDTH)
    make = partial(pictures, run.fields, studio, width, options.frames, options.lamp_size)
    write_film(path, with_progress(make(), options.frames, on_progress))
