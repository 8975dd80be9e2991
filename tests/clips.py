"""A filmed capture: room light and the board, somebody's arm, then a flashlight that moves around in the dark."""

from pathlib import Path

import cv2
import lit_table
import numpy as np

from capture.photos.photo import encode_srgb

FPS = 15.0
ROOM_S, ARM_S, LIT_S, DARK_S = 2.0, 1.0, 8.0, 1.0
TURNS = 1.0  # of the flashlight around the object
CONTAINERS = (b"moov", b"trak", b"mdia", b"minf", b"stbl")
SHAKE_AT = (5.0, 7.5)  # s: frames within 0.15 s are blurred


def light_angle(time_s: float) -> float:
    """Where the flashlight is, rad."""
    return 2 * np.pi * TURNS * (time_s - ROOM_S - ARM_S) / LIT_S


def is_blurred(time_s: float) -> bool:
    return min(abs(time_s - at) for at in SHAKE_AT) < 0.15


def film(path: Path, fourcc: str = "mp4v", has_room: bool = True, has_dark: bool = True) -> Path:
    """The clip, 320 x 240: 2 s of board in room light, 1 s of an arm, 8 s of flashlight, 1 s without light."""
    rng = np.random.default_rng(5)
    albedo = lit_table.table(rng)
    scene = lit_table.with_object(albedo)
    board = lit_table.with_board(albedo, lit_table.TRIPOD_BOARD)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*fourcc), FPS, (lit_table.WIDTH, lit_table.HEIGHT))
    start = 0.0 if has_room else ROOM_S + ARM_S
    end = ROOM_S + ARM_S + LIT_S + (DARK_S if has_dark else 0)
    for time_s in np.arange(start, end - 1e-9, 1 / FPS):
        if time_s < ROOM_S:
            radiance = 0.8 * board
        elif time_s < ROOM_S + ARM_S:
            radiance = 0.8 * scene
            radiance[:, int(300 - 200 * (time_s - ROOM_S)) :] *= 0.3
        elif time_s < ROOM_S + ARM_S + LIT_S:
            radiance = scene * lit_table.flashlight(light_angle(time_s))
        else:
            radiance = 0.004 * scene
        if is_blurred(time_s):
            radiance = cv2.blur(radiance, (9, 9))
        frame = lit_table.photograph(radiance, rng)
        writer.write(cv2.cvtColor(encode_srgb(frame), cv2.COLOR_RGB2BGR))
    writer.release()
    return path


# --- what phones write and OpenCV does not: edited into the index at the end of an MP4 file -------------------------


def _boxes_around(data: bytes, place: int) -> list[int]:
    """Where the boxes begin that contain a place inside `moov`."""
    at, chain = data.index(b"moov") - 4, []
    while at + 8 <= place:
        size = int.from_bytes(data[at : at + 4], "big")
        if at <= place < at + size:
            chain.append(at)
            if data[at + 4 : at + 8] not in CONTAINERS:
                break
            at += 8
        else:
            at += size
    return chain


def _replaced(data: bytes, start: int, end: int, new: bytes) -> bytes:
    """data[start:end] exchanged, and every box around made as much longer."""
    out = bytearray(data)
    for at in _boxes_around(data, start - 1):
        size = int.from_bytes(data[at : at + 4], "big") + len(new) - (end - start)
        out[at : at + 4] = size.to_bytes(4, "big")
    return bytes(out[:start]) + new + bytes(out[end:])


def turn_in_container(path: Path) -> Path:
    """The quarter turn that a phone held upright writes into the track's header."""
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 4 + 40  # version 0: the matrix follows 40 bytes of other fields
    matrix = [0, 1 << 16, 0, -(1 << 16), 0, 0, lit_table.HEIGHT << 16, 0, 1 << 30]
    data[at : at + 36] = b"".join(value.to_bytes(4, "big", signed=True) for value in matrix)
    path.write_bytes(bytes(data))
    return path


def declare_transfer(path: Path, transfer: int) -> Path:
    """A colour declaration (nclx) with that transfer characteristic, at the end of the index."""
    data = path.read_bytes()
    at = data.index(b"moov") - 4
    end = at + int.from_bytes(data[at : at + 4], "big")
    colour = b"colrnclx" + b"".join(v.to_bytes(2, "big") for v in (9, transfer, 9)) + b"\0"
    path.write_bytes(_replaced(data, end, end, (4 + len(colour)).to_bytes(4, "big") + colour))
    return path
