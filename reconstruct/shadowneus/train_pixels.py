"""The pixels of a scene at one resolution, flattened on the training device, and random batches of them."""

from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import max_pool2d

from reconstruct.labels.observer import Observer
from reconstruct.scene import Scene, ground_points, reduced
from reconstruct.shadowneus.camera_rays import CameraRays
from reconstruct.shadowneus.unit_frame import UnitFrame, in_unit_frame

COARSEST = 100  # px along the longer side: no picture is reduced further [ShadowNeuS, supplement: 100 x 100 at first]
ROUGH = 40  # the object's mask is widened by 1 / ROUGH of the picture's height, so that all other pixels show ground


@dataclass(frozen=True)
class TrainPixels:
    """The pixels of a scene at one resolution, in the unit frame on the training device; p pixels in rows."""

    scene: Scene
    directions: Float[Tensor, "p 3"]
    ground_t: Float[Tensor, " p"]  # inf above the horizon
    colour: Float[Tensor, "photos p 3"] | None  # linear
    shadow: Float[Tensor, "photos p"] | None  # given visibility
    usable: Bool[Tensor, "photos p"]
    is_object: Bool[Tensor, " p"]  # the mask, widened


@dataclass(frozen=True)
class Batch:
    """Pixels drawn for one iteration, each under the same photos."""

    rays: CameraRays
    pixels: Int[Tensor, " rays"]
    photos: Int[Tensor, " lights"]
    is_object: Bool[Tensor, " rays"]


def make_train_pixels(scene: Scene, frame: UnitFrame, divisor: int, device: torch.device) -> TrainPixels:
    """Reduce a scene (world frame) to 1 / divisor of its pixels per side, but to no fewer than COARSEST."""
    small = reduced(scene, max(COARSEST, max(scene.camera.width, scene.camera.height) // divisor))
    mask = Observer(small).ground_labels().mask
    reach = max(1, round(mask.shape[0] / ROUGH))
    wide = max_pool2d((mask > 0.5).float()[None], 2 * reach + 1, 1, reach)[0] > 0
    unit = _on(in_unit_frame(small, frame), device)
    t = torch.linalg.vector_norm(ground_points(unit) - unit.eye, dim=-1)
    return TrainPixels(
        scene=unit,
        directions=unit.directions.reshape(-1, 3),
        ground_t=torch.nan_to_num(t, nan=torch.inf).reshape(-1),
        colour=None if unit.rgb is None else unit.rgb.flatten(1, 2),
        shadow=None if unit.shadow is None else unit.shadow.flatten(1, 2),
        usable=unit.usable.flatten(1, 2),
        is_object=wide.to(device).reshape(-1),
    )


def draw(view: TrainPixels, pixels: int, lights: int, generator: torch.Generator) -> Batch:
    """Draw `pixels` distinct pixels and `lights` distinct photos, uniformly."""
    device = view.directions.device
    count, photos = len(view.directions), len(view.scene.lights)
    drawn = torch.randperm(count, generator=generator)[:pixels].to(device)
    lit = torch.randperm(photos, generator=generator)[:lights].to(device)
    rays = CameraRays(view.scene.eye, view.directions[drawn], view.ground_t[drawn], view.scene.pixel_angle)
    return Batch(rays, drawn, lit, view.is_object[drawn])


def _on(scene: Scene, device: torch.device) -> Scene:
    tensors = {f.name: getattr(scene, f.name) for f in fields(scene)}
    return replace(scene, **{name: v.to(device) for name, v in tensors.items() if isinstance(v, Tensor)})
