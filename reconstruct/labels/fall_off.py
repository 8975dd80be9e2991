"""Level surfaces above the ground, told from the ground by how light falls off with distance.

The top of a box faces up like the ground, and a near light's irradiance differs there by a few per cent: too little for
one sample of unknown albedo, enough for all lit photos of a few pixels together. With r_k = log(I_k / (albedo E_k)) and
s_k = d log E_k / dh along the pixel's ray, lit samples obey r_k = a + h s_k. Directional lights have s_k = 0: they say
nothing about heights.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import interpolate

from reconstruct.labels.outline import local_mean
from reconstruct.scene import Scene, ground_points, irradiance

LIT_BAND = 0.12  # a sample this close to what the height fitted so far predicts, as a logarithm, is lit
ROUNDS = 3  # of the fit: the first loses the lit samples that a great height moves out of the band
SLOPE_STEP = 8  # px: s_k changes slowly over the picture
LIFT = 0.005  # of the camera's height: the step of the finite difference
FLATTEST = 1e-3  # s_k, root mean square over the lit photos: flatter, and nothing is told
FEWEST_LIT = 5.0  # lit samples of a pixel: two unknowns, and what is left over tells sigma


@dataclass(frozen=True)
class Heights:
    """Height above the ground along each pixel's ray, as a share of the camera's; sigma is inf where it is unknown."""

    height: Float[Tensor, "height width"]
    sigma: Float[Tensor, "height width"]


def heights_from_fall_off(
    relative: Float[Tensor, "photos height width"],
    seen: Bool[Tensor, "photos height width"],
    slope: Float[Tensor, "photos height width"],
    pooled: Bool[Tensor, "height width"],
    radius: int,
) -> Heights:
    """r_k = a + h s_k through the lit samples, by least squares; a is each pixel's own, h that of a window.

    Sigma is from what the fit leaves over, so that light errors, noise and bounced light all count.

    Args:
        slope: s_k, see slopes.
        pooled: pixels that may speak for their neighbours.
        radius: of the window, px.
    """
    logs = relative.clamp(min=1e-6).log()
    offset, height, window = torch.zeros(pooled.shape), torch.zeros(pooled.shape), 2 * radius + 1
    allowed = seen & pooled
    r = s = logs
    count = power = offset
    for _ in range(ROUNDS):
        lit = (allowed & ((logs - offset - height * slope).abs() < LIT_BAND)).float()
        count = lit.sum(0)
        share = lit / count.clamp(min=1)
        mean_log, mean_slope = (share * logs).sum(0), (share * slope).sum(0)
        r = local_mean(lit * (logs - mean_log), window)
        s = local_mean(lit * (slope - mean_slope), window)
        power = (s * s).sum(0).clamp(min=1e-20)
        height = (r * s).sum(0) / power
        offset = mean_log - height * mean_slope
    total, pixels = local_mean(torch.stack([count, (count > 0).float()]), window)
    photos = total / pixels.clamp(min=1e-6)
    left = ((r - height * s) ** 2).sum(0) / (photos - 2).clamp(min=1)
    told = (photos >= FEWEST_LIT) & (power > (FLATTEST * pixels) ** 2 * photos)
    return Heights(height, torch.where(told, (left / power).sqrt(), torch.inf))


def slopes(scene: Scene, box: tuple[slice, slice]) -> Float[Tensor, "photos height width"]:
    """d log E_k / dh where a pixel's ray rises above the ground, h in camera heights; 0 where it meets no ground.

    Args:
        box: rows and columns of the pixels.
    """
    points, rays = ground_points(scene)[box], scene.directions[box]
    size = points.shape[:2]
    rows, columns = (torch.linspace(0, n - 1, n // SLOPE_STEP + 2).round().long() for n in size)
    points, rays = (x[rows][:, columns].reshape(-1, 3) for x in (points, rays))
    lift = LIFT * (scene.eye[2] - scene.ground_height)

    def seen(at: Tensor) -> Tensor:
        towards, strength = irradiance(scene, at)
        return strength.mean(-1) * towards[..., 2] + scene.ambient.mean()

    slope = (seen(points + lift * rays / rays[:, 2:]) / seen(points)).log() / LIFT
    slope = torch.nan_to_num(slope, 0.0, 0.0, 0.0).reshape(len(slope), 1, len(rows), len(columns))
    return interpolate(slope, size, mode="bilinear", align_corners=True)[:, 0]
