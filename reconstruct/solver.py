"""From labels to a surface: an SDF grid moved until every shadow ray agrees with what its pixel saw."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from calibration.camera import Camera
from calibration.pose import Pose
from reconstruct.grid import SdfGrid


@dataclass(frozen=True)
class Fields:
    """A solved scene: all that a mesh or a relit picture needs. World frame."""

    grid: SdfGrid
    albedo: Float[Tensor, "height width 3"]  # linear, object and ground, on the pixel grid of `camera`
    camera: Camera  # of the working grid
    world_from_camera: Pose
    ground_height: float
    unit: str  # "mm" | "scene"
