"""Photos of printed boards with exact truth: a flat print seen by a pinhole camera, by homography."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from calibration.board.board import Board
from calibration.board.corners import Corners
from calibration.camera import Camera
from calibration.pose import Pose
from capture.session.session import Session, SessionSettings

DOTS_PER_MM = 8
MARGIN_MM = 15  # white paper around the print


def look_at(centre, target=(75.0, -105.0, 0.0), roll=0.0) -> Pose:
    """world_from_camera of a camera at `centre` that looks at `target`, turned by `roll` radians about its axis."""
    forward = np.subtract(target, centre) / np.linalg.norm(np.subtract(target, centre))
    right = np.cross(forward, [0.02, 1.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward], 1)
    turn = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1.0]])
    return Pose(rotation @ turn, np.asarray(centre, float))


def slanted(rng, tilt, distance=550.0, target=(75.0, -105.0, 0.0)) -> Pose:
    """A pose at this tilt from the vertical and random azimuth and roll."""
    azimuth = rng.uniform(0, 2 * np.pi)
    away = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)])
    return look_at(np.asarray(target) + distance * away, target, rng.uniform(-0.5, 0.5))


def corners_of(board: Board, camera: Camera, world_from_camera: Pose, noise_px=0.0, rng=None) -> Corners:
    """The board's corners as this camera sees them, with normal noise."""
    pixels = camera.project(world_from_camera.inverse().apply(board.points()))
    if rng is not None:
        pixels = pixels + rng.normal(0, noise_px, pixels.shape)
    return Corners(pixels, board.points(), board)


def session_of(folder: Path, pictures: Sequence[np.ndarray], suffix=".png", **saved) -> Session:
    """A session whose photos of the board are these, the tripod's first; `saved`: as Pillow saves them."""
    paths = tuple(folder / f"b{index}{suffix}" for index in range(len(pictures)))
    for path, picture in zip(paths, pictures, strict=True):
        Image.fromarray(picture).convert("RGB").save(path, **saved)
    return Session(folder, paths, (), (), (), SessionSettings())


def board_photo(board: Board, camera: Camera, world_from_camera: Pose, noise=3.0, is_legacy=False) -> np.ndarray:
    """A noisy 8-bit photo of the print on a grey table, by a camera without distortion."""
    cells, first = (board.columns, board.rows), 0.0
    if board.kind == "charuco":
        size = (int(cells[0] * board.square_mm * DOTS_PER_MM), int(cells[1] * board.square_mm * DOTS_PER_MM))
        art = board.opencv(is_legacy).generateImage(size, marginSize=0)
    else:
        cells, first = (board.columns + 1, board.rows + 1), -board.square_mm
        side = int(board.square_mm * DOTS_PER_MM)
        dark = np.add.outer(np.arange(cells[1]), np.arange(cells[0])) % 2 == 0
        art = np.kron(np.where(dark, 0, 255), np.ones((side, side))).astype(np.uint8)
    margin = MARGIN_MM * DOTS_PER_MM
    art = cv2.copyMakeBorder(art, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=255)
    pose = world_from_camera.inverse().matrix() @ np.diag([1.0, -1.0, -1.0, 1.0])  # camera from OpenCV's board
    at = (0.5 / DOTS_PER_MM) - MARGIN_MM + first  # mm of the first dot's centre
    board_from_dots = np.array([[1 / DOTS_PER_MM, 0, at], [0, 1 / DOTS_PER_MM, at], [0, 0, 1]])
    photo_from_dots = camera.matrix() @ pose[:3, [0, 1, 3]] @ board_from_dots
    # Drawn at four times the size and averaged, so that edges fall between pixels as they do on a sensor.
    finer = np.array([[4, 0, 1.5], [0, 4, 1.5], [0, 0, 1.0]])
    large = cv2.warpPerspective(
        art, finer @ photo_from_dots, (4 * camera.width, 4 * camera.height), flags=cv2.INTER_AREA, borderValue=90
    )
    small = cv2.resize(
        cv2.GaussianBlur(large, (0, 0), 3.0), (camera.width, camera.height), interpolation=cv2.INTER_AREA
    )
    seen = 20 + 0.8 * small + np.random.default_rng(0).normal(0, noise, small.shape)
    return np.clip(seen, 0, 255).astype(np.uint8)
