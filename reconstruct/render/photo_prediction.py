"""Predicted photos of a calibrated scene, for comparison with the real photos."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from calibration.calibration import Calibration
from calibration.light import Light
from reconstruct.fields import SolvedScene
from reconstruct.render.g_buffer import RenderView
from reconstruct.render.relight import lit_share, relight


def photographed(view: RenderView, calibration: Calibration, photo: str) -> Float[Tensor, "height width 3"]:
    """Render the scene, linear, under all lights of one photo and the ambient light."""
    first, *others = _lights_of(calibration, photo)
    picture = relight(view, first, calibration.beam, calibration.ambient)
    for light in others:  # without ambient light, which counts once
        picture = picture + relight(view, light, calibration.beam)
    return picture


def shadow_picture(view: RenderView, calibration: Calibration, photo: str) -> Float[Tensor, "height width 3"]:
    """Return 1 at the view's pixels where light of one photo arrives, 0 where none does."""
    share = torch.stack([lit_share(view, light) for light in _lights_of(calibration, photo)]).amax(0)
    return share[..., None].expand(*share.shape, 3)


def with_refined_lights(calibration: Calibration, fields: SolvedScene) -> Calibration:
    """Return the calibration with the lights refined by the solve."""
    used = [i for i, light in enumerate(calibration.lights) if light.used]
    if fields.lights is None or len(used) != len(fields.lights):
        return calibration
    lights = list(calibration.lights)
    for i, now in zip(used, fields.lights.double().numpy()[:, :3], strict=True):
        is_point = lights[i].position is not None
        lights[i] = replace(lights[i], **{"position": now} if is_point else {"direction": now / np.linalg.norm(now)})
    return replace(calibration, lights=tuple(lights))


def _lights_of(calibration: Calibration, photo: str) -> list[Light]:
    return [light for light in calibration.lights if light.photo == photo]
