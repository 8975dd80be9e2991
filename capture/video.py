"""Frames of a video clip by their time, one in memory at a time, in the sensor's frame.

A clip's rotation lies in its container, as in HEIC; the decoder is told to leave it alone. Times are those of the
frames themselves, counted from the first: phones drop and stretch frames, so a frame's number says little.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from capture.errors import CaptureError

Bgr = UInt8[np.ndarray, "height width 3"]

SAME_TIME_S = 0.0006  # names hold milliseconds; at 960 frames per second neighbours are 0.00104 s apart
SEEK_BEFORE_S = (0.0, 0.5, 2.0, 8.0, math.inf)  # decoders seek by a mean frame rate, and may land too late
LARGEST_FRAME = 50_000_000  # px: six times 4K, more than any phone films
LARGEST_INDEX = 64_000_000  # bytes of a container's index that are read: hours of film need less
LARGEST_TRACKS = 1_000_000  # bytes of an MKV file in which the description of its tracks is sought
EBML, MKV_CLUSTER = b"\x1a\x45\xdf\xa3", b"\x1f\x43\xb6\x75"
MKV_TRANSFER = b"\x55\xba\x81"  # and its length, one byte
HDR_TRANSFERS = {16: "PQ", 18: "HLG"}  # nclx transfer characteristics (ITU-T H.273) far from the sRGB curve


@dataclass(frozen=True)
class Clip:
    """What a clip tells without being decoded."""

    path: Path
    width: int
    height: int
    duration_s: float  # 0 where the container does not say


def read_clip(path: Path) -> Clip:
    """Size and duration.

    Raises:
        CaptureError: no clip that can be decoded, frames too large, or HDR.
    """
    with _opened(path) as capture:
        fps, count = capture.get(cv2.CAP_PROP_FPS), capture.get(cv2.CAP_PROP_FRAME_COUNT)
        known = fps > 0 and count > 0 and math.isfinite(count / fps)
        width, height = (int(capture.get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        return Clip(path, width, height, count / fps if known else 0.0)


def frames_of(path: Path, spacing_s: float) -> Iterator[tuple[float, Bgr]]:
    """(time in seconds, frame) from the first to the last, at least `spacing_s` apart.

    Raises:
        CaptureError: as `read_clip`, or not one frame can be decoded.
    """
    with _opened(path) as capture:
        due, has_frames = 0.0, False
        while capture.grab():
            now = _now(capture)
            if now < due - SAME_TIME_S:
                continue
            found, frame = capture.retrieve()
            if found:
                has_frames = True
                yield now, np.asarray(frame)
            due = max(due + spacing_s, now)
        if not has_frames:
            code = int(capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little").decode("ascii", "replace")
            raise CaptureError(
                f"not one frame of {path} can be decoded (codec {code.strip()}). Set the phone to H.264 or HEVC, "
                "or export the clip so."
            )


def read_frame(path: Path, time_s: float) -> UInt8[np.ndarray, "height width 3"]:
    """The frame of that time, sRGB-encoded RGB.

    Raises:
        CaptureError: as `read_clip`, or no frame has that time.
    """
    with _opened(path) as capture:
        for before in SEEK_BEFORE_S:
            capture.set(cv2.CAP_PROP_POS_MSEC, max(0.0, 1000 * (time_s - before)))
            if _advance(capture, time_s):
                found, frame = capture.retrieve()
                if found:
                    return cv2.cvtColor(np.asarray(frame), cv2.COLOR_BGR2RGB)
    raise CaptureError(
        f"{path} has no frame at {time_s:.3f} s that can be decoded. Was the clip exchanged? Give another --out, "
        "so that its frames are chosen again."
    )


@contextmanager
def _opened(path: Path) -> Iterator[cv2.VideoCapture]:
    if not path.is_file():
        raise CaptureError(f"{path} is not there. Check the folder, or give another --out to choose its frames again.")
    _refuse_hdr(path)
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        size = [int(capture.get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)]
        if not capture.isOpened() or not all(size):
            raise CaptureError(
                f"{path} is no clip that can be decoded, or it is damaged or cut short. Copy it again from the phone, "
                "or remove it."
            )
        if size[0] * size[1] > LARGEST_FRAME:
            raise CaptureError(
                f"{path} has frames of {size[0]} x {size[1]} pixels, at most {LARGEST_FRAME // 1_000_000} megapixels "
                "can be read. Export it smaller."
            )
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        yield capture
    finally:
        capture.release()


def _now(capture: cv2.VideoCapture) -> float:
    return capture.get(cv2.CAP_PROP_POS_MSEC) / 1000


def _advance(capture: cv2.VideoCapture, time_s: float) -> bool:
    """Decode up to the frame of that time; False where the clip was beyond it already, or ends before it."""
    while capture.grab():
        now = _now(capture)
        if now > time_s - SAME_TIME_S:
            return now < time_s + SAME_TIME_S
    return False


def _refuse_hdr(path: Path) -> None:
    """Refuse PQ and HLG, as far as the container declares them."""
    transfer = HDR_TRANSFERS.get(_transfer(path))
    if transfer:
        raise CaptureError(
            f"{path} is an HDR clip ({transfer} curve), ordinary (SDR) video is needed. Switch HDR video off on the "
            "phone and film again, or export the clip as SDR."
        )


def _transfer(path: Path) -> int:
    """The transfer characteristic (ITU-T H.273) that the container declares, 0 where it does not.

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
    """The moov box of an MP4 or MOV file, wherever it stands; empty for other files."""
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
