"""Shadows and silhouette as signed distances on a map of the ground, and the rays along their outlines."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import label

from calibration.ground.ground_field import DARK, GroundField
from calibration.ground.ground_shadows import GROUND_LIKE, GroundShadows, convex_hull
from calibration.ground.shadow_reach import most_height
from calibration.lights.ground_cells import ground_points
from calibration.outlines.metric_cues import MetricCues, ProvenSpace, proven_space
from calibration.posed_camera import PosedCamera
from calibration.side_view import signed_distance

CELLS = 640  # of the map along each side
REACH = 4.0  # of the object's size: how far from its foot shadows are looked at
LIT = 0.5  # visibility from which ground counts as lit
DIM = 2.3  # log units below the brightest 10 % around the object: there a shadow cannot be told
RAYS = 64  # along the outline of a shadow
TOUCHING = 6  # cells: a shadow begins at the object
CUT_SHARE = 0.05  # of the rim of a shadow
SMALLEST = 32  # cells of a shadow
TALLEST = 1.4  # of the silhouette's size: a taller object would be seen as such
# of an outline, px of the ground field: 0.06 to 0.17 in renderings with their true lights
PIXEL_ERROR = 0.15


@dataclass(frozen=True)
class OutlineMaps:
    """World frame, heights above the ground; the last map and the last owner are the camera's."""

    fields: Float[np.ndarray, "views cells cells"]  # signed distance to the edge of lit, bare ground, positive inside
    dark: Bool[np.ndarray, "photos cells cells"]  # bare ground in the object's shadow
    known: Bool[np.ndarray, "photos cells cells"]  # bare ground, lit or in that shadow
    corner: Float[np.ndarray, "2"]  # world x, y of the map's first cell's outer corner
    cell: float
    is_cut: Bool[np.ndarray, " photos"]  # the shadow goes on where nothing is known: its light is badly determined
    starts: Float[np.ndarray, "rays 2"]  # ground points inside shadows or behind the object, next to their outlines
    owner: Int[np.ndarray, " rays"]  # the photo of each ray, or the number of photos for the camera's
    foot: Float[np.ndarray, "3"]  # where the object meets the ground nearest to the camera
    size: float  # of the silhouette at the foot's distance
    pixel: float  # world length of a pixel at the foot
    first_height: Float[np.ndarray, " rays"]  # where a search along each ray begins: where the last one ended
    space: ProvenSpace | None = None  # what is known besides shadows and silhouette, heights above the ground

    def n_photos(self) -> int:
        """Return the number of photos."""
        return len(self.dark)

    def is_outlined(self) -> Bool[np.ndarray, " photos"]:
        """Return which photos show an outline: what no shadow is found in proves no space empty."""
        return np.isin(np.arange(self.n_photos()), self.owner)


