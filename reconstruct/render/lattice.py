"""Light computed at some pixels of a smooth surface and interpolated between them, for quick pictures."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import conv2d

NO_WEIGHT = 1e-6  # no pixel that is interpolated has less: the lattice's nearest node weighs at least 1 / every^2


def lattice(surface: Bool[Tensor, "height width"], every: int) -> Bool[Tensor, "height width"]:
    """The pixels in every so-manieth row and column, and those that have none of these near."""
    if every == 1:
        return surface
    on = torch.zeros_like(surface)
    on[::every, ::every] = surface[::every, ::every]
    return surface & (on | (_tent(on[..., None].float(), every)[..., 0] == 0))


def between(
    values: Float[Tensor, "height width 3"],
    known: Bool[Tensor, "height width"],
    surface: Bool[Tensor, "height width"],
    every: int,
) -> Float[Tensor, "height width 3"]:
    """The values where they are known, else interpolated between those of the surface's `lattice`."""
    if every == 1:
        return values
    on = torch.zeros_like(known)
    on[::every, ::every] = (known & surface)[::every, ::every]
    weight = on[..., None].float()
    blended = _tent(values * weight, every) / _tent(weight, every).clamp(min=NO_WEIGHT)
    return torch.where(known[..., None], values, blended)


def _tent(picture: Float[Tensor, "height width channels"], every: int) -> Float[Tensor, "height width channels"]:
    """Sums over neighbours with weights that fall linearly to 0 at `every` pixels: linear interpolation."""
    fall = 1 - torch.arange(1 - every, every).abs() / every
    channels = picture.shape[-1]
    kernel = (fall[:, None] * fall).expand(channels, 1, -1, -1)
    return conv2d(picture.permute(2, 0, 1)[None], kernel, padding=every - 1, groups=channels)[0].permute(1, 2, 0)
