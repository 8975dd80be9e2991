"""A solved scene, and its file."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
from jaxtyping import Float
from msgspec import Meta, Struct
from torch import Tensor

from calibration.calibration import LARGEST_LENGTH, Length, is_rigid
from calibration.camera import Camera
from calibration.pose import Pose
from calibration.posed_camera import PosedCamera
from capture.errors import CalibrationError, ReconstructionError
from capture.files.atomic import atomic_file
from capture.files.regular import why
from capture.files.schema import Number, Text, as_type
from capture.session.capture import MOST_VIEWS
from reconstruct.appearance.brdf import LOBES, Gloss
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.level_set import carried
from reconstruct.tensor_file import Layout, parsed, read_tensors, refuse_outside, write_tensors

FORMAT = "1"
MAKE = "make the result again, or ask for the file again."
MOST_NODES = 400**3  # of a grid: a mesh of more does not fit in memory
MOST_NUMBERS = 2 * 10**8  # of one tensor: one per pixel of the largest photo
MOST_BOXES = 1e6  # sizes of the grid between it, its origin and the camera: beyond, a float32 knows no voxel any more
STEEPEST = 8.0  # voxels between neighbouring nodes: a distance has 1, one that was smoothed or learned up to 2
MOST_SHEETS = 12  # along an axis of the grid, on average; the kernels follow six minima per ray
BRIGHTEST = 65504.0  # of albedo, lobes and counts of rays: the largest float16
LAYOUTS = {
    "sdf": Layout(torch.float32, (None, None, None)),
    "origin": Layout(torch.float32, (3,)),
    "albedo": Layout(torch.float16, (None, None, 3)),
    "world_from_camera": Layout(torch.float64, (4, 4)),
    "lights": Layout(torch.float32, (None, 4), is_needed=False),  # of older files; not read: the calibration has them
    "evidence": Layout(torch.float16, (None, None, None), is_needed=False),
    "lobes": Layout(torch.float32, (None, LOBES, 3), is_needed=False),
    "lobe_weights": Layout(torch.float16, (None, None, None), is_needed=False),
}
OF_A_VIEW = ("albedo", "world_from_camera", "lobe_weights", "lights")  # of a further camera: with its number, albedo_1
MOTION = "object_from_world"  # of a further camera of another object pose, with its number
LAYOUTS |= {
    f"{name}_{number}": replace(LAYOUTS[name], is_needed=False) for number in range(1, MOST_VIEWS) for name in OF_A_VIEW
}
LAYOUTS |= {
    f"{MOTION}_{number}": replace(LAYOUTS["world_from_camera"], is_needed=False) for number in range(1, MOST_VIEWS)
}


@dataclass(frozen=True)
class FurtherView:
    """What another camera of the same solve saw, as in SolvedScene."""

    name: str
    albedo: Float[Tensor, "height width 3"]
    camera: Camera
    world_from_camera: Pose
    gloss_weights: Float[Tensor, "height width materials"] | None = None  # of the lobes of SolvedScene.gloss
    object_from_world: Pose | None = None  # of another object pose: the camera is in its own world

    def scaled(self, factor: float) -> "FurtherView":
        """Return the same view in a unit of which `factor` are one of this one's."""
        motion = self.object_from_world
        pose = Pose(self.world_from_camera.rotation, factor * self.world_from_camera.translation)
        motion = None if motion is None else Pose(motion.rotation, factor * motion.translation)
        return replace(self, world_from_camera=pose, object_from_world=motion)

    def as_stored(self) -> "FurtherView":
        """Round to the precision of the file."""
        weights = None if self.gloss_weights is None else _half(self.gloss_weights).float()
        return replace(self, albedo=_half(self.albedo).float(), gloss_weights=weights)

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors of the file, by the names that those of the first camera have."""
        found = {
            "albedo": _half(self.albedo),
            "world_from_camera": torch.from_numpy(self.world_from_camera.matrix()),
            "lobe_weights": None if self.gloss_weights is None else _half(self.gloss_weights),
            MOTION: None if self.object_from_world is None else torch.from_numpy(self.object_from_world.matrix()),
        }
        return {name: tensor.contiguous() for name, tensor in found.items() if tensor is not None}


@dataclass(frozen=True)
class SolvedScene:
    """A solved scene: all that a mesh or a relit picture needs. World frame.

    The camera is the first view's. With several views, `further` holds what the others saw of the same surface.
    """

    grid: SdfGrid
    albedo: Float[Tensor, "height width 3"]  # linear, object and ground, on the pixel grid of `camera`
    camera: Camera  # of the working grid
    world_from_camera: Pose
    ground_height: float
    unit: str  # "mm" | "scene"
    gloss: Gloss | None = None  # on the same pixels as albedo; None: matt
    evidence: Float[Tensor, "nx ny nz"] | None = None  # rays whose edge passes each node, see evidence.ray_counts
    doubts: tuple[str, ...] = ()  # warnings for the user about photos and lights that contradict each other
    interreflection: float = 0.0  # true albedo over `albedo`, by the light that surfaces send each other; 0: none seen
    view: str = ""  # name of the camera's view, where there are several
    further: tuple[FurtherView, ...] = ()
    object_from_world: Pose | None = None  # of one view of another object pose: its motion to the others' world
    light_share: float = 0.0  # one sigma of a light's place over its distance, median over the photos

    @property
    def posed_camera(self) -> PosedCamera:
        """The camera of the working grid above its ground."""
        return PosedCamera(self.camera, self.world_from_camera, self.ground_height)

    def in_world(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return points of the frame that all views share in the world of this one: another for another object pose."""
        return points if self.object_from_world is None else self.object_from_world.inverse().apply(points)

    def in_common(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return points of this view's world in the frame that all views share."""
        return points if self.object_from_world is None else self.object_from_world.apply(points)

    def views(self) -> "tuple[SolvedScene, ...]":
        """Return the scene as each of its cameras saw it: each one's albedo and gloss, without the others'.

        Where the object was laid anew, its surface is carried into that pose's world, in which the ground is level.
        """
        return self._each_view

    @cached_property
    def _each_view(self) -> "tuple[SolvedScene, ...]":
        found: list[SolvedScene] = [replace(self, further=())]
        grids: dict[bytes, SdfGrid] = {}
        for one in self.further:
            own = self.of_cameras(one)
            if one.object_from_world is not None:
                key = one.object_from_world.matrix().tobytes()
                if key not in grids:
                    grids[key] = carried(self.grid, one.object_from_world.inverse())
                own = replace(own, grid=grids[key], evidence=None)
            found.append(own)
        return tuple(found)

    @property
    def cameras(self) -> tuple[FurtherView, ...]:
        """What each camera saw, the first one's at first."""
        weights = None if self.gloss is None else self.gloss.weights
        pose, motion = self.world_from_camera, self.object_from_world
        return (FurtherView(self.view, self.albedo, self.camera, pose, weights, motion), *self.further)

    def of_cameras(self, first: FurtherView, *further: FurtherView) -> "SolvedScene":
        """Return the scene as these cameras saw it."""
        weights = first.gloss_weights
        return replace(
            self,
            albedo=first.albedo,
            camera=first.camera,
            world_from_camera=first.world_from_camera,
            gloss=None if self.gloss is None or weights is None else replace(self.gloss, weights=weights),
            view=first.name,
            further=further,
            object_from_world=first.object_from_world,
        )

    def scaled(self, factor: float, unit: str) -> "SolvedScene":
        """Return the same scene in another unit, of which `factor` are one of this one's."""
        grid = SdfGrid(factor * self.grid.values, factor * self.grid.origin, factor * self.grid.spacing)
        seen = self.of_cameras(*(one.scaled(factor) for one in self.cameras))
        return replace(seen, grid=grid, ground_height=factor * self.ground_height, unit=unit)

    def __repr__(self) -> str:
        nodes = " x ".join(map(str, self.grid.values.shape))
        surface = "matt" if self.gloss is None else "glossy"
        return f"SolvedScene({nodes} nodes of {self.grid.spacing:.3g} {self.unit}, {surface})"


def as_stored(fields: SolvedScene) -> SolvedScene:
    """Round the fields to the precision of their file, so that a solved scene equals its file."""
    seen = fields.of_cameras(*(one.as_stored() for one in fields.cameras))
    return replace(seen, evidence=None if fields.evidence is None else _half(fields.evidence).float())


def _half(values: Tensor) -> Tensor:
    """Return values as float16; what is above its largest becomes that: infinity would not be read again."""
    return values.clamp(max=BRIGHTEST).half()


def save_fields(fields: SolvedScene, path: Path) -> None:
    """Write SolvedScene as safetensors, with the rest as JSON in the header; whole or not at all."""
    tensors = {"sdf": fields.grid.values.contiguous(), "origin": fields.grid.origin.contiguous()}
    if fields.evidence is not None:
        tensors["evidence"] = _half(fields.evidence).contiguous()
    if fields.gloss is not None:
        tensors["lobes"] = fields.gloss.lobes.contiguous()
    for number, one in enumerate(fields.cameras):
        tensors |= {f"{name}_{number}" if number else name: tensor for name, tensor in one.tensors().items()}
    rest = {
        "spacing": fields.grid.spacing,
        "camera": asdict(fields.camera),
        "ground_height": fields.ground_height,
        "unit": fields.unit,
        "doubts": fields.doubts,
        "interreflection": fields.interreflection,
        "light_share": fields.light_share,
    }
    if fields.further:
        views = [{"name": one.name, "camera": asdict(one.camera)} for one in fields.further]
        rest |= {"view": fields.view, "further": views}
    with atomic_file(path) as temporary:
        write_tensors(tensors, {"format": FORMAT, "fields": json.dumps(rest)}, temporary)


class _ViewHeader(Struct, kw_only=True):
    camera: Camera
    name: Text = ""


class _Header(_ViewHeader, kw_only=True):
    spacing: Annotated[float, Meta(ge=1 / LARGEST_LENGTH, le=LARGEST_LENGTH)]
    ground_height: Length
    unit: Literal["mm", "scene"]
    doubts: tuple[Text, ...] = ()
    interreflection: Number = 0.0
    light_share: Number = 0.0
    view: Text = ""
    further: Annotated[tuple[_ViewHeader, ...], Meta(max_length=MOST_VIEWS - 1)] = ()


def load_fields(path: Path) -> SolvedScene:
    """Read SolvedScene from a file written by save_fields, which may be a stranger's.

    Raises:
        ReconstructionError: the file is missing, damaged, of another format, or holds what no solve leaves: numbers
            that are not finite or of no scene, sizes that do not agree, an SDF that is no distance.
    """
    try:
        stored = read_tensors(path, LAYOUTS, MOST_NUMBERS)
        if stored.header.get("format") != FORMAT:
            raise ValueError(f"format {stored.header.get('format')!r} found, {FORMAT!r} needed")
        return _checked(stored.tensors, as_type(parsed(stored.header, "fields"), _Header, f"{path}: the header", MAKE))
    except CalibrationError as error:
        raise ReconstructionError(str(error)) from error
    except (OSError, ValueError) as error:
        raise ReconstructionError(f"{path}: not a readable result ({why(error)}); {MAKE}") from error


def _checked(tensors: Mapping[str, Tensor], rest: _Header) -> SolvedScene:
    """Return the fields of a file.

    Raises:
        ValueError, CalibrationError: they are none that a solve leaves.
    """
    grid = checked_grid(tensors["sdf"], tensors["origin"], rest.spacing)
    refuse_outside(tensors, 0.0, BRIGHTEST, "lobes", "evidence")
    views = enumerate((rest, *rest.further))
    first, *further = (_checked_view(tensors, view, grid, rest.ground_height, number) for number, view in views)
    for one in (first, *further):
        weights, lobes = one.gloss_weights, tensors.get("lobes")
        if lobes is not None and weights is not None and weights.shape[2] != len(lobes):
            raise ValueError(f"weights of lobes of {weights.shape[2]} materials were found, of {len(lobes)} needed")
    gloss = _gloss(tensors)
    if "evidence" in tensors and tensors["evidence"].shape != grid.values.shape:
        raise ValueError(f"evidence at {tuple(tensors['evidence'].shape)} nodes was found, at all nodes it was needed")
    return SolvedScene(
        grid,
        first.albedo,
        first.camera,
        first.world_from_camera,
        rest.ground_height,
        rest.unit,
        gloss,
        tensors["evidence"].float() if "evidence" in tensors else None,
        rest.doubts,
        rest.interreflection,
        rest.view,
        tuple(further),
        light_share=rest.light_share,
    )


def _checked_view(
    tensors: Mapping[str, Tensor], rest: _ViewHeader, grid: SdfGrid, ground: float, number: int
) -> FurtherView:
    """Return what the camera of this number saw; 0 is the first.

    Raises:
        ValueError, CalibrationError: as of `_checked`.
    """
    camera = rest.camera
    albedo_name, pose_name, weights_name, _ = (f"{name}_{number}" if number else name for name in OF_A_VIEW)
    if albedo_name not in tensors or pose_name not in tensors:
        raise ValueError(f"the tensors {albedo_name!r} and {pose_name!r} were needed")
    albedo = tensors[albedo_name]
    if tuple(albedo.shape[:2]) != (camera.height, camera.width):
        pixels = f"{albedo.shape[1]} x {albedo.shape[0]} pixels of albedo"
        raise ValueError(f"{pixels} were found, {camera.width} x {camera.height} as of the camera were needed")
    refuse_outside(tensors, 0.0, BRIGHTEST, albedo_name, weights_name)
    pose, moved = _pose(tensors, pose_name), f"{MOTION}_{number}"
    motion = _pose(tensors, moved) if moved in tensors else None
    reach = MOST_BOXES * grid.spacing * max(grid.values.shape)
    place = pose.translation if motion is None else motion.apply(pose.translation)
    if np.abs(place - grid.origin.double().numpy()).max() > reach:
        raise ValueError(f"the camera is farther than {MOST_BOXES:g} times the grid's size from it")
    if not pose.translation[2] > ground:
        raise ValueError(f"the ground is at {ground:g}, a camera above the ground was needed")
    weights = tensors[weights_name].float() if weights_name in tensors else None
    if weights is not None and tuple(weights.shape[:2]) != (camera.height, camera.width):
        raise ValueError(f"weights of lobes of shape {tuple(weights.shape)} were found, of each pixel needed")
    return FurtherView(rest.name, albedo.float(), camera, pose, weights, motion)


def _pose(tensors: Mapping[str, Tensor], name: str) -> Pose:
    """Return the rigid motion of this name.

    Raises:
        ValueError: it is none.
    """
    refuse_outside(tensors, -LARGEST_LENGTH, LARGEST_LENGTH, name)
    if not is_rigid(tensors[name].numpy()):
        raise ValueError(f"{name} is no rotation and translation")
    return Pose.from_matrix(tensors[name].numpy())


def checked_grid(values: Tensor, origin: Tensor, step: float) -> SdfGrid:
    """Return a stored SDF after a check that it is finite, of a world's size, and changes no faster than a distance.

    Raises:
        ValueError, CalibrationError: it is not.
    """
    if values.ndim != 3 or tuple(origin.shape) != (3,) or {values.dtype, origin.dtype} != {torch.float32}:
        raise ValueError(f"an SDF of shape {tuple(values.shape)} was found, float32 in three dimensions was needed")
    if min(values.shape) < 2 or values.numel() > MOST_NODES:
        raise ValueError(f"a grid of {tuple(values.shape)} nodes was found, 2 to {MOST_NODES:,} nodes were needed")
    far = MOST_BOXES * step * max(values.shape)
    refuse_outside({"sdf": values}, -far, far, "sdf")
    refuse_outside({"origin": origin}, -far, far, "origin")
    for axis in range(3):
        steepest = float(values.diff(dim=axis).abs().max()) / step
        if not steepest <= STEEPEST:
            found = f"the signed distance of neighbouring nodes differs by {steepest:.3g} voxels"
            raise ValueError(f"{found}, at most {STEEPEST:g} were needed: it is no distance")
        sheets = float((values < 0).diff(dim=axis).sum()) * values.shape[axis] / values.numel()
        if sheets > MOST_SHEETS:
            found = f"{sheets:.3g} surfaces along a line through the grid"
            raise ValueError(f"{found} were found on average, at most {MOST_SHEETS} were needed: it is noise")
    return SdfGrid(values, origin, step)


def _gloss(tensors: Mapping[str, Tensor]) -> Gloss | None:
    if ("lobes" in tensors) != ("lobe_weights" in tensors):
        raise ValueError("lobes without their weights, or weights without lobes, were found; both or none were needed")
    if "lobes" not in tensors:
        return None
    return Gloss(tensors["lobes"], tensors["lobe_weights"].float())
