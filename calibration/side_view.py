"""SideView: a handheld photo of the object in room light, with its posed camera and the object's silhouette."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from calibration.posed_camera import PosedCamera

FARTHEST = 1e3  # px beyond which a distance to the outline says no more
LARGEST = 4096  # px: longer side of a window in a file


@dataclass(frozen=True, eq=False)
class SideView:
    """A photo from the side that is used. World frame; pixels of the stored photo."""

    photo: str
    posed_camera: PosedCamera  # of the whole photo
    window: tuple[int, int, int, int]  # left, top, width, height of the part of the photo that holds the object, px
    mask: Bool[np.ndarray, "height width"]  # the object, on the window resized
    sure: Bool[np.ndarray, "height width"]  # pixels whose side of the outline is sure
    sigma_px: float  # of the photo: where a point of the object is seen, one sigma

    @property
    def camera(self) -> PosedCamera:
        """The posed camera of the resized window."""
        return self.posed_camera.cropped(*self.window).resized(self.mask.shape[1], self.mask.shape[0])

    def sigma(self) -> float:
        """Return one sigma of where an outline is seen, px of the resized window: pose and half a pixel."""
        return float(np.hypot(0.5, self.sigma_px * self.mask.shape[1] / self.window[2]))

    def emptiness(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Return by how far (world length) each world point is seen beside the object, surely; negative: not beside it.

        Points that the photo does not show are -inf.
        """
        from scipy.ndimage import map_coordinates  # a page beside a run needs no scipy

        camera = self.camera
        pixels, depth = camera.project_with_depth(points)
        whole, _ = self.posed_camera.project_with_depth(points)
        size = [self.posed_camera.camera.width - 1, self.posed_camera.camera.height - 1]
        seen = (depth > 0) & ((whole >= 0) & (whole <= size)).all(-1)
        beside = np.clip(signed_distance(~self.mask & self.sure), -FARTHEST, FARTHEST)
        found = map_coordinates(beside, pixels.T[::-1], order=1, mode="nearest")
        return np.where(seen, found * depth / camera.camera.fx, -np.inf)

    def outline_rays(self, count: int) -> Float[np.ndarray, "rays 3"]:
        """Return world directions (z-depth 1) through evenly chosen sure pixels of the object beside its outline."""
        outside = (~self.mask).astype(np.uint8)
        rim = self.mask & self.sure & (cv2.dilate(outside, np.ones((3, 3), np.uint8)) > 0)
        rim[[0, -1]], rim[:, [0, -1]] = False, False
        rows, columns = np.nonzero(rim)
        chosen = np.unique(np.linspace(0, len(rows) - 1, count).round().astype(int)) if len(rows) else np.zeros(0, int)
        return self.camera.rays(np.stack([columns, rows], -1)[chosen].astype(float))


def signed_distance(inside: Bool[np.ndarray, "rows columns"]) -> Float[np.ndarray, "rows columns"]:
    """Return the signed distance in cells: positive inside, negative outside, zero half way between the two."""
    plus = cv2.distanceTransform(inside.astype(np.uint8), cv2.DIST_L2, 5)
    minus = cv2.distanceTransform((~inside).astype(np.uint8), cv2.DIST_L2, 5)
    return np.where(inside, plus - 0.5, 0.5 - minus)


def run_lengths(mask: Bool[np.ndarray, "height width"]) -> list[int]:
    """Return the lengths of runs of equal pixels, row by row, beginning with one of False, which may be empty."""
    flat = mask.ravel()
    ends = np.append(np.flatnonzero(np.diff(flat.astype(np.int8))) + 1, len(flat))
    return [*([0] if flat[0] else []), *np.diff(ends, prepend=0).tolist()]


def from_run_lengths(runs: list[int], shape: tuple[int, int]) -> Bool[np.ndarray, "height width"]:
    """Return the mask of run_lengths.

    Raises:
        ValueError: they do not fill it, or the shape is no picture's.
    """
    fills = min(shape) > 0 and max(shape) <= LARGEST and min(runs, default=-1) >= 0 and sum(runs) == shape[0] * shape[1]
    if not fills:
        raise ValueError("runs that fill the window")
    return np.repeat(np.arange(len(runs)) % 2 == 1, runs).reshape(shape)
