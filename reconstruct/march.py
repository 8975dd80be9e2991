"""Many rays through an SdfGrid at once."""

import torch
from jaxtyping import Float
from torch import Tensor

from reconstruct.grid import SdfGrid


def find_surface(grid: SdfGrid, origins: Float[Tensor, "n 3"], directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Distance along each ray to the first zero of the SDF, world length; inf where there is none."""
    t = torch.zeros(len(origins))
    lower, upper = grid.origin, grid.upper()
    inverse = 1.0 / torch.where(directions.abs() < 1e-12, torch.full_like(directions, 1e-12), directions)
    a, b = (lower - origins) * inverse, (upper - origins) * inverse
    near, far = torch.minimum(a, b).amax(-1).clamp(min=0), torch.maximum(a, b).amin(-1)
    t = near.clone()
    for _ in range(256):
        f = grid.sdf(origins + t[:, None] * directions)
        t = torch.where((t < far) & (f > 1e-4 * grid.spacing), t + 0.9 * f.clamp(min=1e-4 * grid.spacing), t)
    f = grid.sdf(origins + t[:, None] * directions)
    return torch.where((near < far) & (t < far) & (f < 0.1 * grid.spacing), t, torch.full_like(t, float("inf")))


def visibility(
    grid: SdfGrid, points: Float[Tensor, "n 3"], lights: Float[Tensor, "n 4"], sharpness: float
) -> Float[Tensor, "n"]:
    """Transmittance from each point to its homogeneous light, in [0, 1]; sharpness in 1/world length (NeuS s)."""
    towards = lights[:, :3] - lights[:, 3:] * points
    distance = torch.linalg.vector_norm(towards, dim=-1)
    start = points + (1.5 * grid.spacing / distance)[:, None] * towards
    hit = find_surface(grid, start, towards / distance[:, None])
    return torch.isinf(hit).float()
