"""Epipolar tangents: two cameras that see one object, wherever they stand, touch it with the same two planes.

All planes through both camera centres form a pencil about the baseline. The outermost of them that meet the object
touch it (at frontier points), and each camera sees them as tangents of its silhouette. So the first and the last angle
about the baseline are the same in both silhouettes, whatever the object's shape [Porrill and Pollard 1991; Cipolla,
Astrom and Giblin 1995]. A difference is an object that moved or is another one, or a wrong pose.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from calibration.light import Vector
from calibration.posed_camera import PosedCamera

SHORTEST_BASELINE = 0.1  # of the distance to the object: below, a pixel is a large angle about the baseline
OUTLINE_PX = 0.5  # one sigma of an outline; rendered captures gave 0.3 and less
LEAST_SPREAD = np.radians(0.5)  # of the angles of one silhouette


@dataclass(frozen=True, eq=False)
class Silhouette:
    """The object in one view."""

    camera: PosedCamera  # of the mask's pixels
    mask: Bool[np.ndarray, "height width"]

    def outline(self) -> Float[np.ndarray, "n 3"]:
        """Return world directions through the outline's pixels, of z-depth 1."""
        inner = cv2.erode(self.mask.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0) > 0
        rows, columns = np.nonzero(self.mask & ~inner)
        return self.camera.rays(np.stack([columns, rows], -1).astype(float))

    def pixel(self, at: Vector) -> float:
        """Return the size of a pixel at a world point, in the world's unit."""
        return float(np.linalg.norm(at - self.camera.centre)) / self.camera.camera.fx


@dataclass(frozen=True, eq=False)
class Tangent:
    """One plane that two silhouettes should share."""

    views: tuple[int, int]
    normal: Vector  # unit, world, away from the other tangent plane
    gap: float  # by how far along the normal the second view sees the object farther out than the first, world unit
    sigma: float  # one sigma of it, of outlines that are known to OUTLINE_PX


def tangents(silhouettes: Sequence[Silhouette]) -> list[Tangent]:
    """Return both tangents of every pair of views that stand far enough apart."""
    outlines = [one.outline() for one in silhouettes]
    found: list[Tangent] = []
    for i, first in enumerate(silhouettes):
        for j in range(i + 1, len(silhouettes)):
            found += _of_pair((i, j), (first, silhouettes[j]), (outlines[i], outlines[j]))
    return found


def _of_pair(
    views: tuple[int, int], pair: tuple[Silhouette, Silhouette], outlines: tuple[np.ndarray, np.ndarray]
) -> list[Tangent]:
    start, end = (one.camera.centre for one in pair)
    base = end - start
    middle = _middle(pair, outlines)
    away = [float(np.linalg.norm(middle - eye)) for eye in (start, end)]
    if not all(len(rays) for rays in outlines) or np.linalg.norm(base) < SHORTEST_BASELINE * min(away):
        return []
    base = base / np.linalg.norm(base)
    across = (middle - start) - ((middle - start) @ base) * base
    if np.linalg.norm(across) < SHORTEST_BASELINE * min(away):  # the object stands between the cameras
        return []
    across /= np.linalg.norm(across)
    up = np.cross(base, across)
    angles = [np.arctan2(rays @ up, rays @ across) for rays in outlines]
    if min(float(np.ptp(one)) for one in angles) < LEAST_SPREAD or max(np.abs(one).max() for one in angles) > np.pi / 2:
        return []
    found = []
    for pick, sign in ((np.argmin, -1.0), (np.argmax, 1.0)):
        rays = [one[int(pick(angle))] for one, angle in zip(outlines, angles, strict=True)]
        first, second = (float(angle[int(pick(angle))]) for angle in angles)
        at = _nearest((start, end), (rays[0], rays[1]))
        distance = float(np.linalg.norm((at - start) - ((at - start) @ base) * base))
        tilt = 0.5 * (first + second)
        normal = sign * (np.cos(tilt) * up - np.sin(tilt) * across)
        sigma = OUTLINE_PX * float(np.hypot(*(one.pixel(at) for one in pair)))
        found.append(Tangent(views, normal, sign * distance * (second - first), sigma))
    return found


def _middle(pair: tuple[Silhouette, Silhouette], outlines: tuple[np.ndarray, np.ndarray]) -> Vector:
    """Return the world point that both see amid their silhouettes."""
    rays = [one.mean(0) if len(one) else np.array([0.0, 0.0, -1.0]) for one in outlines]
    return _nearest((pair[0].camera.centre, pair[1].camera.centre), (rays[0], rays[1]))


def _nearest(starts: tuple[Vector, Vector], rays: tuple[Vector, Vector]) -> Vector:
    """Return the point with the least squared distance to two lines."""
    square, right = np.zeros((3, 3)), np.zeros(3)
    for start, ray in zip(starts, rays, strict=True):
        along = ray / np.linalg.norm(ray)
        project = np.eye(3) - np.outer(along, along)
        square, right = square + project, right + project @ start
    return np.linalg.lstsq(square, right, rcond=None)[0]
