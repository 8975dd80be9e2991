"""Presentation pictures of an object: a still, a video of the turning object, a video of the light moving around it.

Videos are written picture by picture: mp4 that every browser plays, webm, or gif.

Writers raise ReconstructionError for a width or a number of frames that cannot be made, OSError if a file cannot be
written.
"""

from collections.abc import Callable, Iterable, Iterator
from fractions import Fraction
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from capture.errors import ReconstructionError
from capture.photos.photo import encode_srgb
from reconstruct.export.export import Contents, ExportOptions, OnProgress
from reconstruct.render.studio import light_orbit, studio_of, turntable
from reconstruct.stored_run.stored_run import StoredRun

FPS = 30
GIF_FPS = 25  # gif counts in hundredths of a second
H264_QUALITY = "20"  # x264's CRF: no blocks to be seen in even grounds
LOOP_FOREVER = 0
Frames = Iterable[Float[np.ndarray, "height width 3"]]  # linear
Encoded = Iterable[UInt8[np.ndarray, "height width 3"]]  # sRGB
WIDTH = 960  # px, unless another is asked for: two minutes on two cores
WIDTHS = (16, 4096)  # px: what video encoders take
STILL_WIDTH = 1920
STILL_SAMPLES = 64  # shadow rays per pixel: no grain
MAX_FRAMES = 3600  # two minutes


def write_film(path: Path, frames: Frames) -> tuple[int, int]:
    """Write the pictures as a video, by the file's ending: .mp4 (H.264, needs the extra `video`), .webm (VP9), .gif.

    Args:
        frames: one or more of one size, whose sides are even.

    Returns:
        Width and height, px.

    Raises:
        ReconstructionError: the package for .mp4 is not installed, or OpenCV cannot write the .webm.
    """
    pictures = (encode_srgb(frame) for frame in frames)
    first = next(pictures)
    write = {".mp4": _write_mp4, ".webm": _write_webm, ".gif": _write_gif}[path.suffix.lower()]
    write(path, first.shape[:2], chain([first], pictures))
    return first.shape[1], first.shape[0]


def _write_mp4(path: Path, size: tuple[int, int], frames: Encoded) -> None:
    """Write H.264 in 4:2:0, BT.709, with the index at the front, as browsers and phones require."""
    try:
        import av
    except ImportError as error:
        raise ReconstructionError(
            ".mp4 needs the package av, which is not installed: pip install 'shadowgraph[video]'. "
            ".webm and .gif need nothing more."
        ) from error
    with av.open(str(path), "w", options={"movflags": "+faststart"}) as container:
        stream = container.add_stream("libx264", FPS, options={"crf": H264_QUALITY, "preset": "medium"})
        stream.height, stream.width = size
        stream.pix_fmt = "yuv420p"
        stream.time_base = Fraction(1, FPS)
        context = stream.codec_context
        context.color_range, context.colorspace = 1, 1  # 16..235, BT.709
        context.color_primaries = context.color_trc = 1
        for frame in frames:
            picture = av.VideoFrame.from_ndarray(frame, format="rgb24")
            container.mux(stream.encode(picture.reformat(format="yuv420p", dst_colorspace="ITU709")))
        container.mux(stream.encode())


def _write_webm(path: Path, size: tuple[int, int], frames: Encoded) -> None:
    """Write VP9 with OpenCV's encoder, which does not say when it fails: every frame is read back."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"VP90"), FPS, size[::-1])
    if not writer.isOpened():
        raise ReconstructionError(f"{path.name}: this OpenCV writes no WebM. Choose .gif or .mp4.")
    count = 0
    for frame in frames:
        writer.write(np.ascontiguousarray(frame[..., ::-1]))
        count += 1
    writer.release()
    video = cv2.VideoCapture(str(path))
    if sum(1 for _ in iter(video.grab, False)) != count:
        raise ReconstructionError(f"{path.name} does not play back as written. Check the disk, export again.")


def _write_gif(path: Path, size: tuple[int, int], frames: Encoded) -> None:
    """Write a looping GIF with one palette of 256 colours for all pictures, so that nothing flickers."""
    pictures = [Image.fromarray(frame) for frame in frames]
    some = np.concatenate([np.asarray(p)[::4, ::4].reshape(-1, 3) for p in pictures[:: max(1, len(pictures) // 8)]])
    palette = Image.fromarray(some[None]).quantize(256, method=Image.Quantize.MEDIANCUT)
    indexed = [p.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG) for p in pictures]
    indexed[0].save(
        path, save_all=True, append_images=indexed[1:], duration=1000 // GIF_FPS, loop=LOOP_FOREVER, optimize=False
    )


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
