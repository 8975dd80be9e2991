"""What each pixel says on its own: object or ground, lit or in shadow, and which way the surface faces."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Labels:
    """Targets for the solver, on the Scene's pixel grid. A confidence of 0 means "unknown"."""

    visibility: Float[
        Tensor, "photos height width"
    ]  # 1 = the surface seen here sees the light, 0 = in shadow; grey allowed
    confidence: Float[Tensor, "photos height width"]  # in [0, 1]
    mask: Float[Tensor, "height width"]  # object coverage, in [0, 1]
    mask_confidence: Float[Tensor, "height width"]
    normals: Float[Tensor, "height width 3"]  # world, from photometric stereo; 0 where unknown
    normal_confidence: Float[Tensor, "height width"]
    albedo: Float[Tensor, "height width 3"]  # linear, relative to Light.power
