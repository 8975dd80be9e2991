"""Photos of a textured table as pictures only (no geometry): what role finding and photo checks look at."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from capture.photos.photo import PhotoStack, encode_srgb

HEIGHT, WIDTH = 240, 320


def table(rng: np.random.Generator) -> np.ndarray:
    """Albedo with grain of a few px."""
    grain = cv2.GaussianBlur(rng.normal(0, 1, (HEIGHT, WIDTH)), (0, 0), 1.2)
    return 0.4 * np.exp(0.12 * grain / grain.std())


def with_object(albedo: np.ndarray) -> np.ndarray:
    """A two-coloured ball's outline on the table."""
    out = albedo.copy()
    cv2.circle(out, (170, 110), 30, 0.7, -1)
    cv2.circle(out, (180, 100), 10, 0.2, -1)
    return out


def with_board(albedo: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """A chessboard of 7 x 5 squares with its outer corners at `corners` (4, 2) px."""
    squares = np.indices((7, 9)).sum(0) % 2 * 0.8 + 0.1
    squares[[0, -1]], squares[:, [0, -1]] = 0.9, 0.9  # white rim
    sheet = np.kron(squares, np.ones((10, 10)))
    ends = np.array([[0, 0], [89, 0], [89, 69], [0, 69]], np.float32)
    to_photo = cv2.getPerspectiveTransform(ends, corners.astype(np.float32))
    size = (albedo.shape[1], albedo.shape[0])
    covered = cv2.warpPerspective(np.ones_like(sheet), to_photo, size)
    return albedo * (1 - covered) + cv2.warpPerspective(sheet, to_photo, size) * covered


TRIPOD_BOARD = np.array([[60, 60], [200, 50], [220, 170], [50, 180]])


def flashlight(angle: float, in_shadow: float = 0.05) -> np.ndarray:
    """Irradiance with inverse-square fall-off and the object's shadow away from the light, a share of it in there."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    at = np.array([160 + 150 * np.cos(angle), 120 + 110 * np.sin(angle)])
    light = 1.2 / (1 + ((u - at[0]) ** 2 + (v - at[1]) ** 2) / 150**2) ** 1.5
    tip = np.array([170, 110]) - 0.5 * (at - [170, 110])
    shadow = cv2.line(np.zeros((HEIGHT, WIDTH)), (170, 110), (int(tip[0]), int(tip[1])), 1.0, 40)
    return light * (1 - (1 - in_shadow) * shadow)


def photograph(radiance: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Linear colour with sensor noise."""
    noise = rng.normal(0, 1, radiance.shape) * np.sqrt(1e-4 * np.maximum(radiance, 0) + 1e-6)
    return np.clip(np.repeat((radiance + noise)[..., None], 3, 2), 0, 1).astype(np.float32)


def lit_photos(n_photos: int, rng: np.random.Generator, albedo: np.ndarray) -> list[np.ndarray]:
    return [photograph(albedo * flashlight(2 * np.pi * i / n_photos), rng) for i in range(n_photos)]


def stack_of(photos: list[np.ndarray]) -> PhotoStack:
    rgb = np.stack(photos)
    paths = tuple(Path(f"IMG_{i}.jpg") for i in range(len(photos)))
    return PhotoStack(rgb, rgb.max(3) >= 0.99, paths, WIDTH, HEIGHT, (1.0,) * len(photos))


def usual(count: int, seed: int = 1) -> PhotoStack:
    """So many photos of the ball on its table."""
    rng = np.random.default_rng(seed)
    return stack_of(lit_photos(count, rng, with_object(table(rng))))


def usual_board() -> PhotoStack:
    """The board where the object will stand, in even light, on the table of `usual`."""
    bare = with_board(table(np.random.default_rng(1)), TRIPOD_BOARD)
    one = stack_of([photograph(0.6 * bare, np.random.default_rng(3))])
    return replace(one, paths=(Path("board/IMG_0.jpg"),))


def save_photo(path: Path, linear: np.ndarray, model: str = "Tripod", second: int = 0) -> Path:
    """A JPEG with a camera model and a time."""
    path.parent.mkdir(parents=True, exist_ok=True)
    tags = Image.Exif()
    tags[272] = model
    tags.get_ifd(0x8769)[36867] = f"2024:01:01 12:{second // 60:02d}:{second % 60:02d}"
    Image.fromarray(encode_srgb(linear)).save(path, quality=95, exif=tags.tobytes())
    return path


def moved(rgb, u, v):
    shift = np.array([[1, 0, u], [0, 1, v]], float)
    return cv2.warpAffine(rgb, shift, rgb.shape[1::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
