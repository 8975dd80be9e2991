"""Detail: normals and albedo of a solved surface at the photos' resolution; its file, and sampling it at points."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float16, Int16, UInt8
from torch import Tensor
from torch.nn.functional import normalize

from calibration.calibration import camera_of, is_rigid
from calibration.camera import Camera
from calibration.pose import Pose
from calibration.posed_camera import PosedCamera
from capture.errors import CalibrationError, ReconstructionError
from capture.files.atomic import atomic_file
from capture.files.json_field import JsonField
from capture.files.regular import why
from reconstruct.detail.surface import Window
from reconstruct.fields import BRIGHTEST, MOST_NUMBERS, Fields
from reconstruct.render.g_buffer import RenderView
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.rays import in_line_of_sight
from reconstruct.solve.checkpoint_file import CHECKSUM, FORMAT, checksum, read_whole
from reconstruct.tensor_file import Layout, parsed, refuse_outside, write_tensors

VERSION = "1"
DETAIL = "detail.safetensors"
SURFACE = "surface"  # key of the header: id of the surface
UNIT = 32767  # of a stored normal's component
SURE = 255  # stored confidence 1
SAME_VOXELS = 1.0  # a point this close to the camera's first hit counts as seen
POINTS_AT_ONCE = 2**18
MAKE = "remove it and run again."
LARGEST_SIDE = 2**20  # px, of a photo
LAYOUTS = {
    "normals": Layout("I16", (None, None, 3)),
    "albedo": Layout("F16", (None, None, 3)),
    "confidence": Layout("U8", (None, None)),
    "world_from_camera": Layout("F64", (4, 4)),
}


@dataclass(frozen=True)
class Detail:
    """Normals, albedo and confidence of the object's pixels in a window of the photos. World frame."""

    normals: Int16[np.ndarray, "height width 3"]  # unit normal times UNIT; 0 where no object is seen
    albedo: Float16[np.ndarray, "height width 3"]  # linear, as Fields.albedo
    confidence: UInt8[np.ndarray, "height width"]  # SURE: well seen; 0: nothing better than the surface is known
    posed_camera: PosedCamera  # of the window
    window: Window  # in the photos

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


@dataclass(frozen=True)
class DetailSample:
    """A detail sampled at points of the surface."""

    normals: Float[Tensor, "n 3"]  # unit, world; 0 where there is none
    albedo: Float[Tensor, "n 3"]
    confidence: Float[Tensor, " n"]  # in [0, 1]; 0 where the capture's camera does not see the place


def detail_at(detail: Detail, grid: SdfGrid, points: Float[Tensor, "n 3"]) -> DetailSample:
    """Interpolate the detail at world points on the surface."""
    parts = [_some(detail, grid, part) for part in points.split(POINTS_AT_ONCE)]
    if not parts:
        return DetailSample(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0))
    return DetailSample(*(torch.cat([getattr(p, name) for p in parts]) for name in ("normals", "albedo", "confidence")))


