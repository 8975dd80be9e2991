"""Decode frames of a video clip by their time, one in memory at a time, in the sensor's frame.

The decoder is set to ignore the rotation in a clip's container. Times are the frames' own, counted from the first:
phones drop and stretch frames, so that a frame's number does not determine its time.
"""

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np
from jaxtyping import UInt8

from capture.decode.heif import HDR_TRANSFERS
from capture.decode.limits import broken
from capture.decode.sandbox import Answer, Next, Task, decoding
from capture.errors import CaptureError, Remedy

Bgr = UInt8[np.ndarray, "height width 3"]

SAME_TIME_S = 0.0006  # names hold milliseconds; at 960 frames per second neighbours are 0.00104 s apart
SEEK_BEFORE_S = (0.0, 0.5, 2.0, 8.0, math.inf)  # decoders seek by a mean frame rate, and may land too late
LARGEST_FRAME = 50_000_000  # px: six times 4K, more than any phone records
FRAMES_HELD = 4  # times the memory of one picture: a decoder keeps reference frames, and some per core
LONGEST_SEARCH_S = 600.0  # of computing for one frame: without an index a clip is decoded from its start
LARGEST_INDEX = 64_000_000  # bytes of a container's index that are read: hours of film need less
LARGEST_TRACKS = 1_000_000  # bytes of an MKV file that are searched for the description of its tracks
EBML, MKV_CLUSTER = b"\x1a\x45\xdf\xa3", b"\x1f\x43\xb6\x75"
MKV_TRANSFER = b"\x55\xba\x81"  # and its length, one byte

# FFmpeg supports hundreds of formats, most of them untested and used by no camera; an untrusted file may not choose one
# of those. Allowed decoders, with the codes by which containers name them.
CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi"
CODECS = {
    "h264": ("h264", "avc1", "avc3", "x264"),
    "hevc": ("hevc", "hvc1", "hev1", "x265"),
    "mpeg4": ("mp4v", "fmp4", "xvid", "divx", "m4s2"),
    "h263": ("h263", "s263"),
    "mjpeg": ("mjpg", "jpeg", "mjpa"),
    "prores": ("apco", "apcs", "apcn", "apch", "ap4h", "ap4x"),
    "vp8": ("vp80", "vp08"),
    "vp9": ("vp90", "vp09"),
    "av1": ("av01",),
}
CODES = frozenset(code for codes in CODECS.values() for code in codes)
FFMPEG = f"format_whitelist;{CONTAINERS}|codec_whitelist;{','.join((*CODECS, 'libdav1d', 'libvpx', 'libvpx-vp9'))}"


@dataclass(frozen=True)
class Clip:
    """The content of a clip's header."""

    path: Path
    width: int
    height: int
    duration_s: float  # 0 if the container does not state it


def read_clip(path: Path) -> Clip:
    """Return a clip's frame size (px) and duration (s).

    Raises:
        CaptureError: the clip cannot be decoded, has too large frames, or is HDR.
    """
    with _opened(path, clip_frames, 0.0) as (clip, _, _):
        return clip


def frames_of(path: Path, spacing_s: float) -> Iterator[tuple[float, Bgr]]:
    """Yield (time in seconds, frame) from the first to the last frame, at least `spacing_s` apart.

    Raises:
        CaptureError: as `read_clip`, or no frame can be decoded.
    """
    with _opened(path, clip_frames, spacing_s) as (clip, codec, answer):
        has_frames = False
        while found := _frame(clip, answer):
            has_frames = True
            yield found
        if not has_frames:
            raise CaptureError(
                f"no frame of {path} can be decoded (codec {codec}). Set the phone to H.264 or HEVC, or export the "
                "clip in one of these."
            )


def read_frame(path: Path, time_s: float) -> UInt8[np.ndarray, "height width 3"]:
    """Return the frame at a time, sRGB-encoded RGB.

    Raises:
        CaptureError: as `read_clip`, or there is no frame at that time.
    """
    with _opened(path, clip_frame, time_s) as (clip, _, answer):
        found = _frame(clip, answer)
    if found is None:
        raise CaptureError(
            f"{path} has no frame at {time_s:.3f} s that can be decoded. Was the clip replaced?", Remedy.OTHER_FOLDER
        )
    return cv2.cvtColor(found[1], cv2.COLOR_BGR2RGB)


@contextmanager
def _opened(path: Path, task: Task, argument: float) -> Iterator[tuple[Clip, str, Next]]:
    """Yield the clip, its codec, and the function that returns the next frame."""
    if not path.is_file():
        raise CaptureError(f"{path} is not there.", "put it back", Remedy.OTHER_FOLDER)
    _refuse_hdr(path)
    with decoding(task, path, argument) as answer:
        header = answer()
        if header is None or len(header.numbers) != 3 or not all(header.numbers[:2]):
            raise CaptureError(
                f"{path} is no clip that can be decoded, or it is damaged or cut short. Copy it again from the phone, "
                "or remove it."
            )
        width, height = (int(number) for number in header.numbers[:2])
        if not 0 < width * height <= LARGEST_FRAME:
            raise CaptureError(
                f"{path} has frames of {width} x {height} pixels, at most {LARGEST_FRAME // 1_000_000} megapixels "
                "can be read. Export it smaller."
            )
        codec = " ".join(header.names)
        if codec.lower() not in CODES:
            raise CaptureError(
                f"{path} is compressed with {codec or 'an unnamed codec'}, which phones do not use and this program "
                "does not decode. Export it as H.264 or HEVC."
            )
        yield Clip(path, width, height, header.numbers[2]), codec, answer


