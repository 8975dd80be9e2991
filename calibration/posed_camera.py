"""A camera, its pose, and the height of the ground it looks at."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from calibration.camera import Camera
from calibration.light import Vector
from calibration.pose import Pose


@dataclass(frozen=True)
class PosedCamera:
    """A camera, its pose, and the height of the level ground. World frame (z up), lengths in the world's unit.

    Pixels are those of `camera`: centre of the top-left pixel at (0, 0), distortion applied.
    """

    camera: Camera
    world_from_camera: Pose
    ground_height: float

    @property
    def centre(self) -> Vector:
        """The camera's centre, world."""
        return self.world_from_camera.translation

    @property
    def forward(self) -> Vector:
        """Unit vector along the optical axis, world."""
        return self.world_from_camera.rotation[:, 2]

    def rays(self, pixels: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 3"]:
        """Return world directions through pixels, of z-depth 1: the point at z-depth d is centre + d * ray."""
        return self.world_from_camera.rotate(self.camera.unproject(pixels))

    def on_ground(self, pixels: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 3"]:
        """Return the world points where rays of pixels meet the ground; behind the camera above the horizon."""
        rays = self.rays(pixels)
        return self.centre + rays * ((self.ground_height - self.centre[2]) / rays[..., 2:])

    def project(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
        """Return the pixels of world points, which must be in front of the camera."""
        return self.camera.project(self.world_from_camera.inverse().apply(points))

    def project_with_depth(
        self, points: Float[np.ndarray, "*batch 3"]
    ) -> tuple[Float[np.ndarray, "*batch 2"], Float[np.ndarray, "*batch"]]:
        """Return the pixels and z-depths of world points.

        A point that is not in front of the camera (z-depth <= 0) gets the pixel of the optical axis.
        """
        in_camera = self.world_from_camera.inverse().apply(points)
        depth = in_camera[..., 2]
        return self.camera.project(np.where(depth[..., None] > 0, in_camera, [0.0, 0.0, 1.0])), depth

    def looked_at(self) -> Vector:
        """Return the world point where the optical axis meets the ground.

        If it does not, the result is the point on the axis as far away as the ground is below the camera.
        """
        drop = self.ground_height - self.centre[2]
        return self.centre + self.forward * (drop / self.forward[2] if self.forward[2] < 0 else -drop)

    def resized(self, width: int, height: int) -> "PosedCamera":
        """Return the posed camera of photos resized to width x height px."""
        return replace(self, camera=self.camera.resized(width, height))

    def cropped(self, left: int, top: int, width: int, height: int) -> "PosedCamera":
        """Return the posed camera of the window of a photo that starts at pixel (left, top)."""
        return replace(self, camera=self.camera.cropped(left, top, width, height))
