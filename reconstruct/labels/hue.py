"""Tell dark paint from ground in the dark: by its hue, since shadows keep the hue of what they fall on."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reconstruct.labels.outline import local_mean

OTHER_HUE = 0.4  # largest difference of log(channel / mean); light from a coloured object beside tints half as much
BRIGHTEST = 3  # samples of a pixel that its colour is taken from
DARKEST = 1e-3  # linear: of darker pixels the hue is noise
FAINTEST = 1e-2  # of the mean of the channels: a fainter channel is taken as this


def has_other_hue(
    rgb: Float[Tensor, "photos height width 3"],
    tint: Float[Tensor, "photos 3"],
    albedo: Float[Tensor, "height width 3"],
    ground: Bool[Tensor, "height width"],
    window: int,
) -> Bool[Tensor, "height width"]:
    """Return the pixels whose hue is not that of the ground around them, whatever light reaches them.

    Args:
        tint: the lights' colours, over which a photo's colour is that of a surface.
        albedo: of the ground.
        ground: pixels that are ground.
        window: px, odd: how far around a pixel ground is asked.
    """
    brightest = rgb.mean(-1).topk(min(BRIGHTEST, len(rgb)), dim=0).indices
    own = torch.stack([torch.gather(rgb[..., c] / tint[:, c, None, None], 0, brightest).mean(0) for c in range(3)])
    near = local_mean((albedo * ground[..., None]).movedim(-1, 0), window)
    own_hue, near_hue = ((image / image.mean(0).clamp(min=DARKEST)).clamp(min=FAINTEST).log() for image in (own, near))
    return (near.mean(0) > DARKEST) & (own.mean(0) > DARKEST) & ((own_hue - near_hue).abs().amax(0) > OTHER_HUE)