def _frame(clip: Clip, answer: Next) -> tuple[float, Bgr] | None:
    area = clip.width * clip.height
    found = answer(3 * area, FRAMES_HELD * area, LONGEST_SEARCH_S)
    if found is None:
        return None
    if found.pixels is None or found.pixels.ndim != 3 or found.pixels.dtype != np.uint8 or len(found.numbers) != 1:
        raise broken(clip.path, "no frame")
    return float(found.numbers[0]), found.pixels


# --- in the process that decodes -------------------------------------------------------------------------------------


def clip_frames(file: BinaryIO, spacing_s: float) -> Iterator[Answer]:
    """Task: answer (width, height, duration or 0 if unknown) and the codec; then time and BGR pixels of each frame."""
    capture = _capture(file)
    yield _clip_header(capture)
    due = 0.0
    while capture.grab():
        now = _now(capture)
        if now < due - SAME_TIME_S:
            continue
        found, frame = capture.retrieve()
        if found:
            yield Answer((now,), pixels=np.asarray(frame))
        due = max(due + spacing_s, now)


def clip_frame(file: BinaryIO, time_s: float) -> Iterator[Answer]:
    """Task: answer the header as `clip_frames` does, then the frame at that time if there is one."""
    capture = _capture(file)
    yield _clip_header(capture)
    for before in SEEK_BEFORE_S:
        capture.set(cv2.CAP_PROP_POS_MSEC, max(0.0, 1000 * (time_s - before)))
        if _advance(capture, time_s):
            found, frame = capture.retrieve()
            if found:
                yield Answer((time_s,), pixels=np.asarray(frame))
                return


def _capture(file: BinaryIO) -> cv2.VideoCapture:
    os.environ["OPENCV_FFMPEG_CAPTURE_OPTIONS"] = FFMPEG
    capture = cv2.VideoCapture(file, cv2.CAP_FFMPEG, [])  # pyright: ignore[reportCallIssue, reportArgumentType]
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    return capture


def _clip_header(capture: cv2.VideoCapture) -> Answer:
    if not capture.isOpened():
        return Answer((0, 0, 0.0))
    fps, count = capture.get(cv2.CAP_PROP_FPS), capture.get(cv2.CAP_PROP_FRAME_COUNT)
    is_known = fps > 0 and count > 0 and math.isfinite(count / fps)
    width, height = (int(capture.get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    code = (int(capture.get(cv2.CAP_PROP_FOURCC)) & 0xFFFFFFFF).to_bytes(4, "little").decode("ascii", "replace")
    return Answer((width, height, count / fps if is_known else 0.0), (code.strip(),))


def _now(capture: cv2.VideoCapture) -> float:
    return capture.get(cv2.CAP_PROP_POS_MSEC) / 1000


def _advance(capture: cv2.VideoCapture, time_s: float) -> bool:
    """Decode up to the frame at that time; return False if the clip was already past it, or ends before it."""
    while capture.grab():
        now = _now(capture)
        if now > time_s - SAME_TIME_S:
            return now < time_s + SAME_TIME_S
    return False


# --- the curve that a container declares -----------------------------------------------------------------------------


def _refuse_hdr(path: Path) -> None:
    """Refuse PQ and HLG, as far as the container declares them."""
    transfer = HDR_TRANSFERS.get(_transfer(path))
    if transfer:
        raise CaptureError(
            f"{path} is an HDR clip ({transfer} curve), ordinary (SDR) video is needed. Switch HDR video off on the "
            "phone and film again, or export the clip as SDR."
        )


def _transfer(path: Path) -> int:
    """Return the transfer characteristic (ITU-T H.273) that the container declares, 0 if it declares none.

    MP4 and MOV: in a colr box of their index, nclx (ISO/IEC 14496-12, 12.1.5) or QuickTime's nclc; MKV and WebM: in
    TransferCharacteristics before the first cluster (RFC 9559).
    """
    index = _index(path)
    at = max(index.find(b"colrnclx"), index.find(b"colrnclc"))
    if at >= 0:
        return int.from_bytes(index[at + 10 : at + 12], "big")
    with path.open("rb") as file:
        head = file.read(LARGEST_TRACKS)
    if not head.startswith(EBML):
        return 0
    at = head.partition(MKV_CLUSTER)[0].find(MKV_TRANSFER)
    return head[at + len(MKV_TRANSFER)] if at >= 0 else 0


def _index(path: Path) -> bytes:
    """Return the moov box of an MP4 or MOV file, wherever it is; empty for other files."""
    with path.open("rb") as file:
        while len(head := file.read(16)) == 16:
            size, name, used = int.from_bytes(head[:4], "big"), head[4:8], 16
            if size == 1:
                size = int.from_bytes(head[8:], "big")
            if name == b"moov":
                return head[8:] + file.read(min(max(size - used, 0), LARGEST_INDEX))
            if size < 8 or not name.isalnum():
                return b""
            file.seek(size - used, 1)
    return b""
