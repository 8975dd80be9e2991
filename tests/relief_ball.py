"""A ball with relief and a chequered colour finer than the grid that it was solved on, photographed to files."""

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from synthetic import BALL, Look, grid_of, render

from calibration.calibration import Calibration
from calibration.light import irradiance
from capture.photos.photo import srgb_of
from reconstruct.fields import SolvedScene
from reconstruct.sdf.grid import SdfGrid

WAVE, HEIGHT = 3.2, 0.09  # mm: slopes of 10 degrees, a wave of seven pixels
SPACING = 4.0  # mm, of the grid: it cannot hold the relief
CELL = 5.0  # mm, of the chequers
LIGHT, DARK = np.array([0.7, 0.6, 0.5]), np.array([0.35, 0.3, 0.45])
WORKING = 120  # px, longer side of the picture that the surface was solved at


@dataclass(frozen=True)
class Relief:
    paths: tuple[Path, ...]
    calibration: Calibration
    fields: SolvedScene
    normals: Float[np.ndarray, "height width 3"]
    smooth: Float[np.ndarray, "height width 3"]  # of the ball without relief
    albedo: Float[np.ndarray, "height width 3"]
    mask: Bool[np.ndarray, "height width"]


def make(folder: Path, width: int = 440, n_lights: int = 14, turn: Float[np.ndarray, "3 3"] | None = None) -> Relief:
    """16-bit PNG photos in a folder, of the ball turned about its middle's vertical axis."""
    turn = np.eye(3) if turn is None else turn
    look = Look(width=width, height=width * 3 // 4, n_lights=n_lights, ambient=0.0)
    truth = render((BALL,), look)[1]
    mask, points = truth.mask, truth.points
    smooth = truth.normals
    normals = np.where(mask[..., None], bent(points @ turn, smooth @ turn) @ turn.T, smooth)
    odd = np.floor(points @ turn / CELL).astype(int).sum(-1) % 2 == 1
    albedo = np.where(mask[..., None], np.where(odd[..., None], DARK, LIGHT), truth.albedo)
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for light, lit in zip(truth.calibration.lights, truth.visibility, strict=True):
        value = albedo * irradiance(points, normals, light) * lit[..., None] * np.isfinite(truth.depth)[..., None]
        path = folder / light.photo
        cv2.imwrite(str(path), np.round(65535 * srgb_of(value.astype(np.float32))).astype(np.uint16)[..., ::-1])
        paths.append(path)
    return Relief(tuple(paths), truth.calibration, _solved(truth.calibration), normals, smooth, albedo, mask)


def bent(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Normals of the relief HEIGHT sin(k x) sin(k y) sin(k z) on a surface."""
    k = 2 * np.pi / WAVE
    s, c = np.sin(k * points), np.cos(k * points)
    slope = HEIGHT * k * np.stack([c[..., i] * s[..., i - 1] * s[..., i - 2] for i in range(3)], -1)
    tangential = slope - (slope * normals).sum(-1, keepdims=True) * normals
    out = normals - tangential
    return out / np.maximum(np.linalg.norm(out, axis=-1, keepdims=True), 1e-12)


def _solved(calibration: Calibration) -> SolvedScene:
    """The ball without relief, on a coarse grid, of one colour."""
    camera = calibration.camera.resized(WORKING, WORKING * 3 // 4)
    albedo = torch.from_numpy(np.tile((LIGHT + DARK) / 2, (camera.height, camera.width, 1))).float()
    return SolvedScene(grid_of((BALL,), SPACING), albedo, camera, calibration.world_from_camera, 0.0, "mm")


def angles(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Degrees between unit vectors."""
    return np.degrees(np.arccos(np.clip((found * true).sum(-1), -1, 1)))


def without_texture(fields: SolvedScene) -> SolvedScene:
    """The same surface moved by a hair: another one."""
    return replace(fields, grid=SdfGrid(fields.grid.values + 1e-3, fields.grid.origin, fields.grid.spacing))
