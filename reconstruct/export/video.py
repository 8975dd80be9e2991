"""Write videos picture by picture: mp4 that every browser plays, webm, or gif; and read back the size of a video."""

from collections.abc import Iterable, Iterator
from fractions import Fraction
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from capture.errors import ReconstructionError
from capture.photos.photo import encode_srgb

FPS = 30
GIF_FPS = 25  # gif counts in hundredths of a second
H264_QUALITY = "20"  # x264's CRF: no blocks to be seen in even grounds
LOOP_FOREVER = 0
Frames = Iterable[Float[np.ndarray, "height width 3"]]  # linear


def write_film(path: Path, frames: Frames) -> None:
    """Write the pictures as a video, by the file's ending: .mp4 (H.264, needs the extra `video`), .webm (VP9), .gif.

    Args:
        frames: one or more of one size, whose sides are even.

    Raises:
        ReconstructionError: another ending, or the package for .mp4 is not installed.
    """
    writer = {".mp4": _write_mp4, ".webm": _write_webm, ".gif": _write_gif}.get(path.suffix.lower())
    if writer is None:
        raise ReconstructionError(f"{path.name}: a video ends in .mp4, .webm or .gif. Name it so.")
    writer(path, (encode_srgb(frame) for frame in frames))


def can_write_mp4() -> bool:
    """Return True if the package that writes .mp4 is installed."""
    try:
        import av  # noqa: F401 (asked for, not used)
    except ImportError:
        return False
    return True


def film_size(path: Path) -> tuple[int, int, int]:
    """Return width, height (px) and number of pictures of a video file, after decoding every one.

    Raises:
        ReconstructionError: it cannot be decoded.
    """
    if path.suffix.lower() == ".gif":
        with Image.open(path) as picture:
            return picture.width, picture.height, int(getattr(picture, "n_frames", 1))
    video = cv2.VideoCapture(str(path))
    width, height = (int(video.get(key)) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    frames = 0
    while video.grab():
        frames += 1
    video.release()
    if not frames:
        raise ReconstructionError(f"{path.name} does not play back: no picture in it could be read. Export again.")
    return width, height, frames


def _write_mp4(path: Path, frames: Iterator[UInt8[np.ndarray, "height width 3"]]) -> None:
    """Write H.264 in 4:2:0, BT.709, with the index at the front, as browsers and phones require."""
    if not can_write_mp4():
        raise ReconstructionError(
            ".mp4 needs the package av, which is not installed: pip install 'shadowgraph[video]'. "
            ".webm and .gif need nothing more."
        )
    import av

    first = next(frames)
    with av.open(str(path), "w", options={"movflags": "+faststart"}) as container:
        stream = container.add_stream("libx264", FPS, options={"crf": H264_QUALITY, "preset": "medium"})
        stream.height, stream.width = first.shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.time_base = Fraction(1, FPS)
        context = stream.codec_context
        context.color_range, context.colorspace = 1, 1  # 16..235, BT.709
        context.color_primaries = context.color_trc = 1
        for frame in chain([first], frames):
            picture = av.VideoFrame.from_ndarray(frame, format="rgb24")
            container.mux(stream.encode(picture.reformat(format="yuv420p", dst_colorspace="ITU709")))
        container.mux(stream.encode())


def _write_webm(path: Path, frames: Iterator[UInt8[np.ndarray, "height width 3"]]) -> None:
    """Write VP9 with OpenCV's encoder."""
    first = next(frames)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"VP90"), FPS, (first.shape[1], first.shape[0]))
    if not writer.isOpened():
        raise ReconstructionError(f"{path.name}: this OpenCV writes no WebM. Choose .gif or .mp4.")
    for frame in chain([first], frames):
        writer.write(np.ascontiguousarray(frame[..., ::-1]))
    writer.release()


def _write_gif(path: Path, frames: Iterator[UInt8[np.ndarray, "height width 3"]]) -> None:
    """Write a looping GIF with one palette of 256 colours for all pictures, so that nothing flickers."""
    pictures = [Image.fromarray(frame) for frame in frames]
    some = np.concatenate([np.asarray(p)[::4, ::4].reshape(-1, 3) for p in pictures[:: max(1, len(pictures) // 8)]])
    palette = Image.fromarray(some[None]).quantize(256, method=Image.Quantize.MEDIANCUT)
    indexed = [p.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG) for p in pictures]
    indexed[0].save(
        path, save_all=True, append_images=indexed[1:], duration=1000 // GIF_FPS, loop=LOOP_FOREVER, optimize=False
    )
