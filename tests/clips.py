"""A filmed capture: room light and the board, somebody's arm, then a flashlight that moves around in the dark."""

from pathlib import Path

import cv2
import lit_table
import numpy as np

from capture.photos.photo import encode_srgb

FPS = 15.0
ROOM_S, ARM_S, LIT_S, DARK_S = 2.0, 1.0, 8.0, 1.0
TURNS = 1.0  # of the flashlight around the object
SHAKE_AT = (5.0, 7.5)  # s: frames within 0.15 s are blurred


def light_angle(time_s: float) -> float:
    """Where the flashlight is, rad."""
    return 2 * np.pi * TURNS * (time_s - ROOM_S - ARM_S) / LIT_S


def is_blurred(time_s: float) -> bool:
    return min(abs(time_s - at) for at in SHAKE_AT) < 0.15


def film(path: Path) -> Path:
    """The clip, 320 x 240: 2 s of board in room light, 1 s of an arm, 8 s of flashlight, 1 s without light."""
    rng = np.random.default_rng(5)
    albedo = lit_table.table(rng)
    scene = lit_table.with_object(albedo)
    board = lit_table.with_board(albedo, lit_table.TRIPOD_BOARD)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), FPS, (lit_table.WIDTH, lit_table.HEIGHT))
    for time_s in np.arange(0.0, ROOM_S + ARM_S + LIT_S + DARK_S - 1e-9, 1 / FPS):
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


def turn_in_container(path: Path) -> Path:
    """The quarter turn that a phone held upright writes into the track's header."""
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 4 + 40  # version 0: the matrix follows 40 bytes of other fields
    matrix = [0, 1 << 16, 0, -(1 << 16), 0, 0, lit_table.HEIGHT << 16, 0, 1 << 30]
    data[at : at + 36] = b"".join(value.to_bytes(4, "big", signed=True) for value in matrix)
    path.write_bytes(bytes(data))
    return path