def _some(detail: Detail, grid: SdfGrid, points: Float[Tensor, "n 3"]) -> DetailSample:
    eye = torch.from_numpy(detail.posed_camera.centre).float()
    pixels, depth = detail.posed_camera.project_with_depth(points.double().numpy())
    u, v = pixels.T
    height, width = detail.confidence.shape
    inside = (depth > 0) & (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
    is_seen = torch.from_numpy(inside) & in_line_of_sight(grid, eye, points, SAME_VOXELS * grid.spacing)
    out = DetailSample(torch.zeros_like(points), torch.zeros_like(points), torch.zeros(len(points)))
    places = np.flatnonzero(is_seen.numpy())
    columns, rows = np.minimum(u[places].astype(int), width - 2), np.minimum(v[places].astype(int), height - 2)
    right, down = u[places] - columns, v[places] - rows
    total = np.zeros((len(places), 7))
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        share = (down if i else 1 - down) * (right if j else 1 - right)
        at = rows + i, columns + j
        sure = share * detail.confidence[at] / SURE
        total[:, :3] += sure[:, None] * detail.normals[at]
        total[:, 3:6] += sure[:, None] * detail.albedo[at]
        total[:, 6] += sure
    found = torch.from_numpy(total).float()
    out.normals[places] = normalize(found[:, :3], dim=-1)
    out.albedo[places] = found[:, 3:6] / found[:, 6:].clamp(min=1e-6)
    out.confidence[places] = found[:, 6]
    return out


def with_detail(view: RenderView, detail: Detail | None, camera: Camera) -> RenderView:
    """Return the view with finer normals and albedo where the capture camera saw the surface.

    Args:
        detail: None: the view is returned unchanged.
        camera: of the view, at about the capture camera's distance.
    """
    if detail is None:
        return view
    detail = detail.reduced(detail.posed_camera.camera.fx / camera.fx)
    at = detail_at(detail, view.grid, view.maps.points[view.maps.mask])
    share = at.confidence[:, None]
    normals, albedo = view.maps.normals.clone(), view.albedo.clone()
    normals[view.maps.mask] = normalize(torch.lerp(normals[view.maps.mask], at.normals, share), dim=-1)
    albedo[view.maps.mask] = torch.lerp(albedo[view.maps.mask], at.albedo, share)
    return replace(view, maps=replace(view.maps, normals=normals), albedo=albedo)


def surface_id(fields: Fields) -> str:
    """Return an identifier of a surface."""
    return hashlib.sha256(fields.grid.values.contiguous().numpy().tobytes()).hexdigest()


def save_detail(detail: Detail, fields: Fields, path: Path) -> None:
    """Write a detail as safetensors with a checksum, whole or not at all.

    Args:
        fields: the solved scene that it belongs to.
    """
    tensors = {
        "normals": torch.from_numpy(detail.normals),
        "albedo": torch.from_numpy(detail.albedo),
        "confidence": torch.from_numpy(detail.confidence),
        "world_from_camera": torch.from_numpy(detail.posed_camera.world_from_camera.matrix()),
    }
    rest = {"camera": asdict(detail.posed_camera.camera), "window": asdict(detail.window)}
    header = {FORMAT: VERSION, SURFACE: surface_id(fields), "detail": json.dumps(rest)}
    with atomic_file(path) as temporary:
        write_tensors(tensors, {**header, CHECKSUM: checksum(tensors, header)}, temporary)


def load_detail(path: Path, fields: Fields) -> Detail | None:
    """Read the detail of a surface from a file, which may be a stranger's; None if there is none for this surface.

    Raises:
        ReconstructionError: the file is damaged, of another format, or holds what no run writes.
    """
    if not path.exists() and not path.is_symlink():
        return None
    try:
        stored = read_whole(path, LAYOUTS, MOST_NUMBERS)
        if stored.header.get(FORMAT) != VERSION:
            raise ValueError(f"format {stored.header.get(FORMAT)!r} found, {VERSION!r} needed")
        if stored.header.get(SURFACE) != surface_id(fields):
            return None
        return _checked(
            stored.tensors, JsonField(parsed(stored.header, "detail"), str(path), "the header", MAKE), fields
        )
    except CalibrationError as error:
        raise ReconstructionError(str(error)) from error
    except (OSError, ValueError) as error:
        raise ReconstructionError(f"{path}: not a readable detail ({why(error)}); {MAKE}") from error


def _checked(tensors: Mapping[str, Tensor], rest: JsonField, fields: Fields) -> Detail:
    """Return the detail in a file.

    Raises:
        ValueError, CalibrationError: it is none that a run writes.
    """
    camera = camera_of(rest["camera"], rest["camera"].get("fisheye", False).flag())
    place = rest["window"]
    window = Window(
        place["left"].count(0, LARGEST_SIDE),
        place["top"].count(0, LARGEST_SIDE),
        place["width"].count(2, LARGEST_SIDE),
        place["height"].count(2, LARGEST_SIDE),
    )
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
    return Detail(normals, albedo, confidence, PosedCamera(camera, pose, fields.ground_height), window)
