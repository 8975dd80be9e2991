"""Photos of blank sheets and cards on a table, drawn from the distance of each pixel's ground point to the edge."""

import cv2
import numpy as np

from calibration.board.board import Blank
from calibration.board.corners import Corners
from calibration.camera import Camera
from calibration.pose import Pose

PAPER, TABLE = 0.8, 0.3  # linear


def blank_photo(blank: Blank, camera: Camera, world_from_camera: Pose, noise=0.01, seed=0) -> np.ndarray:
    """An 8-bit sRGB photo, slightly blurred, in light that falls off to one side, on a table with some grain."""
    rng = np.random.default_rng(seed)
    rays = world_from_camera.rotate(camera.unproject(camera.pixel_grid()))
    ground = world_from_camera.translation - rays * (world_from_camera.translation[2] / rays[..., 2:])
    middle = np.array([blank.long_mm, blank.short_mm]) / 2
    beyond = np.abs(ground[..., :2] - middle * [1, -1]) - (middle - blank.radius_mm)
    outside = np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(-1), 0) - blank.radius_mm
    covered = np.clip(0.5 - outside / np.maximum(np.hypot(*np.gradient(outside)), 1e-9), 0, 1)
    grain = cv2.GaussianBlur(rng.standard_normal(outside.shape), (0, 0), 2.0)
    light = (covered * PAPER + (1 - covered) * TABLE * (1 + 0.1 * grain / grain.std())) * (1 + 5e-4 * ground[..., 0])
    light = cv2.GaussianBlur(light, (0, 0), 0.7) + noise * rng.standard_normal(light.shape)
    return np.round(255 * np.clip(1.055 * np.maximum(light, 1e-4) ** (1 / 2.4) - 0.055, 0, 1)).astype(np.uint8)


def edges_of(blank: Blank, camera: Camera, world_from_camera: Pose, size, heights, rng, noise_px) -> Corners:
    """Points of the edges as this camera sees them, somewhere along the edge.

    Args:
        size: of the real sheet over the nominal one, along x and y.
        heights: of the points above the table, mm.
    """
    points = np.column_stack([blank.points()[:, :2] * size, heights])
    outward = np.column_stack([blank.outward(), np.zeros(len(points))])
    seen = [camera.project(world_from_camera.inverse().apply(points + k * outward)) for k in (0.0, 0.5)]
    beside = [
        camera.project(world_from_camera.inverse().apply(points + k * np.cross([0, 0, 1.0], outward)))
        for k in (-0.5, 0.5)
    ]
    along = beside[1] - beside[0]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.stack([-along[:, 1], along[:, 0]], 1)
    across *= np.sign((across * (seen[1] - seen[0])).sum(1, keepdims=True))
    pixels = seen[0] + across * rng.normal(0, noise_px, (len(points), 1)) + along * rng.uniform(-3, 3, (len(points), 1))
    return Corners(pixels, blank.points(), blank, True, across)
