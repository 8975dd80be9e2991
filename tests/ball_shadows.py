"""The shadows that a ball on a plane casts, drawn by their equations."""

import numpy as np
from flashlight_photos import looking_at

from calibration.camera import Camera
from calibration.ground.ground_field import GroundField
from calibration.ground.ground_shadows import GroundShadows
from calibration.lights.ground_cells import ground_points
from calibration.outlines.outline_maps import outline_maps
from calibration.posed_camera import PosedCamera

WIDTH, HEIGHT, RADIUS = 252, 189, 30.0
MIDDLE = np.array([0.0, 0.0, RADIUS])
EYE = np.array([0.0, -420.0, 380.0])


def ball_camera(eye: np.ndarray = EYE) -> PosedCamera:
    pose = looking_at(eye, MIDDLE)
    return PosedCamera(Camera(WIDTH, HEIGHT, 260.0, 260.0, (WIDTH - 1) / 2, (HEIGHT - 1) / 2), pose, 0.0)


def ball_lights(count: int = 14) -> np.ndarray:
    turn = 2.4 * np.arange(count)
    up = np.radians(30 + 40 * np.modf(0.618 * np.arange(count))[0])
    distance = 450 + 150 * np.modf(0.35 * np.arange(count))[0]
    direction = np.stack([np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), np.sin(up)], -1)
    return distance[:, None] * direction


def hits_ball(start: np.ndarray, end: np.ndarray, radius: float = RADIUS) -> np.ndarray:
    """Whether the line from start to end comes nearer to the ball's middle than its radius."""
    along = (end - start) / np.linalg.norm(end - start, axis=-1, keepdims=True)
    return np.linalg.norm(np.cross(MIDDLE - start, along), axis=-1) < radius


def photographed() -> tuple[PosedCamera, np.ndarray, GroundField, GroundShadows]:
    """Return camera, lights, and what is seen of the ground."""
    camera, lights = ball_camera(), ball_lights()
    points, _ = ground_points(camera)
    mask = hits_ball(np.broadcast_to(EYE, points.shape), points)
    lit = np.stack([~hits_ball(points, light) for light in lights])
    flat = np.zeros((HEIGHT, WIDTH), np.float32)
    every = np.ones(lit.shape, bool)
    field = GroundField(flat, np.zeros(lit.shape, np.float32), np.where(lit, 0, -2).astype(np.float32), every, flat + 1)
    likelihood = np.where(mask, 1.0, -1.0).astype(np.float32)
    return (camera, lights, field, GroundShadows(lit.astype(np.float32), np.full(len(lights), -2.0), likelihood, mask))


def drawn():
    camera, lights, field, shadows = photographed()
    maps = outline_maps(field, shadows, camera)
    assert maps is not None
    return camera, lights, maps
