"""Lens distortion for a renderer that has none: a wider pinhole picture is resampled to the distorted photo."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float

from calibration.camera import Camera

MARGIN_PX = 1  # photo pixels around the pinhole picture, for interpolation


@dataclass(frozen=True, eq=False)
class Lens:
    """A camera with distortion, and a pinhole camera (principal point in the middle) whose picture covers its own."""

    camera: Camera
    pinhole: Camera
    finer: int  # the pinhole picture's pixels per photo pixel and axis
    columns: Float[np.ndarray, "fine_height fine_width"]
    rows: Float[np.ndarray, "fine_height fine_width"]

    def photo(self, picture: Float[np.ndarray, "height width 3"]) -> Float[np.ndarray, "photo_height photo_width 3"]:
        """Return the photo of a pinhole picture: each pixel is the mean over its area."""
        fine = cv2.remap(picture, self.columns, self.rows, cv2.INTER_LINEAR)
        return cv2.resize(fine, (self.camera.width, self.camera.height), interpolation=cv2.INTER_AREA)

    def halved(self) -> "Lens":
        """Return the lens with a pinhole picture of half the size; only for that picture, not for photos."""
        return replace(self, pinhole=self.pinhole.resized(self.pinhole.width // 2, self.pinhole.height // 2))


def lens_of(camera: Camera, finer: int) -> Lens:
    """Return the lens of a camera, for pinhole pictures with `finer` pixels per photo pixel and axis."""
    fine = camera.resized(finer * camera.width, finer * camera.height)
    slopes = fine.unproject(fine.pixel_grid())[..., :2]
    widest, highest = np.abs(slopes).reshape(-1, 2).max(0)
    width, height = (2 * finer * int(np.ceil(camera.fx * side + MARGIN_PX)) for side in (widest, highest))
    pinhole = Camera(width, height, fine.fx, fine.fx, (width - 1) / 2, (height - 1) / 2)
    pixels = pinhole.project(np.concatenate([slopes, np.ones((*slopes.shape[:2], 1))], -1)).astype(np.float32)
    return Lens(camera, pinhole, finer, pixels[..., 0], pixels[..., 1])
