"""GroundCells: the brightness of each patch of ground under every light."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from calibration.ground.ground_field import GroundField, fit_ground_field
from calibration.ground.table_edges import TableEdge, find_table_edges, on_table
from calibration.lights import hand
from calibration.posed_camera import PosedCamera
from capture.errors import CalibrationError
from capture.photos.photo import PhotoStack

# Ground as far around as the light is away: less of it determines the lights badly, and farther ground is dim.
RADIUS = hand.USUAL
CELL = 0.026  # of the distance from the camera to the ground in the middle of the photo: some 15 px wide
MIN_PIXELS = 6  # fewer pixels in a cell than this leave its mean noisy
MAX_SAMPLES = 60_000  # photos times cells: 40 photos keep all cells
ENOUGH_CELLS = 400  # with many photos, fewer cells suffice
MIN_CELLS = 150  # below this, position, aim and beam cannot be separated
THIN_STRIDE = 7  # between rows: kept cells form no stripes, for every step below
STEEPEST_VIEW = 0.03  # ground seen at less than this cosine is a smear along the horizon


@dataclass(frozen=True)
class GroundCells:
    """The mean colour of square patches of the ground z = ground_height in every photo, world frame."""

    points: Float[np.ndarray, "cells 3"]  # mean of the points that the pixels of a cell see
    rgb: Float[np.ndarray, "photos cells 3"]
    usable: Bool[np.ndarray, "photos cells"]  # no pixel of the cell is clipped
    centre: Float[np.ndarray, "3"]  # ground point in the middle of the photo
    eye: Float[np.ndarray, "3"]  # camera centre

    def grey(self) -> Float[np.ndarray, "photos cells"]:
        """Return the mean of red, green and blue, which has less noise than each of them."""
        return self.rgb.mean(-1)


def ground_points(
    posed_camera: PosedCamera,
) -> tuple[Float[np.ndarray, "height width 3"], Bool[np.ndarray, "height width"]]:
    """The ground point (world) of every pixel, and whether its ray points down at the ground, not along the horizon."""
    rays = posed_camera.rays(posed_camera.camera.pixel_grid())
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    down = rays[..., 2] < -STEEPEST_VIEW
    reach = (posed_camera.ground_height - posed_camera.centre[2]) / np.where(down, rays[..., 2], -1.0)
    return posed_camera.centre + reach[..., None] * rays, down


def ground_ends(
    stack: PhotoStack, posed_camera: PosedCamera, usable: Bool[np.ndarray, " photos"]
) -> tuple[TableEdge, ...]:
    """Return the lines (world) at which the ground ends in these photos of the stack, none if it has no end in view."""
    points, down = ground_points(posed_camera.resized(stack.rgb.shape[2], stack.rgb.shape[1]))
    points = np.where(down[..., None], points, np.nan)
    return find_table_edges(stack.rgb[usable], ~stack.clipped[usable], points, posed_camera.centre)


def field_of(
    stack: PhotoStack,
    posed_camera: PosedCamera,
    usable: Bool[np.ndarray, " photos"],
    edges: Sequence[TableEdge] | None = None,
) -> GroundField:
    """Fit the ground's field to these photos of the stack; what lies beyond the ground's ends gets one of its own.

    Args:
        edges: as ground_ends finds them; None: they are found.
    """
    edges = ground_ends(stack, posed_camera, usable) if edges is None else edges
    points, down = ground_points(posed_camera.resized(stack.rgb.shape[2], stack.rgb.shape[1]))
    beyond = ~(on_table(edges, points) & down) if edges else None
    return fit_ground_field(stack.rgb[usable], ~stack.clipped[usable], beyond)


def _numbers(index: Int[np.ndarray, "pixels 2"]) -> Int[np.ndarray, " pixels"]:
    """Return one number for each cell of a grid, of the cell's two."""
    index = index - index.min(0)
    return index[:, 0] * (index[:, 1].max() + 1) + index[:, 1]


def _thinned(index: Int[np.ndarray, "pixels 2"], n_photos: int) -> Bool[np.ndarray, " pixels"]:
    """Return which pixels to use: of all cells, or for many photos of one of every few, evenly spread."""
    there = len(np.unique(_numbers(index)))
    step = max(int(there // max(MAX_SAMPLES / n_photos, ENOUGH_CELLS)), 1)
    return (index[:, 0] * THIN_STRIDE + index[:, 1]) % step == 0


def sample_ground(stack: PhotoStack, posed_camera: PosedCamera, photos: Int[np.ndarray, " photos"]) -> GroundCells:
    """Average the ground around the middle of the view over square cells, in the chosen photos; linear RGB, world.

    The object is still unknown: cells that it covers are included, and they do not behave like ground.

    Raises:
        CalibrationError: too little ground is in view.
    """
    height, width = stack.rgb.shape[1:3]
    points, down = ground_points(posed_camera.resized(width, height))
    eye = posed_camera.centre
    middle = (height // 2, width // 2)
    if not down[middle] or eye[2] <= posed_camera.ground_height:
        raise CalibrationError(
            "the middle of the photos does not look down at the ground, which is needed to locate the flashlight. "
            "Tilt the camera towards the table, or check that the board lies flat on it."
        )
    centre = points[middle]
    scale = float(np.linalg.norm(centre - eye))
    near = down & (np.linalg.norm(points - centre, axis=-1) < RADIUS)
    index = np.floor((points[near][:, :2] - centre[:2]) / (CELL * scale)).astype(np.int64)
    chosen = _thinned(index, len(photos))
    near[near] = chosen
    seen, cell = points[near], _numbers(index[chosen])
    order = np.argsort(cell, kind="stable")
    _, first, count = np.unique(cell[order], return_index=True, return_counts=True)
    full = count >= MIN_PIXELS
    if full.sum() < MIN_CELLS:
        raise CalibrationError(
            f"{full.sum()} patches of ground are visible around the middle of the photos, {MIN_CELLS} needed to locate "
            "the flashlight from its shading. Show more of the table around the object."
        )

    def mean(values):
        return (np.add.reduceat(values[order], first, axis=0, dtype=np.float64).T / count).T[full]

    rgb = np.stack([mean(stack.rgb[k][near]) for k in photos])
    clipped = np.stack([mean(stack.clipped[k][near].astype(np.float64)) > 0 for k in photos])
    return GroundCells(mean(seen), rgb, ~clipped & (rgb.min(-1) > 0), centre, eye)