def outline_maps(
    field: GroundField, shadows: GroundShadows, posed_camera: PosedCamera, is_hull_unknown: bool = False
) -> OutlineMaps | None:
    """Return the maps of all photos; None where no object is in sight.

    Ground that the object hides, that is no ground, clipped or too dim is unknown: it may be lit or dark.

    Args:
        is_hull_unknown: what lies in the convex hull of the object's outline is unknown, too. What looks like ground
            there may be a level top, lit as the ground is: taken for ground, it proves space empty that is full.
    """
    height, width = shadows.object_mask.shape
    camera = posed_camera.resized(width, height)
    points, down = ground_points(camera)
    mask = shadows.object_mask & down
    if not mask.any():
        return None
    rows, columns = np.nonzero(mask)
    lowest = rows > min(np.quantile(rows, 0.97), rows.max() - 1)
    foot = points[rows[lowest], columns[lowest]].mean(0)
    pixel = float(np.linalg.norm(foot - camera.centre)) / camera.camera.fx
    size = pixel * max(np.ptp(rows), np.ptp(columns), 1)
    near = down & (np.linalg.norm(points - foot, axis=-1) < REACH * size)
    if not near.any():  # a strip at the horizon
        return None
    unknown = convex_hull(mask) if is_hull_unknown else mask
    bare = near & (cv2.GaussianBlur(shadows.likelihood, (0, 0), 1.0) < GROUND_LIKE)
    bare &= cv2.dilate(unknown.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0
    bright = np.quantile(field.light[:, near], 0.9, axis=1)
    black = field.residual < DARK  # too dark to be measured, as a sharpened shadow's rim is, and yet surely dark
    known = bare & (field.usable | black) & (field.light > (bright - DIM)[:, None, None])
    corner, cell = foot[:2] - REACH * size, 2 * REACH * size / CELLS
    look = _from_above(camera, corner, cell)
    sure = np.stack([look(one) > 0.99 for one in known])
    lit = np.stack([look(one) > LIT for one in shadows.visibility]) & sure
    dark = sure & ~lit
    behind = look(unknown) > 0.5
    fields = (np.stack([signed_distance(one) for one in (*lit, ~behind)]) * cell).astype(np.float32)
    cast = [_from_object(one, behind) for one in dark]
    hidden = cv2.dilate(behind.astype(np.uint8), np.ones((2 * TOUCHING + 1, 2 * TOUCHING + 1), np.uint8)) > 0
    is_cut = np.array([_is_cut(one, ~known | one, hidden) for one, known in zip(cast, sure, strict=True)])
    outlines = [_outline(one, other) for one, other in zip(cast, lit, strict=True)]
    outlines = [corner + cell * (one + 0.5) for one in outlines] + [_silhouette(mask, points)]
    owner = np.repeat(np.arange(len(outlines)), [len(one) for one in outlines])
    starts, shadow = np.concatenate(outlines), np.stack(cast)
    known, first_height = sure & ~(dark & ~shadow), np.zeros(len(owner))
    return OutlineMaps(fields, shadow, known, corner, cell, is_cut, starts, owner, foot, size, pixel, first_height)


def with_cues(maps: OutlineMaps, cues: MetricCues, posed_camera: PosedCamera) -> OutlineMaps:
    """Return the maps with the space that photos from the side, or the object's height, prove empty."""
    if not cues:
        return maps
    outline = maps.starts[maps.owner == maps.n_photos()]
    ends = np.column_stack([outline, np.full(len(outline), posed_camera.ground_height)])
    top = min(most_height(posed_camera.centre, ends), TALLEST * maps.size)
    return replace(maps, space=proven_space(cues, outline, top, posed_camera, PIXEL_ERROR * maps.pixel))


def _from_above(camera: PosedCamera, corner: Float[np.ndarray, "2"], cell: float):
    """Return a function that gives the value of a picture at each cell of the map."""
    along = cell * (np.arange(CELLS) + 0.5)
    x, y = np.meshgrid(corner[0] + along, corner[1] + along, indexing="ij")
    pixels, depth = camera.project_with_depth(np.stack([x, y, np.full_like(x, camera.ground_height)], -1))
    pixels[depth <= 0] = -10
    u, v = np.moveaxis(pixels.astype(np.float32), -1, 0)

    def look(picture: np.ndarray) -> Float[np.ndarray, "cells cells"]:
        return cv2.remap(np.ascontiguousarray(picture, np.float32), u, v, cv2.INTER_LINEAR, borderValue=0)

    return look


def _from_object(dark: Bool[np.ndarray, "cells cells"], behind: Bool[np.ndarray, "cells cells"]):
    """Keep the dark pieces that begin at the object: others are edges of the beam, or another thing's shadow."""
    pieces = np.empty(dark.shape, np.int32)
    label(dark, np.ones((3, 3)), output=pieces)
    grown = cv2.dilate(behind.astype(np.uint8), np.ones((2 * TOUCHING + 1, 2 * TOUCHING + 1), np.uint8)) > 0
    sizes = np.bincount(pieces.ravel())
    touching = np.unique(pieces[grown & dark])
    return np.isin(pieces, touching[sizes[touching] >= SMALLEST])


def _is_cut(cast: np.ndarray, unknown_or_cast: np.ndarray, hidden: np.ndarray) -> bool:
    """Whether more than CUT_SHARE of a shadow's rim borders on unknown ground that the object does not hide."""
    rim = (cv2.dilate(cast.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0) & ~cast & ~hidden
    return bool((rim & unknown_or_cast).sum() > CUT_SHARE * max(rim.sum(), 1))


def _outline(dark: Bool[np.ndarray, "cells cells"], lit: Bool[np.ndarray, "cells cells"]):
    """Return evenly chosen cells (row, column) of a shadow beside lit ground."""
    beside = dark & (cv2.dilate(lit.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
    return _some(np.argwhere(beside), RAYS)


def _silhouette(mask: Bool[np.ndarray, "height width"], points: Float[np.ndarray, "height width 3"]):
    """Return the ground points behind evenly chosen pixels of the object's outline."""
    inner = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return _some(points[mask & ~inner][:, :2], 2 * RAYS)


def _some(rows: np.ndarray, count: int) -> np.ndarray:
    return rows[np.unique(np.linspace(0, len(rows) - 1, count).round().astype(int))] if len(rows) else rows
