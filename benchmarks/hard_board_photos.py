"""Photos of printed boards under hard conditions, with exact truth: tilt, distance, blur, noise, shadow, objects on it.

The print is drawn through a homography at several times the photo's resolution, lit, shadowed and covered in linear
light, blurred, bent by the lens, made noisy and encoded as sRGB. No files, no detector and no calibration is used.
"""

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from board_photos import look_at  # pyright: ignore[reportMissingImports]

from calibration.board.board import Board, parse_board
from calibration.camera import Camera
from calibration.pose import Pose
from capture.photos.photo import encode_srgb

DOTS_PER_MM = 4
MARGIN_MM = 12.0  # white paper around the print
OVERSAMPLING = 3  # samples per pixel and axis when the print is drawn
INK, PAPER = 0.04, 0.8  # albedo
IN_FRAME = 0.7  # of the corners, at least
EXCESS = 80  # px drawn around the photo, which the lens may bend into it
SIZE = (1000, 750)
LENSES = (
    Camera(*SIZE, 1000.0, 1000.0, 503.0, 371.0, (0.06, -0.08, 0.0, 0.0, 0.0)),
    Camera(*SIZE, 780.0, 780.0, 492.0, 379.0, (-0.12, 0.05, 0.0, 0.0, 0.0)),
    Camera(*SIZE, 1350.0, 1350.0, 497.0, 376.0),
)
BOARDS = ("charuco:7x9:25:18:DICT_4X4_50", "charuco:5x7:30:22:DICT_4X4_50", "charuco:7x5:30:15:DICT_6X6_250")
CHECKERBOARD = "checkerboard:9x6:24.25"
SHARE_OF_BOARDS = (0.45, 0.2, 0.1, 0.25)


@dataclass(frozen=True)
class Conditions:
    """How hard a photo is."""

    tilt: float  # degrees between the board's normal and the line of sight to its middle
    cover: float  # of the photo's area that the whole print would fill
    blur_px: float  # sigma
    noise: float  # standard deviation at mid grey, of full scale
    shadow: float  # share of the light that is left in the shadow; 1: no shadow
    hidden: float  # share of the print's inner corners outside the photo or under an object


@dataclass(frozen=True, eq=False)
class HardPhoto:
    """A photo and the truth about it."""

    grey: np.ndarray
    board: Board
    lens: int  # of LENSES
    world_from_camera: Pose
    conditions: Conditions

    def shortest_square(self) -> float:
        """The shortest step between neighbouring corners, where the print is whole in the photo, px."""
        columns, rows = self.board.corner_counts()
        in_camera = self.world_from_camera.inverse().apply(self.board.points())
        grid = LENSES[self.lens].project(in_camera).reshape(rows, columns, 2)
        return float(min(np.median(np.linalg.norm(np.diff(grid, axis=k), axis=-1)) for k in (0, 1)))


def hard_photo(seed: int, lens: int | None = None, easy: bool = False) -> HardPhoto:
    """The photo of this seed; easy: mid distances and tilts, sharp, nothing in the way, as one would calibrate."""
    rng = np.random.default_rng([seed, easy])
    lens = int(rng.integers(len(LENSES))) if lens is None else lens
    spec = str(rng.choice([*BOARDS, CHECKERBOARD], p=SHARE_OF_BOARDS))
    board = parse_board(BOARDS[0] if easy else spec)
    tilt = rng.uniform(20, 50) if easy else rng.uniform(10, 80)
    pose, cover = _pose(rng, board, LENSES[lens], tilt, rng.uniform(0.25, 0.5) if easy else rng.uniform(0.1, 0.6))
    blur = rng.uniform(0.5, 0.8) if easy else rng.uniform(0.5, rng.choice([1.0, 2.5]))
    noise = rng.uniform(0.003, 0.01) if easy else rng.uniform(0.003, 0.03)
    shadow = 1.0 if easy or rng.random() < 0.4 else rng.uniform(0.15, 0.6)
    light = _table(rng) if not easy else np.full(_shape(), 0.2, np.float32)
    _draw_board(light, board, lens, pose)
    light *= _illumination(rng, shadow)
    ideal = _project(lens, pose.inverse().apply(board.points()))
    covered = _put_object(rng, light, ideal) if not easy and rng.random() < 0.6 else np.zeros(_shape(), bool)
    at = np.clip(ideal.round().astype(int), 0, np.array(_shape())[::-1] - 1)
    outside = ~_inside(LENSES[lens].project(pose.inverse().apply(board.points())))
    hidden = float((outside | covered[at[:, 1], at[:, 0]]).mean())
    seen = cv2.remap(cv2.GaussianBlur(light, (0, 0), blur), *_bend(lens), cv2.INTER_CUBIC)
    seen /= np.percentile(seen[::4, ::4], 99.5)
    seen += rng.standard_normal(seen.shape, np.float32) * np.float32(noise) * np.sqrt(0.3 + 1.4 * np.clip(seen, 0, 1))
    grey = encode_srgb(np.clip(seen, 0, 1))
    return HardPhoto(grey, board, lens, pose, Conditions(tilt, cover, float(blur), float(noise), shadow, hidden))


