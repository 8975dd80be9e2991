"""Photos of a phone lying beside a printed board, screen down and its LED lit: two planes seen by a pinhole camera."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from board_photos import board_photo, look_at
from PIL import Image

from calibration.board.board import Board
from calibration.camera import Camera

DOTS = 8  # of the drawing of the phone, per mm
THICKNESS = 9.5  # mm, with a part of the camera's bump
CAMERA = Camera(1600, 1200, 1280.0, 1280.0, 805.0, 594.0)
BOARD = Board("charuco", 5, 7, 24.0, 18.0, "DICT_4X4_50")
FROM_ABOVE = look_at((140.0, -85.0, 480.0), (140.0, -80.0, 0.0))


@dataclass(frozen=True)
class BackOfPhone:
    """What is on the back: millimetres to the right of and above the middle of the body, its top up."""

    led: tuple[float, float] = (-12.0, 52.0)
    lenses: tuple[tuple[float, float, float], ...] = ((-22.0, 60.0, 6.5),)  # x, y, radius of the ring
    shade: float = 95.0  # of the body, 8 bit
    spots: tuple[tuple[float, float], ...] = ()  # reflections of lamps
    is_lit: bool = True


def draw_back(phone: BackOfPhone) -> tuple[np.ndarray, np.ndarray]:
    """The back from above, grey, with the mask of the body; 80 x 160 mm."""
    height, width = 160 * DOTS, 80 * DOTS
    y, x = (np.mgrid[:height, :width] + 0.5) / DOTS
    x, y = x - 40, 80 - y
    corner = np.hypot(np.maximum(abs(x) - 26, 0), np.maximum(abs(y) - 63, 0))
    body = corner < 10
    art = np.full((height, width), phone.shade)
    island = np.hypot(np.maximum(abs(x + 16) - 11, 0), np.maximum(abs(y - 52) - 14, 0)) < 6
    art[island] *= 0.85
    for middle_x, middle_y, radius in phone.lenses:
        r = np.hypot(x - middle_x, y - middle_y) / radius
        art[r < 1] = 150
        art[r < 0.88] = 22
        art[(r < 0.5) & (r > 0.44)] = 45
    for spot_x, spot_y in (phone.led, *phone.spots) if phone.is_lit else phone.spots:
        r = np.hypot(x - spot_x, y - spot_y)
        art = art + 600 * np.exp(-((r / 2.0) ** 2))
    if phone.is_lit:
        art += 25 * np.exp(-np.hypot(x - phone.led[0], y - phone.led[1]) / 8)
    return art, body.astype(np.float64)


def back_photo(phone: BackOfPhone) -> np.ndarray:
    """8-bit photo: the phone lies to the right of the board, top beside top."""
    table = board_photo(BOARD, CAMERA, FROM_ABOVE).astype(np.float64)
    art, body = draw_back(phone)
    matrix = FROM_ABOVE.inverse().matrix()
    plane = np.stack([matrix[:3, 0], matrix[:3, 1], matrix[:3, 2] * THICKNESS + matrix[:3, 3]], 1)
    board_from_phone = np.array([[1, 0, 190.0], [0, 1, -80.0], [0, 0, 1]])
    phone_from_dots = np.array([[1 / DOTS, 0, 0.5 / DOTS - 40], [0, -1 / DOTS, 80 - 0.5 / DOTS], [0, 0, 1]])
    photo_from_dots = CAMERA.matrix() @ plane @ board_from_phone @ phone_from_dots
    size = (CAMERA.width, CAMERA.height)
    blurred = cv2.GaussianBlur(art, (0, 0), 1.5), cv2.GaussianBlur(body, (0, 0), 1.5)
    seen, cover = (cv2.warpPerspective(k, photo_from_dots, size, flags=cv2.INTER_LINEAR) for k in blurred)
    noise = np.random.default_rng(1).normal(0, 2.0, seen.shape)
    return np.clip(table * (1 - cover) + seen * cover + noise, 0, 255).astype(np.uint8)


def save_back(path: Path, photo: np.ndarray) -> Path:
    """The photo as a file in colour."""
    Image.fromarray(np.repeat(photo[..., None], 3, -1)).save(path)
    return path
