"""Pick points on a solved surface with a ray, and measure lengths between them with their uncertainty."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import KDTree

from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.rays import find_surface


@dataclass(frozen=True)
class PickedPoint:
    """A point of the surface."""

    place: Float[np.ndarray, "3"]  # world
    on_object: bool  # not on the ground


def pick(
    grid: SdfGrid,
    ground_height: float,
    origin: Float[np.ndarray, "3"],
    direction: Float[np.ndarray, "3"],
    span: tuple[float, float] = (0.0, np.inf),
) -> PickedPoint | None:
    """Return the first point of object or ground along a ray; None if it meets neither.

    Args:
        origin, direction: world; the direction may have any length but 0.
        span: the part of the ray in which points are picked, world length from its origin; a section plane hides the
            rest. A ray that enters the object through the plane picks the face of the cut.
    """
    along = direction / np.linalg.norm(direction)
    near, far = span
    begin = origin + near * along
    start, ray = (torch.from_numpy(v).float()[None] for v in (begin, along))
    is_cut = near > 0 and begin[2] >= ground_height and float(grid.sdf(start)[0]) < 0
    to_object = 0.0 if is_cut else float(find_surface(grid, start, ray)[0])
    to_ground = float((ground_height - begin[2]) / along[2]) if along[2] != 0 else np.inf
    to_ground = to_ground if to_ground > 0 else np.inf
    t = min(to_object, to_ground)
    if not np.isfinite(t) or near + t > far:
        return None
    return PickedPoint(begin + t * along, to_object < to_ground)


@dataclass(frozen=True)
class Length:
    """A straight distance, world length."""

    value: float
    sigma: float | None  # one standard deviation; None if that of an end is unknown


def length_between(
    a: Float[np.ndarray, "3"],
    b: Float[np.ndarray, "3"],
    sigmas: tuple[float | None, ...],
    leans: tuple[float, float] = (0.0, 0.0),
) -> Length:
    """Return the distance of two world points whose errors lie along the line between them.

    sigma^2 = s_a^2 + s_b^2 - 2 l_a l_b: errors are independent but for the part that both ends share. The sigmas are
    errors across the surface, and their part along the line is at most that, so the result is conservative. The scale
    error of the whole scene (the accuracy of the printed board) is not included.

    Args:
        sigmas: one sigma of each end, world length.
        leans: the part of each that moves both ends alike (`VertexEvidence.lean`), at most its sigma.
    """
    value = float(np.linalg.norm(b - a))
    known = [sigma for sigma in sigmas if sigma is not None]
    if len(known) < len(sigmas):
        return Length(value, None)
    return Length(value, float(np.sqrt(max(np.square(known).sum() - 2 * leans[0] * leans[1], 0.0))))


def sigma_at(
    picked: PickedPoint, vertices: Float[np.ndarray, "n 3"], sigma: Float[np.ndarray, " n"] | None
) -> float | None:
    """Return a picked point's sigma (or lean): the nearest vertex's; 0 on the ground, which defines the frame.

    Args:
        vertices: world.
        sigma: of the vertices, world length; None if the run has none.
    """
    if not picked.on_object:
        return 0.0
    return None if sigma is None else float(sigma[KDTree(vertices).query(picked.place)[1]])