# --- geometry


def _shape() -> tuple[int, int]:
    return SIZE[1] + 2 * EXCESS, SIZE[0] + 2 * EXCESS


def _inside(pixels: np.ndarray) -> np.ndarray:
    return ((pixels > 3) & (pixels < np.subtract(SIZE, 4))).all(-1)


def _project(lens: int, in_camera: np.ndarray) -> np.ndarray:
    """Pixels of the larger picture that the lens has not bent yet."""
    homogeneous = in_camera @ LENSES[lens].matrix().T
    return homogeneous[:, :2] / homogeneous[:, 2:] + EXCESS


@cache
def _bend(lens: int) -> tuple[np.ndarray, np.ndarray]:
    """Where each pixel of the photo looks in the larger picture."""
    rays = LENSES[lens].unproject(LENSES[lens].pixel_grid()).reshape(-1, 3)
    u, v = _project(lens, rays).T.reshape(2, SIZE[1], SIZE[0]).astype(np.float32)
    return u, v


def _pose(rng: np.random.Generator, board: Board, camera: Camera, tilt: float, cover: float) -> tuple[Pose, float]:
    """A pose at this tilt at which the print fills this share of the photo; less, where it would not fit."""
    points, up = board.points(), np.radians(tilt)
    middle, area = points.mean(0), board.columns * board.rows * board.square_mm**2
    while True:
        distance = np.sqrt(area * np.cos(up) * camera.fx**2 / (cover * camera.width * camera.height))
        for _ in range(20):
            azimuth = rng.uniform(0, 2 * np.pi)
            away = np.array([np.sin(up) * np.cos(azimuth), np.sin(up) * np.sin(azimuth), np.cos(up)])
            centred = look_at(middle + distance * away, middle, rng.uniform(-np.pi, np.pi))
            aside = rng.uniform(-0.3, 0.3, 2) * SIZE * distance / camera.fx  # the board wanders over the photo
            pose = Pose(centred.rotation, centred.translation + centred.rotation @ np.append(aside, 0.0))
            in_camera = pose.inverse().apply(points)
            if pose.translation[2] <= 0 or in_camera[:, 2].min() < 0.3 * distance:
                continue
            if _inside(camera.project(in_camera)).mean() >= IN_FRAME:
                return pose, cover
        cover *= 0.85


# --- pictures


@cache
def _art(spec: str) -> tuple[np.ndarray, float]:
    """The print as albedo, with its white paper, and where its first dot lies in the board's frame, mm."""
    board = parse_board(spec)
    dots = round(board.square_mm * DOTS_PER_MM)
    if board.kind == "charuco":
        art, first = board.opencv().generateImage((board.columns * dots, board.rows * dots), marginSize=0), 0.0
    else:
        dark = np.add.outer(np.arange(board.rows + 1), np.arange(board.columns + 1)) % 2 == 0
        art, first = np.kron(np.where(dark, 0, 255), np.ones((dots, dots))).astype(np.uint8), -board.square_mm
    margin = round(MARGIN_MM * DOTS_PER_MM)
    art = cv2.copyMakeBorder(art, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=255)
    return np.where(art > 0, PAPER, INK).astype(np.float32), first - MARGIN_MM


def _draw_board(light: np.ndarray, board: Board, lens: int, pose: Pose) -> None:
    """The paper with the print on it, into the picture that the lens has not bent yet."""
    art, first = _art(board.spec())
    mm = np.diag([1 / DOTS_PER_MM, 1 / DOTS_PER_MM, 1])
    mm[:2, 2] = 0.5 / DOTS_PER_MM + first
    seen = pose.inverse().matrix() @ np.diag([1.0, -1.0, -1.0, 1.0])  # camera from OpenCV's board
    matrix = LENSES[lens].matrix()
    matrix[:2, 2] += EXCESS
    from_dots = matrix @ seen[:3, [0, 1, 3]] @ mm
    rows, columns = art.shape
    outline = cv2.perspectiveTransform(
        np.array([[[-0.5, -0.5], [columns - 0.5, -0.5], [columns - 0.5, rows - 0.5], [-0.5, rows - 0.5]]]), from_dots
    )[0]
    low = np.clip(np.floor(outline.min(0)).astype(int), 0, None)
    high = np.minimum(np.ceil(outline.max(0)).astype(int) + 1, np.array(light.shape)[::-1])
    n, shift = OVERSAMPLING, (OVERSAMPLING - 1) / 2
    finer = np.array([[n, 0, shift - n * low[0]], [0, n, shift - n * low[1]], [0, 0, 1.0]])
    size = ((high - low) * n).tolist()
    drawn = cv2.warpPerspective(art, finer @ from_dots, size, flags=cv2.INTER_LINEAR, borderValue=-1.0)
    background = light[low[1] : high[1], low[0] : high[0]]
    large = cv2.resize(background, size, interpolation=cv2.INTER_NEAREST)
    large[drawn >= INK / 2] = drawn[drawn >= INK / 2]
    background[:] = cv2.resize(large, (high - low).tolist(), interpolation=cv2.INTER_AREA)


