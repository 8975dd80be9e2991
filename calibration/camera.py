"""A pinhole camera with lens distortion, OpenCV model and axes; pixel centres have integer coordinates."""

from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class Camera:
    """Intrinsics in px of the stored photo; distortion in OpenCV order k1 k2 p1 p2 k3.

    Camera axes: x right, y down, z forward.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    sigmas: dict[str, float] = field(default_factory=dict)  # one sigma of fx, cx, cy (px); empty when given as exact

    def __post_init__(self):
        if min(self.width, self.height) < 1 or not (self.fx > 0 and self.fy > 0):
            raise ValueError("a camera needs a positive size and focal length")

    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """OpenCV's camera matrix K."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def project(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
        """Pixels (u, v) of points in the camera frame (z > 0), distortion applied."""
        flat = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 1, 3)
        uv, _ = cv2.projectPoints(flat, np.zeros(3), np.zeros(3), self.matrix(), np.array(self.distortion))
        return np.asarray(uv).reshape(*points.shape[:-1], 2)

    def unproject(self, pixels: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 3"]:
        """Ray directions with z = 1 in the camera frame (so that range along the ray is z-depth)."""
        flat = np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
        xy = np.asarray(cv2.undistortPoints(flat, self.matrix(), np.array(self.distortion))).reshape(-1, 2)
        return np.concatenate([xy, np.ones((len(xy), 1))], 1).reshape(*pixels.shape[:-1], 3)

    def pixel_grid(self) -> Float[np.ndarray, "height width 2"]:
        """The (u, v) of every pixel centre."""
        return np.stack(np.meshgrid(np.arange(self.width, dtype=float), np.arange(self.height, dtype=float)), -1)

    def resized(self, width: int, height: int) -> "Camera":
        """The same camera for a photo resized to width x height: cx' = (cx + 0.5) * s - 0.5."""
        sx, sy = width / self.width, height / self.height
        return Camera(
            width,
            height,
            self.fx * sx,
            self.fy * sy,
            (self.cx + 0.5) * sx - 0.5,
            (self.cy + 0.5) * sy - 0.5,
            self.distortion,
            {k: v * sx for k, v in self.sigmas.items()},
        )

    def cropped(self, left: int, top: int, width: int, height: int) -> "Camera":
        """The same camera for the window of a photo that starts at pixel (left, top)."""
        return Camera(
            width, height, self.fx, self.fy, self.cx - left, self.cy - top, self.distortion, dict(self.sigmas)
        )
