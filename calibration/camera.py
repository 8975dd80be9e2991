"""A camera with lens distortion, OpenCV models and axes; pixel centres have integer coordinates."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import Float
from msgspec import Meta

from capture.decode.limits import PIXEL_CAP
from capture.files.schema import NotNegative, Number, Positive, Text, refused

# OpenCV's own five rounds leave up to 4 px at the corners of wide lenses; these end at a millionth of a pixel.
UNDISTORT_UNTIL = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-6)
LARGEST_FOCAL = 1e6  # focal length over the picture's longer side: its rays are parallel to a millionth
SMALLEST_FOCAL = 1e-3
LARGEST_DISTORTION = 1e6
Term = Annotated[float, Meta(ge=-LARGEST_DISTORTION, le=LARGEST_DISTORTION)]
FIELD_MARGIN = 1.1  # of the tangent at the picture's corners: distortion is still followed there


@dataclass(frozen=True)
class Camera:
    """Intrinsics in px of the stored photo; distortion in OpenCV order k1 k2 p1 p2 k3.

    A fisheye's is k1 k2 k3 k4 of the angle from the axis (Kannala and Brandt 2006, OpenCV's fisheye), then 0.
    Camera axes: x right, y down, z forward.
    """

    width: int
    height: int
    fx: Positive
    fy: Positive
    cx: Number
    cy: Number
    distortion: tuple[Term, Term, Term, Term, Term] = (0.0, 0.0, 0.0, 0.0, 0.0)
    sigmas: dict[Text, NotNegative] = field(default_factory=dict)  # of fx, cx, cy (px); empty when given as exact
    fisheye: bool = False

    def __post_init__(self):
        if min(self.width, self.height) < 1 or not (self.fx > 0 and self.fy > 0):
            raise ValueError("a camera needs a positive size and focal length")
        if self.width * self.height > PIXEL_CAP:
            raise refused("width", self.width, f"at most {PIXEL_CAP // 1_000_000} megapixels of {self.height} rows")
        longer = max(self.width, self.height)
        if not SMALLEST_FOCAL <= min(self.fx, self.fy) / longer <= max(self.fx, self.fy) / longer <= LARGEST_FOCAL:
            needed = f"{SMALLEST_FOCAL:g} to {LARGEST_FOCAL:g} times the {longer} pixels of the picture, as fy"
            raise refused("fx", self.fx, needed)
        if max(abs(self.cx), abs(self.cy)) > LARGEST_FOCAL * longer:
            raise refused("cx", self.cx, "a principal point near the picture, as cy")

    @staticmethod
    def centred(width: int, height: int, focal: float) -> "Camera":
        """Return a camera without distortion whose axis meets the middle of the picture; focal length in px."""
        return Camera(width, height, focal, focal, width / 2 - 0.5, height / 2 - 0.5)

    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """Return OpenCV's camera matrix K, px."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def project(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
        """Return the pixels (u, v) of points in the camera frame (z > 0), with distortion.

        The polynomial of the distortion holds where it was fitted, in the picture. Far outside it may fold back into
        the picture; there the lens is taken to magnify as at the end of its field.
        """
        flat = np.array(points, dtype=np.float64).reshape(-1, 3)
        if self.fisheye:
            pixels, _ = project_from(flat, np.zeros(6), self.matrix(), np.array(self.distortion), True)
            return pixels.reshape(*points.shape[:-1], 2)
        xy = flat[:, :2] / np.where(flat[:, 2:] == 0, 1.0, flat[:, 2:])  # as OpenCV has it
        if any(self.distortion):
            outside = np.maximum(np.hypot(*xy.T) * np.sign(flat[:, 2]) / self.field, 1.0)[:, None]
            xy = _distorted(xy / outside, self.distortion) * outside
        pixels = xy * [self.fx, self.fy] + [self.cx, self.cy]
        return pixels.reshape(*points.shape[:-1], 2)

    @cached_property
    def field(self) -> float:
        """Tangent of the largest angle from the axis for which the distortion is known, with a margin."""
        right, low = self.width - 1.0, self.height - 1.0
        corners = self.unproject(np.array([[0.0, 0.0], [right, 0.0], [0.0, low], [right, low]]))
        return FIELD_MARGIN * float(np.hypot(corners[:, 0], corners[:, 1]).max())

    def unproject(self, pixels: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 3"]:
        """Return ray directions with z = 1 in the camera frame, so that the range along a ray is z-depth."""
        flat = np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
        if self.fisheye:
            xy = cv2.fisheye.undistortPoints(flat, self.matrix(), np.array(self.distortion[:4]))
        else:
            xy = cv2.undistortPoints(flat, self.matrix(), np.array(self.distortion), criteria=UNDISTORT_UNTIL)
        xy = np.asarray(xy).reshape(-1, 2)
        return np.concatenate([xy, np.ones((len(xy), 1))], 1).reshape(*pixels.shape[:-1], 3)

    def pixel_grid(self) -> Float[np.ndarray, "height width 2"]:
        """Return the (u, v) of every pixel centre."""
        return np.stack(np.meshgrid(np.arange(self.width, dtype=float), np.arange(self.height, dtype=float)), -1)

    def resized(self, width: int, height: int) -> "Camera":
        """Return the camera of a photo resized to width x height px: cx' = (cx + 0.5) * s - 0.5."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
            sigmas={k: v * sx for k, v in self.sigmas.items()},
        )

    def cropped(self, left: int, top: int, width: int, height: int) -> "Camera":
        """Return the camera of the window of a photo that starts at pixel (left, top)."""
        return replace(self, width=width, height=height, cx=self.cx - left, cy=self.cy - top, sigmas=dict(self.sigmas))


def _distorted(
    xy: Float[np.ndarray, "n 2"], distortion: tuple[float, float, float, float, float]
) -> Float[np.ndarray, "n 2"]:
    """Return x / z and y / z as the lens bends them: OpenCV's polynomials (Brown 1966), in a tenth of its time.

    `cv2.projectPoints` computes the Jacobian in any case.
    """
    k1, k2, p1, p2, k3 = distortion
    x, y = xy.T
    r2, xy2 = x * x + y * y, 2 * x * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    tangential = p1 * xy2 + p2 * (r2 + 2 * x * x), p2 * xy2 + p1 * (r2 + 2 * y * y)
    return np.stack([x * radial + tangential[0], y * radial + tangential[1]], -1)


def project_from(
    points: Float[np.ndarray, "n 3"],
    pose: Float[np.ndarray, "6"],
    matrix: Float[np.ndarray, "3 3"],
    distortion: Float[np.ndarray, "5"],
    fisheye: bool,
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "rows 15"]]:
    """Project points from a pose (rotation vector, translation: camera from points); return pixels and their Jacobian.

    The Jacobian's columns are 3 of rotation, 3 of translation, fx, fy, cx, cy, and 5 of distortion.
    """
    points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 1, 3)
    if not fisheye:
        pixels, full = cv2.projectPoints(points, pose[:3], pose[3:], matrix, distortion)[:2]
        return np.asarray(pixels).reshape(-1, 2), np.asarray(full)[:, :15]
    pixels, full = cv2.fisheye.projectPoints(points, pose[:3], pose[3:], matrix, distortion[:4])[:2]
    full = np.asarray(full)  # OpenCV's order here: fx fy cx cy, k1 to k4, rotation, translation, skew
    jacobian = np.column_stack([full[:, 8:14], full[:, :8], np.zeros(len(full))])
    return np.asarray(pixels).reshape(-1, 2), jacobian
