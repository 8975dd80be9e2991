"""Detail: normals and albedo of a solved surface at the photos' resolution, of each view; and their file."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float16, Int16, UInt8
from msgspec import Struct
from torch import Tensor

from calibration.calibration import is_rigid
from calibration.camera import Camera
from calibration.pose import Pose
from calibration.posed_camera import PosedCamera
from capture.errors import CalibrationError, ReconstructionError
from capture.files.atomic import atomic_file
from capture.files.regular import why
from capture.files.schema import as_type
from capture.session.capture import MOST_VIEWS
from reconstruct.detail.surface import Window
from reconstruct.fields import BRIGHTEST, MOST_NUMBERS, SolvedScene
from reconstruct.solve.checkpoint import CHECKSUM, FORMAT, checksum, read_whole
from reconstruct.tensor_file import Layout, parsed, refuse_outside, write_tensors

VERSION = "1"
DETAIL = "detail.safetensors"
SURFACE = "surface"  # key of the header: id of the surface
UNIT = 32767  # of a stored normal's component
SURE = 255  # stored confidence 1
MAKE = "remove it and run again."
LARGEST_SIDE = 2**20  # px, of a photo
OF_A_VIEW = {
    "normals": Layout(torch.int16, (None, None, 3), is_needed=False),
    "albedo": Layout(torch.float16, (None, None, 3), is_needed=False),
    "confidence": Layout(torch.uint8, (None, None), is_needed=False),
    "world_from_camera": Layout(torch.float64, (4, 4), is_needed=False),
}
LAYOUTS = {
    f"{name}{number}": layout
    for number in ("", *(f"_{view}" for view in range(1, MOST_VIEWS)))  # as in fields.safetensors: albedo_1
    for name, layout in OF_A_VIEW.items()
}


@dataclass(frozen=True)
class Detail:
    """Normals, albedo and confidence of the object's pixels in a window of one view's photos. The view's world."""

    normals: Int16[np.ndarray, "height width 3"]  # unit normal times UNIT; 0 where no object is seen
    albedo: Float16[np.ndarray, "height width 3"]  # linear, as SolvedScene.albedo
    confidence: UInt8[np.ndarray, "height width"]  # SURE: well seen; 0: nothing better than the surface is known
    posed_camera: PosedCamera  # of the window
    window: Window  # in the photos
    view: int = 0  # of SolvedScene.views()
    object_from_world: Pose | None = None  # of a view of another object pose; None: the world of the others

    def in_world(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return points of the frame that all views share in the world of this one."""
        return points if self.object_from_world is None else self.object_from_world.inverse().apply(points)

    def reduced(self, shrink: float) -> "Detail":
        """Average over blocks of `shrink` pixels per side, weighted by confidence; unchanged for less than 1.5."""
        if shrink < 1.5:
            return self
        height, width = self.confidence.shape
        size = max(1, round(width / shrink)), max(1, round(height / shrink))
        weight = self.confidence.astype(np.float32) / SURE
        total = cv2.resize(weight, size, interpolation=cv2.INTER_AREA)
        means = []
        for values in (self.normals, self.albedo):
            planes = [cv2.resize(values[..., c] * weight, size, interpolation=cv2.INTER_AREA) for c in range(3)]
            means.append(np.stack(planes, -1) / np.maximum(total, 1 / SURE)[..., None])
        length = np.maximum(np.linalg.norm(means[0], axis=-1, keepdims=True), 1)
        return replace(
            self,
            normals=np.round(UNIT * means[0] / length).astype(np.int16),
            albedo=means[1].astype(np.float16),
            confidence=np.round(SURE * total).astype(np.uint8),
            posed_camera=self.posed_camera.resized(*size),
        )


def surface_id(fields: SolvedScene) -> str:
    """Return an identifier of a surface."""
    return hashlib.sha256(fields.grid.values.contiguous().numpy().tobytes()).hexdigest()


def save_details(details: Sequence[Detail], fields: SolvedScene, path: Path) -> None:
    """Write the details of a surface as safetensors with a checksum, whole or not at all.

    Args:
        details: of different views, at least one.
        fields: the solved scene that they belong to.
    """
    tensors, header = {}, {FORMAT: VERSION, SURFACE: surface_id(fields)}
    for detail in details:
        number = _number(detail.view)
        tensors |= {
            f"normals{number}": torch.from_numpy(detail.normals),
            f"albedo{number}": torch.from_numpy(detail.albedo),
            f"confidence{number}": torch.from_numpy(detail.confidence),
            f"world_from_camera{number}": torch.from_numpy(detail.posed_camera.world_from_camera.matrix()),
        }
        rest = {"camera": asdict(detail.posed_camera.camera), "window": asdict(detail.window)}
        header[f"detail{number}"] = json.dumps(rest)
    with atomic_file(path) as temporary:
        write_tensors(tensors, {**header, CHECKSUM: checksum(tensors, header)}, temporary)


def _number(view: int) -> str:
    """Return what the names of a view's tensors end in."""
    return f"_{view}" if view else ""


class _Header(Struct):
    camera: Camera
    window: Window


def load_details(path: Path, fields: SolvedScene) -> tuple[Detail, ...]:
    """Read the details of a surface from a file, which may be a stranger's; none if there are none for this surface.

    Raises:
        ReconstructionError: the file is damaged, of another format, or holds what no run writes.
    """
    if not path.exists() and not path.is_symlink():
        return ()
    try:
        stored = read_whole(path, LAYOUTS, MOST_NUMBERS)
        if stored.header.get(FORMAT) != VERSION:
            raise ValueError(f"format {stored.header.get(FORMAT)!r} found, {VERSION!r} needed")
        if stored.header.get(SURFACE) != surface_id(fields):
            return ()
        found = []
        for view in range(MOST_VIEWS):
            own = {name: stored.tensors.get(name + _number(view)) for name in OF_A_VIEW}
            tensors = {name: tensor for name, tensor in own.items() if tensor is not None}
            if tensors:
                rest = parsed(stored.header, f"detail{_number(view)}")
                found.append(_checked(tensors, as_type(rest, _Header, f"{path}: the header", MAKE), fields, view))
    except CalibrationError as error:
        raise ReconstructionError(str(error)) from error
    except (OSError, ValueError) as error:
        raise ReconstructionError(f"{path}: not a readable detail ({why(error)}); {MAKE}") from error
    if not found:
        raise ReconstructionError(f"{path}: not a readable detail (it holds none, one was needed); {MAKE}")
    return tuple(found)


def _checked(tensors: Mapping[str, Tensor], rest: _Header, fields: SolvedScene, view: int) -> Detail:
    """Return one view's detail in a file.

    Raises:
        ValueError, CalibrationError: it is none that a run writes.
    """
    seen = (fields, *fields.further)
    if view >= len(seen):
        raise ValueError(f"a detail of view {view + 1} was found, the surface has {len(seen)}")
    missing = OF_A_VIEW.keys() - tensors.keys()
    if missing:
        raise ValueError(f"view {view + 1} lacks {', '.join(sorted(missing))}")
    camera, window = rest.camera, rest.window
    if min(window.left, window.top, window.width - 2, window.height - 2) < 0 or max(astuple(window)) > LARGEST_SIDE:
        raise ValueError(f"{window} was found, 2 pixels each way or more inside a photo were needed")
    size = (window.height, window.width)
    found = [tuple(tensors[name].shape[:2]) for name in ("normals", "albedo", "confidence")]
    if {*found, (camera.height, camera.width)} != {size}:
        raise ValueError(
            f"maps of {found} pixels and a camera of {camera.height} x {camera.width} were found, {size} needed"
        )
    refuse_outside(tensors, 0.0, BRIGHTEST, "albedo")
    if not is_rigid(tensors["world_from_camera"].numpy()):
        raise ValueError("world_from_camera is no rotation and translation")
    pose = Pose.from_matrix(tensors["world_from_camera"].numpy())
    if not pose.translation[2] > fields.ground_height:
        raise ValueError("its camera is below the ground")
    normals, albedo, confidence = (tensors[name].numpy() for name in ("normals", "albedo", "confidence"))
    posed = PosedCamera(camera, pose, fields.ground_height)
    return Detail(normals, albedo, confidence, posed, window, view, seen[view].object_from_world)
