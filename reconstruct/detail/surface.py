"""Surface points, normals and visibility of the lights at the pixels of full-resolution photos.

Merge normals from shading with those of a solved surface: coarse shape from the surface, fine relief from shading.

Errors of lights and interreflection bend photometric normals smoothly over wide areas; a grid loses relief as small
as its cells. So the rotation from the smoothed photometric normals to the equally smoothed surface normals is applied
to the photometric normals [Nehab et al. 2005, Efficiently combining positions and normals, section 3]. A large
disagreement is attributed to the surface, and the rotation is limited.
"""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor
from torch.nn.functional import normalize

from calibration.camera import Camera
from reconstruct.fields import SolvedScene
from reconstruct.render.g_buffer import RAYS_PER_BLOCK, surface_maps
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.rays import shadow_starts, unshadowed

MARGIN = 3  # px of the working grid around its object
BORDER_VOXELS = 2.0  # width along outlines in which a pixel's place on the surface is uncertain
STEP_VOXELS = 2.0  # a change of distance between neighbours that marks an occluding edge
STEP_PIXELS = 8.0  # the same in pixel widths on the surface: it is seen at less than 7 degrees
LATTICE_VOXELS = 0.5  # spacing of the points whose shadows are computed: the surface has no finer shape
DOUBT_VOXELS = 1.5  # margin around every shadow, the surface's own uncertainty: light is not sure to arrive there
SURELY_LIT = 0.9  # of the light arrives
SMOOTH_VOXELS = 3.0  # sigma: a grid's normals are right from a few cells on
DOUBT_ANGLE = math.radians(20)  # disagreement of which half is attributed to the surface
SAMPLES_PER_SIGMA = 4.0  # of a picture that is reduced before it is smoothed
DUST = 1e-3  # trust of pixels without any, so that their smoothed normal is defined


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
    index: Int[np.ndarray, " n"]  # of each pixel in the window, row by row
    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]  # unit, of the solved surface
    inner: Float[np.ndarray, " n"]  # 0 at an outline, 1 from BORDER_VOXELS inwards
    footprint: float  # width of a pixel on a surface that faces the camera, world length


@dataclass(frozen=True)
class LitMap:
    """Places that each light surely reaches, on a lattice of pixels of the window."""

    stride: int  # px
    lit: UInt8[np.ndarray, "lights rows columns"]  # 1: surely; 0: in shadow, near one, or not known
    width: int  # of the window, px

    def at(self, index: Int[np.ndarray, " n"]) -> Bool[Tensor, "n lights"]:
        """Look up pixels of the window."""
        row, column = np.divmod(index, self.width)
        return torch.from_numpy(self.lit[:, row // self.stride, column // self.stride].T.astype(bool))


def see_surface(fields: SolvedScene, camera: Camera) -> SeenSurface | None:
    """Return points and normals of all photo pixels that see the object; None if none does.

    Args:
        camera: of the photos, at the capture camera's pose.
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
    window: Window, index: Int[np.ndarray, " n"], values: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "height width"]:
    """Return the pixels' values as a picture of the window, 0 elsewhere."""
    out = np.zeros(window.height * window.width, np.float32)
    out[index] = values
    return out.reshape(window.height, window.width)


def _around_object(fields: SolvedScene, camera: Camera) -> Window | None:
    """Return the window of the photos that can show the object."""
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
    """Return 0 at an outline to 1 well inside, from a picture of distances that is 0 off the object."""
    step = max(STEP_VOXELS * spacing, STEP_PIXELS * footprint)
    padded = np.pad(distance, 1)  # beyond the window there is no object
    highest, lowest = (morph(padded, np.ones((3, 3), np.uint8))[1:-1, 1:-1] for morph in (cv2.dilate, cv2.erode))
    whole = ((highest - lowest) < step) & (lowest > 0)
    away = cv2.distanceTransform(np.pad(whole.astype(np.uint8), 1), cv2.DIST_L2, 3)[1:-1, 1:-1]
    return np.clip(away * footprint / (BORDER_VOXELS * spacing), 0, 1).astype(np.float32)


def find_lit(grid: SdfGrid, seen: SeenSurface, lights: Float[Tensor, "lights 4"]) -> LitMap:
    """Find where each light surely reaches the solved surface, at points at most half a voxel apart.

    Uncertain places count as not lit: penumbrae, and places closer to a shadow than the surface's own error.
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
    return LitMap(stride, lit, seen.window.width)


def merged(
    seen: SeenSurface, photometric: Float[Tensor, "n 3"], trust: Float[Tensor, " n"], spacing: float
) -> Float[Tensor, "n 3"]:
    """Return merged unit normals, world; those of the surface where the photometric ones have no trust.

    Args:
        trust: in [0, 1].
        spacing: of the surface's grid, world length.
    """
    sigma = SMOOTH_VOXELS * spacing / seen.footprint
    weight = trust + DUST
    coarse, wanted = (smoothed(seen, normals * weight[:, None], sigma) for normals in (photometric, seen.normals))
    out = torch.empty_like(photometric)
    for part in torch.arange(len(out)).split(2**18):
        axis = torch.linalg.cross(coarse[part], wanted[part])
        sine = torch.linalg.vector_norm(axis, dim=-1, keepdim=True)
        angle = torch.atan2(sine, (coarse[part] * wanted[part]).sum(-1, keepdim=True))
        turned = rotated(photometric[part], axis / sine.clamp(min=1e-9), angle / (1 + (angle / DOUBT_ANGLE) ** 2))
        out[part] = normalize(torch.lerp(seen.normals[part], turned, trust[part, None]), dim=-1)
    return out


def rotated(
    vectors: Float[Tensor, "n 3"], axis: Float[Tensor, "n 3"], angle: Float[Tensor, "n 1"]
) -> Float[Tensor, "n 3"]:
    """Rotate vectors about unit axes by angles (rad), with Rodrigues' formula."""
    along = (axis * vectors).sum(-1, keepdim=True) * axis
    return along + (vectors - along) * angle.cos() + torch.linalg.cross(axis, vectors) * angle.sin()


def smoothed(seen: SeenSurface, vectors: Float[Tensor, "n 3"], sigma: float) -> Float[Tensor, "n 3"]:
    """Smooth vectors over pixels with a Gaussian, and normalise them.

    Args:
        sigma: px; for a large one, a reduced picture is smoothed.
    """
    out = torch.empty_like(vectors)
    shrink = max(1, int(sigma / SAMPLES_PER_SIGMA))
    size = (-(-seen.window.width // shrink), -(-seen.window.height // shrink))
    full = (seen.window.width, seen.window.height)
    for axis in range(3):
        picture = _picture(seen.window, seen.index, np.asarray(vectors[:, axis]))
        if shrink > 1:
            picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        picture = cv2.GaussianBlur(picture, (0, 0), sigma / shrink)
        if shrink > 1:
            picture = cv2.resize(picture, full, interpolation=cv2.INTER_LINEAR)
        out[:, axis] = torch.from_numpy(picture.reshape(-1)[seen.index])
    return normalize(out, dim=-1)