@cache
def _clutter(index: int) -> np.ndarray:
    """A table with grain, pens, papers and a tablecloth's pattern."""
    rng = np.random.default_rng([index, 77])
    shape = _shape()
    grain = cv2.resize(rng.standard_normal((shape[0] // 4, shape[1] // 40), np.float32), shape[::-1])
    table = (0.35 + 0.05 * grain + 0.02 * rng.standard_normal(shape, np.float32)).astype(np.float32)
    for _ in range(12):
        points = rng.integers(0, shape[1], (4, 2)) // [1, 2] + rng.integers(0, 150, (4, 2))
        cv2.fillConvexPoly(table, cv2.convexHull(points[:, None].astype(np.int32)), float(rng.uniform(0.05, 0.8)))
    for _ in range(15):
        ends = rng.integers(0, shape[1], (2, 2)).tolist()
        cv2.line(table, ends[0], ends[1], float(rng.uniform(0.03, 0.9)), int(rng.integers(1, 12)))
    side = int(rng.integers(14, 40))
    check = np.kron(np.add.outer(np.arange(5), np.arange(4)) % 2, np.ones((side, side))) * 0.5 + 0.1
    u, v = rng.integers(0, shape[1] - 4 * side), rng.integers(0, shape[0] - 5 * side)
    table[v : v + 5 * side, u : u + 4 * side] = check
    return np.clip(table, 0.02, 0.95)


def _table(rng: np.random.Generator) -> np.ndarray:
    table = _clutter(int(rng.integers(12)))
    return np.flip(table, [axis for axis in (0, 1) if rng.random() < 0.5]).copy()


def _illumination(rng: np.random.Generator, shadow: float) -> np.ndarray:
    """A lamp to one side, and a shadow with a soft edge across the photo."""
    rows, columns = _shape()
    y, x = np.mgrid[:rows:8, :columns:8].astype(np.float32) / columns
    at = rng.uniform(-0.5, 1.5, 2)
    lamp = 1 / (1 + rng.uniform(0, 1.5) * ((x - at[0]) ** 2 + (y - at[1]) ** 2))
    angle, width = rng.uniform(0, 2 * np.pi), rng.uniform(0.002, 0.03)
    across = (x - rng.uniform(0.3, 0.7)) * np.cos(angle) + (y - rng.uniform(0.2, 0.55)) * np.sin(angle)
    band = 1 / (1 + np.exp(-np.clip(across / width, -30, 30)))
    if rng.random() < 0.5:
        band *= 1 / (1 + np.exp(-np.clip((rng.uniform(0.05, 0.3) - across) / width, -30, 30)))
    level = lamp * (1 - (1 - shadow) * band)
    return cv2.resize(level.astype(np.float32), (columns, rows), interpolation=cv2.INTER_CUBIC)


def _put_object(rng: np.random.Generator, light: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Something that stands on the board; returns where it hides what is under it."""
    extent = np.ptp(corners, axis=0)
    middle = corners[rng.integers(len(corners))]
    turns = np.sort(rng.uniform(0, 2 * np.pi, 9))
    radius = extent * rng.uniform(0.1, 0.3) * rng.uniform(0.6, 1, (9, 1))
    outline = (middle + radius * np.stack([np.cos(turns), np.sin(turns)], 1)).round().astype(np.int32)
    mask = np.zeros(light.shape, np.uint8)
    cv2.fillPoly(mask, [outline], 1)
    hidden = mask > 0
    texture = 0.3 + 0.3 * np.kron(rng.random((light.shape[0] // 10 + 1, light.shape[1] // 10 + 1)), np.ones((10, 10)))
    light[hidden] = texture[: light.shape[0], : light.shape[1]][hidden] * rng.uniform(0.2, 1.2)
    return hidden
