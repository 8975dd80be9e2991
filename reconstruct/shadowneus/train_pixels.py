"""The pixels of a scene at one resolution, flattened on the training device, and random batches of them.

The trainer's unit frame: the object's box about the origin, the ground a plane z = const.
"""

from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import max_pool2d

from calibration.pose import Pose
from reconstruct.hull.shadow_hull import shadow_hull
from reconstruct.labels.labels import Labels
from reconstruct.labels.observer import Observer
from reconstruct.scene import Scene, ground_points, lights_in_frame, reduced
from reconstruct.sdf.grid import SdfGrid
from reconstruct.shadowneus.camera_rays import CameraRays, values
from reconstruct.shadowneus.field import SdfField

BOX_NODES = 48  # of the hull that locates the object; the field itself does not start from it
BOX_VOTES = 2  # lights that must show a node of it to be empty, if there are as many
OBJECT_SHARE = 0.6  # of the bounding sphere's radius is half the box's diagonal (the paper's objects: 0.5 to 0.7)
CUT = 0.015  # of the bounding sphere's radius: greatest distance of the field's ground from its plane
COARSEST = 100  # px along the longer side: no picture is reduced further [ShadowNeuS, supplement: 100 x 100 at first]
ROUGH = 40  # the object's mask is widened by 1 / ROUGH of the picture's height, so that all other pixels show ground


@dataclass(frozen=True)
class UnitFrame:
    """unit = (world - centre) / scale, and the object's box in world coordinates."""

    centre: Float[Tensor, "3"]
    scale: float
    lower: Float[Tensor, "3"]
    upper: Float[Tensor, "3"]


def object_frame(scene: Scene, labels: Labels, bound: float) -> UnitFrame:
    """Return the frame in which the object's box, from the shadow hull, fills its share of a sphere of radius `bound`.

    Raises:
        ReconstructionError: no object, no shadow, or light positions that contradict each other.
    """
    hull = shadow_hull(scene, labels, min(BOX_VOTES, len(scene.lights)), BOX_NODES)
    lower, upper = hull.origin, hull.upper()
    half_diagonal = 0.5 * float(torch.linalg.vector_norm(upper - lower))
    return UnitFrame(0.5 * (lower + upper), half_diagonal / (OBJECT_SHARE * bound), lower, upper)


def unit_height(height: float, frame: UnitFrame) -> float:
    """Convert a world z to the unit frame."""
    return (height - float(frame.centre[2])) / frame.scale


def in_unit_frame(scene: Scene, frame: UnitFrame) -> Scene:
    """Transform a scene to the unit frame; all equations of reconstruct.scene hold there unchanged."""
    is_point = scene.lights[:, 3:]
    pose = scene.world_from_camera
    moved = (pose.translation - frame.centre.double().numpy()) / frame.scale
    return replace(
        scene,
        eye=(scene.eye - frame.centre) / frame.scale,
        lights=lights_in_frame(scene.lights, frame.centre, frame.scale),
        power=scene.power / torch.where(is_point > 0, frame.scale**2, 1.0),
        light_sigma=scene.light_sigma / torch.where(is_point > 0, frame.scale, 1.0),
        ground_height=unit_height(scene.ground_height, frame),
        world_from_camera=Pose(pose.rotation, moved),
    )


def read_onto_grid(
    field: SdfField, frame: UnitFrame, nodes: int, ground_height: float, bound: float, device: torch.device
) -> SdfGrid:
    """Sample the object of a field with object and ground on the nodes of its box, world frame.

    The field's ground lies within CUT of its plane. It is removed by extending the object's section at that height
    straight down to the ground.

    Args:
        nodes: along the longest side of the box.
        ground_height: world z.
        bound: radius of the bounding sphere, unit frame.
    """
    spacing = float((frame.upper - frame.lower).max()) / (nodes - 1)
    counts = ((frame.upper - frame.lower) / spacing + 1e-3).floor().long() + 1
    x, y, z = (float(o) + spacing * torch.arange(int(n)) for o, n in zip(frame.lower, counts, strict=True))
    lowest = ground_height + max(CUT * bound * frame.scale, spacing)
    z = z.clamp(min=lowest)
    slabs = []
    for place in x:
        points = torch.cartesian_prod(place[None], y, z)
        unit = ((points - frame.centre) / frame.scale).to(device)
        slabs.append(values(field, unit).cpu().reshape(len(y), len(z)))
    return SdfGrid(torch.stack(slabs) * frame.scale, frame.lower, spacing)


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
    unit = in_unit_frame(small, frame)
    tensors = {f.name: value for f in fields(unit) if isinstance(value := getattr(unit, f.name), Tensor)}
    unit = replace(unit, **{name: value.to(device) for name, value in tensors.items()})
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
