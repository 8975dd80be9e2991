"""A ball on bumpy ground z = HEIGHT sin(x / WAVE) sin(y / WAVE) under moving lights, rendered by marching rays."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from synthetic import Look, Sphere, default_camera, default_lights

from calibration.calibration import Calibration
from capture.photos.photo import PhotoStack

HEIGHT, WAVE = 8.0, 14.0  # mm: slopes up to 30 degrees, lights from 20 degrees
BALL = Sphere((0.0, 0.0, 33.0), 35.0)
STEP, REACH = 2.0, 160.0  # mm: rays are marched through the layer that holds the bumps
GROUND_ALBEDO = 0.6


@dataclass(frozen=True)
class BumpyTruth:
    """What a perfect reconstruction would find, at pixel centres."""

    calibration: Calibration
    stack: PhotoStack
    ground_depth: Float[np.ndarray, "height width"]  # z-depth of the bare ground, mm
    depth: Float[np.ndarray, "height width"]  # z-depth of ball and ground, mm
    mask: Bool[np.ndarray, "height width"]
    shadow: Float[np.ndarray, "photos height width"]
    by_ground: Bool[np.ndarray, "photos height width"]  # the bare ground, or turning away from the light, makes it dark


def ground_at(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """World z of the ground."""
    return HEIGHT * np.sin(x / WAVE) * np.sin(y / WAVE)


def normals_at(points: np.ndarray) -> np.ndarray:
    """Unit normals of the ground."""
    x, y = points[:, 0] / WAVE, points[:, 1] / WAVE
    slope = HEIGHT / WAVE * np.stack([np.cos(x) * np.sin(y), np.sin(x) * np.cos(y)], -1)
    normals = np.concatenate([-slope, np.ones((len(points), 1))], 1)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def meet_ground(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """t of the first place of each unit ray that lies under the ground, searched from where it is as low as bumps."""
    with np.errstate(divide="ignore"):
        start = np.maximum((HEIGHT - origins[:, 2]) / directions[:, 2], 0.0)
    start = np.where(origins[:, 2] > HEIGHT, start, 1e-3)
    before, found = start.copy(), np.full(len(start), np.inf)
    for step in np.arange(STEP, REACH, STEP):
        t = start + step
        at = origins + t[:, None] * directions
        under = (at[:, 2] < ground_at(at[:, 0], at[:, 1])) & np.isinf(found)
        found[under] = t[under]
        before[np.isinf(found)] = t[np.isinf(found)]
    hit = np.isfinite(found)
    low, high = before[hit], found[hit]
    for _ in range(30):
        middle = (low + high) / 2
        at = origins[hit] + middle[:, None] * directions[hit]
        under = at[:, 2] < ground_at(at[:, 0], at[:, 1])
        low, high = np.where(under, low, middle), np.where(under, middle, high)
    found[hit] = high
    return found


def render_bumpy(look: Look) -> BumpyTruth:
    """Photos, shadow pictures and truth of the ball on bumpy ground."""
    camera, pose = default_camera(look.width, look.height)
    rays = pose.rotate(camera.unproject(camera.pixel_grid())).reshape(-1, 3)
    length = np.linalg.norm(rays, axis=1)
    rays = rays / length[:, None]
    eye = np.broadcast_to(pose.translation, rays.shape)
    to_ground, (to_ball, ball_normals) = meet_ground(eye, rays), BALL.hit(eye, rays)
    mask = to_ball < to_ground
    t = np.where(mask, to_ball, to_ground)
    points = eye + t[:, None] * rays
    normals = np.where(mask[:, None], ball_normals, normals_at(points))
    albedo = np.where(mask[:, None], BALL.albedo, GROUND_ALBEDO)
    photos, shadow, by_ground = [], [], []
    lights = default_lights(look)
    for light in lights:
        place = light.homogeneous()
        towards = place[:3] - place[3] * points
        distance = np.linalg.norm(towards, axis=1)
        towards = towards / distance[:, None]
        cosine = (normals * towards).sum(1)
        start = points + 1e-3 * normals
        dark_ground = np.isfinite(meet_ground(start, towards)) | (~mask & (cosine <= 0))
        lit = (cosine > 0) & ~dark_ground & np.isinf(BALL.hit(start, towards)[0])
        shadow.append(lit)
        by_ground.append(dark_ground)
        strength = (distance**-2.0 if place[3] > 0 else np.ones_like(distance))[:, None] * light.power
        photos.append(albedo * strength * np.where(lit, cosine, 0.0)[:, None])
    grid = (look.height, look.width)
    pictures = np.clip(np.array(photos), 0, 1).astype(np.float32).reshape(-1, *grid, 3)
    names = tuple(Path(light.photo) for light in lights)
    stack = PhotoStack(
        pictures, np.asarray(pictures >= 1).any(-1), names, look.width, look.height, (1.0,) * len(lights)
    )
    return BumpyTruth(
        Calibration(camera, pose, 0.0, tuple(lights)),
        stack,
        (to_ground / length).reshape(grid),
        (t / length).reshape(grid),
        mask.reshape(grid),
        np.array(shadow, dtype=float).reshape(-1, *grid),
        np.array(by_ground).reshape(-1, *grid),
    )
