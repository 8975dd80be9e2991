"""The trainer's unit frame: the object's box about the origin, the ground a plane z = const."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from calibration.pose import Pose
from reconstruct.hull.shadow_hull import shadow_hull
from reconstruct.labels.labels import Labels
from reconstruct.scene import Scene, lights_in_frame
from reconstruct.sdf.grid import SdfGrid
from reconstruct.shadowneus.camera_rays import values
from reconstruct.shadowneus.field import SdfField

BOX_NODES = 48  # of the hull that locates the object; the field itself does not start from it
BOX_VOTES = 2  # lights that must show a node of it to be empty, if there are as many
OBJECT_SHARE = 0.6  # of the bounding sphere's radius is half the box's diagonal (the paper's objects: 0.5 to 0.7)
CUT = 0.015  # of the bounding sphere's radius: greatest distance of the field's ground from its plane


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
