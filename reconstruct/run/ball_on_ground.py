"""Remove the ball that showed the lights from a surface on a known ground, where its shadows made it part of it."""

from dataclasses import replace

import numpy as np
import torch

from calibration.posed_camera import PosedCamera
from reconstruct.fields import SolvedScene
from reconstruct.sdf.grid import SdfGrid


def without_ball(fields: SolvedScene, circle: tuple[float, float, float], posed_camera: PosedCamera) -> SolvedScene:
    """Return the surface without a ball that stands on the ground.

    Args:
        circle: x, y, radius of the ball and a rim about it, px of `posed_camera`.
        posed_camera: in the frame of the fields.
    """
    x, y, radius = circle
    ray, slope = posed_camera.rays(np.array([[x, y]]))[0], radius / posed_camera.camera.fx
    eye, ground = posed_camera.centre, posed_camera.ground_height
    t = (eye[2] - ground) / (slope * float(ray @ posed_camera.forward) - ray[2])  # its middle lies a radius above
    middle, size = eye + t * ray, slope * t * float(ray @ posed_camera.forward)
    grid = fields.grid
    nodes = [grid.origin[i].item() + grid.spacing * np.arange(n) - middle[i] for i, n in enumerate(grid.values.shape)]
    away = np.sqrt(nodes[0][:, None, None] ** 2 + nodes[1][:, None] ** 2 + nodes[2] ** 2)
    values = torch.maximum(grid.values, torch.from_numpy(size - away).to(grid.values.dtype))
    return replace(fields, grid=SdfGrid(values, grid.origin, grid.spacing))
