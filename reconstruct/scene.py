"""Calibrated photos as tensors on one pixel grid: the only crossing from numpy to torch."""

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from calibration.camera import Camera
from calibration.pose import Pose


@dataclass(frozen=True)
class Scene:
    """What the solver is given. World frame (z up, the ground is z = ground_height), float32, one device.

    Pixels lie on the grid of the input photos, reduced to a working size but never undistorted: `directions` holds the true
    ray of every pixel. A scene has `rgb`, or `shadow`, or both.
    """

    rgb: Float[Tensor, "photos height width 3"] | None  # linear, exposure divided out
    shadow: Float[Tensor, "photos height width"] | None  # given visibility pictures, 1 = lit
    usable: Bool[Tensor, "photos height width"]  # False where clipped or missing
    eye: Float[Tensor, "3"]  # camera centre
    directions: Float[Tensor, "height width 3"]  # unit rays
    forward: Float[Tensor, "3"]  # optical axis: z-depth = t * (direction . forward)
    pixel_angle: float  # rad subtended by one pixel at the centre
    lights: Float[Tensor, "photos 4"]  # homogeneous, see calibration.light.Light.homogeneous
    power: Float[Tensor, "photos 3"]
    axis: Float[Tensor, "photos 3"]  # beam axes; zero where isotropic
    lobe: Float[Tensor, "terms"]
    ambient: Float[Tensor, "3"]
    light_sigma: Float[Tensor, "photos 3"]
    ground_height: float
    mask: Float[Tensor, "height width"] | None  # given object coverage
    photo_names: tuple[str, ...]
    camera: Camera  # of this grid
    world_from_camera: Pose
    unit: str  # "mm" | "scene"
