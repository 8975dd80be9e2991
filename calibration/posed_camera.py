"""A camera, its place, and the height of the ground it looks at."""

from dataclasses import dataclass

from calibration.camera import Camera
from calibration.light import Vector
from calibration.pose import Pose, looked_at


@dataclass(frozen=True)
class PosedCamera:
    """A camera, its pose, and the height of the level ground, world frame."""

    camera: Camera
    world_from_camera: Pose
    ground_height: float

    def middle(self) -> Vector:
        """Where the middle of the photo shows the ground."""
        return looked_at(self.world_from_camera, self.ground_height)
