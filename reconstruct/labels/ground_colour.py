"""The albedo of the ground around a pixel, and of a pixel that few lights reach."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reconstruct.labels.outline import local_mean


def ground_around(
    albedo: Float[Tensor, "height width 3"], ground: Float[Tensor, "height width"], window: int
) -> tuple[Float[Tensor, "3 height width"], Float[Tensor, "3 height width"], Bool[Tensor, "height width"]]:
    """Return mean and spread (one sigma) of the ground's albedo around each pixel, and where there is any.

    Args:
        albedo: as if every pixel were ground.
        ground: 1 where a pixel is ground, else 0.
        window: px, odd: how far around a pixel ground is asked.
    """
    channels = albedo.movedim(-1, 0)
    sums = local_mean(torch.cat([ground * channels, ground * channels**2, ground[None]]), window)
    count = sums[6].clamp(min=1e-6)
    mean = sums[:3] / count
    return mean, (sums[3:6] / count - mean**2).clamp(min=0).sqrt(), sums[6] > 0


def brightest_albedo(
    rgb: Float[Tensor, "photos n 3"], tint: Float[Tensor, "photos 3"], irradiance: Float[Tensor, "photos n"]
) -> Float[Tensor, "n 3"]:
    """Return each pixel's albedo as the photo shows it that makes it brightest: where few lights reach, the lit one.

    0 where no sample is usable.

    Args:
        tint: the lights' colours over their mean.
        irradiance: of the lit ground, grey; 0 where a sample is unusable.
    """
    at = torch.where(irradiance > 0, rgb.mean(-1) / irradiance.clamp(min=1e-12), 0.0).argmax(0, keepdim=True)
    brightest, expected = rgb.gather(0, at[..., None].expand(-1, -1, 3))[0], irradiance.gather(0, at)[0][:, None]
    return torch.where(expected > 0, brightest / (expected * tint[at[0]]).clamp(min=1e-12), 0.0)
