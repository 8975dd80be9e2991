"""Scale by one known length of the object, for scenes without a board: lengths in millimetres instead of pixels."""

from dataclasses import replace

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.distance import pdist

from calibration.calibration import Calibration
from capture.errors import ReconstructionError
from reconstruct.fields import Fields
from reconstruct.render.g_buffer import surface_maps

UNKNOWN_SCALE = "scale: "  # beginning of the note that the given length replaces
FEWEST_POINTS = 4


def in_millimetres(fields: Fields, length: float, ground_is_known: bool) -> Fields:
    """Scale a solved scene so that the object's height above the ground, or its extent in the picture, is `length`.

    Without a known ground, the extent is the largest distance between two visible points of the object, across the
    direction of view.

    Args:
        length: mm.

    Raises:
        ReconstructionError: the camera sees no object.
    """
    maps = surface_maps(fields.grid, fields.posed_camera)
    points = maps.points[maps.mask].double().numpy()
    if len(points) < FEWEST_POINTS:
        raise ReconstructionError("the camera sees no object whose length could give the scale. Leave the scale out.")
    if ground_is_known:
        found = float(points[:, 2].max() - fields.ground_height)
    else:
        across = fields.world_from_camera.inverse().rotate(points)[:, :2]
        found = float(pdist(across[ConvexHull(across).vertices]).max())
    return fields.scaled(length / found, "mm")


def with_scale_of(calibration: Calibration, fields: Fields, length: float, ground_is_known: bool) -> Calibration:
    """Return the calibration in the unit of a scaled scene, whose camera is the same, with a note on the length."""
    factor = _height(fields.world_from_camera.translation, fields.ground_height) / _height(
        calibration.world_from_camera.translation, calibration.ground_height
    )
    scaled = calibration.scaled(factor, fields.unit)
    what = "height above the ground" if ground_is_known else "largest extent across the picture"
    note = f"scale: the object's {what} is {length:g} mm, as given; one unit of the files was {factor:.4g} mm"
    notes = [text for text in scaled.residuals.get("notes", []) if not text.startswith(UNKNOWN_SCALE)]
    return replace(scaled, residuals=scaled.residuals | {"notes": [*notes, note]})


def _height(place: np.ndarray, ground: float) -> float:
    return float(place[2]) - ground
