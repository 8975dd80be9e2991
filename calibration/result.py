"""Everything calibration found, in one value that can be saved and read back as JSON."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from calibration.camera import Camera
from calibration.light import Light, Vector
from calibration.pose import Pose


@dataclass(frozen=True)
class Calibration:
    """Camera, ground and lights in one world frame: right-handed, z up."""

    camera: Camera
    world_from_camera: Pose
    ground_height: float  # the ground is world z = ground_height
    lights: tuple[Light, ...]
    unit: str = "mm"  # "mm" | "scene"
    lobe: tuple[float, ...] = ()  # shared flashlight profile, see calibration.light.lobe_gain
    ambient: Vector = field(default_factory=lambda: np.zeros(3))  # irradiance of everything but the flashlight
    residuals: dict[str, Any] = field(default_factory=dict)  # named numbers for the report: reprojection_rms_px, ...
