"""What the pixels of the whole photos see of a solved surface: places, normals, and which lights reach them."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from calibration.camera import Camera
from reconstruct.fields import Fields
from reconstruct.render.g_buffer import RAYS_PER_BLOCK, surface_maps
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.shadow_rays import shadow_starts, unshadowed

MARGIN = 3  # px of the working grid around the object that it found
BORDER_VOXELS = 2.0  # from an outline to where a pixel's place on the surface is sure
STEP_VOXELS = 2.0  # a change of distance between neighbours that is the edge of something in front
STEP_PIXELS = 8.0  # or of so many times a pixel's width on the surface: one seen by less than 7 degrees
LATTICE_VOXELS = 0.5  # between the places whose shadows are computed: the surface has no finer shape
DOUBT_VOXELS = 1.5  # around every shadow where it is not sure that light arrives: the surface is not known better
SURELY_LIT = 0.9  # of the light arrives


@dataclass(frozen=True)
class Window:
    """A part of a photo, px."""

    left: int
    top: int
    width: int
    height: int


@dataclass(frozen=True)
class SeenSurface:
    """The photo's pixels that see the object. World frame."""

    window: Window
    index: Int[np.ndarray, "n"]  # of each pixel in the window, row by row
    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]  # unit, of the solved surface
    inner: Float[np.ndarray, "n"]  # 0 at an outline, 1 from BORDER_VOXELS inwards
    footprint: float  # width of a pixel on a surface that faces the camera, world length

    def picture(self, values: Float[np.ndarray, "n"]) -> Float[np.ndarray, "height width"]:
        """Values of the pixels in the window, 0 elsewhere."""
        return _picture(self.window, self.index, values)


@dataclass(frozen=True)
class Reach:
    """Where each light surely arrives, on a lattice of pixels."""

    stride: int  # px
    lit: UInt8[np.ndarray, "lights rows columns"]  # 1: surely; 0: in shadow, near one, or not known
    width: int  # of the window, px

    def at(self, index: Int[np.ndarray, "n"]) -> Bool[Tensor, "n lights"]:
        """For pixels of the window."""
        row, column = np.divmod(index, self.width)
        return torch.from_numpy(self.lit[:, row // self.stride, column // self.stride].T.astype(bool))


def see_surface(fields: Fields, camera: Camera) -> SeenSurface | None:
    """Points and normals of every pixel of the photos that sees the object; None where none does.

    Args:
        camera: of the photos, at the capture's place.
    """
    window = _around_object(fields, camera)
    if window is None:
        return None
    eye = torch.from_numpy(fields.posed_camera.centre).float()
    posed_camera = replace(fields.posed_camera, camera=camera)
    rows = max(1, RAYS_PER_BLOCK // window.width)
    index, points, normals = [], [], []
    for top in range(0, window.height, rows):
        strip = posed_camera.cropped(window.left, window.top + top, window.width, min(rows, window.height - top))
        maps = surface_maps(fields.grid, strip)
        where = torch.nonzero(maps.mask.reshape(-1))[:, 0]
        index.append((where + top * window.width).to(torch.int32).numpy())
        points.append(maps.points.reshape(-1, 3)[where])
        normals.append(maps.normals.reshape(-1, 3)[where])
    all_points, all_index = torch.cat(points), np.concatenate(index)
    if not len(all_index):
        return None
    distance = (all_points - eye).norm(dim=-1)
    footprint = float(distance.median()) / camera.fx
    inner = _inner(_picture(window, all_index, distance.numpy()), footprint, fields.grid.spacing)
    return SeenSurface(window, all_index, all_points, torch.cat(normals), inner.reshape(-1)[all_index], footprint)


def _picture(
    window: Window, index: Int[np.ndarray, "n"], values: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "height width"]:
    out = np.zeros(window.height * window.width, np.float32)
    out[index] = values
    return out.reshape(window.height, window.width)


def _around_object(fields: Fields, camera: Camera) -> Window | None:
    """The part of the photos that can show the object."""
    small = fields.camera
    mask = surface_maps(fields.grid, fields.posed_camera).mask
    row, column = torch.nonzero(mask).unbind(1)
    if not len(row):
        return None
    scale_x, scale_y = camera.width / small.width, camera.height / small.height
    left = max(0, int((int(column.min()) - MARGIN) * scale_x))
    top = max(0, int((int(row.min()) - MARGIN) * scale_y))
    right = min(camera.width, int((int(column.max()) + 1 + MARGIN) * scale_x) + 1)
    bottom = min(camera.height, int((int(row.max()) + 1 + MARGIN) * scale_y) + 1)
    return Window(left, top, right - left, bottom - top)


def _inner(
    distance: Float[np.ndarray, "height width"], footprint: float, spacing: float
) -> Float[np.ndarray, "height width"]:
    """How far inside what it sees a pixel is: of a picture of distances, 0 where there is no object."""
    step = max(STEP_VOXELS * spacing, STEP_PIXELS * footprint)
    padded = np.pad(distance, 1)  # beyond the window there is no object
    highest, lowest = (morph(padded, np.ones((3, 3), np.uint8))[1:-1, 1:-1] for morph in (cv2.dilate, cv2.erode))
    whole = ((highest - lowest) < step) & (lowest > 0)
    away = cv2.distanceTransform(np.pad(whole.astype(np.uint8), 1), cv2.DIST_L2, 3)[1:-1, 1:-1]
    return np.clip(away * footprint / (BORDER_VOXELS * spacing), 0, 1).astype(np.float32)


def reach_of_lights(grid: SdfGrid, seen: SeenSurface, lights: Float[Tensor, "lights 4"]) -> Reach:
    """Where the solved surface surely lets each light arrive, half a voxel apart at most.

    Light in doubt is left out: penumbrae, and what is nearer to a shadow than the surface's own error.
    """
    stride = max(1, int(LATTICE_VOXELS * grid.spacing / seen.footprint))
    rows, columns = -(-seen.window.height // stride), -(-seen.window.width // stride)
    row, column = np.divmod(seen.index, seen.window.width)
    cells, first = np.unique(row // stride * columns + column // stride, return_index=True)
    points, normals = seen.points[first], seen.normals[first]
    starts = shadow_starts(grid, points, normals, torch.ones(len(points), dtype=torch.bool))
    radius = max(1, round(DOUBT_VOXELS * grid.spacing / (seen.footprint * stride)))
    around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    lit = np.empty((len(lights), rows, columns), np.uint8)
    for k, light in enumerate(lights):
        sure = np.ones(rows * columns, np.uint8)  # beside the object there is no shadow to keep away from
        sure[cells] = (unshadowed(grid, starts, light[None])[0] > SURELY_LIT).numpy()
        lit[k] = cv2.erode(sure.reshape(rows, columns), around)
    return Reach(stride, lit, seen.window.width)
