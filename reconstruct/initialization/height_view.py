"""The frame of a height field: heights over a camera's own pixels, in which every light ray is a straight line."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float

from reconstruct.labels.labels import Labels
from reconstruct.scene import Scene

PADDING = 0.25  # of the picture's longer side, on every side: what throws shadows into the picture from beyond
SURELY = 0.98  # of a pixel is ground, and known to be
STEEPEST = 0.2  # cosine of a normal to its ray: below, the slope is only known to be steep
HALF = 0.5  # least length of a normal interpolated by the lens correction
HORIZON = -0.9  # of the focal length: the lowest height, ten times as far away as the reference


@dataclass(frozen=True)
class HeightView:
    """Labels, lights and ground over an undistorted picture with square pixels.

    A height is H = focal * (reference / z - 1) pixels, for a z-depth z: inverse depth, so that straight lines in space
    are straight lines over the picture. Lights are in camera axes; the centre of the picture's first pixel is (0, 0).
    """

    focal: float  # px
    centre: tuple[float, float]  # px
    reference: float  # z-depth of height 0, world length
    lights: Float[np.ndarray, "photos 4"]
    visibility: Float[np.ndarray, "photos height width"]
    confidence: Float[np.ndarray, "photos height width"]
    bare: Float[np.ndarray, "height width"]  # how much of a pixel is surely ground
    ground_confidence: Float[np.ndarray, "height width"]  # how sure it is whether a pixel is ground
    ground: tuple[float, float, float]  # height of the ground plane at (u, v): a + b * u + c * v
    ground_known: bool
    slopes: Float[np.ndarray, "2 height width"]  # d log(focal + H) / d(u, v) that shading tells, per px
    trust: Float[np.ndarray, "height width"]  # of them, in [0, 1]

    @property
    def padding(self) -> int:
        """Return the number of pixels around the picture that also belong to the height field."""
        return round(PADDING * max(self.bare.shape))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the height field."""
        height, width = self.bare.shape
        return height + 2 * self.padding, width + 2 * self.padding

    def frame(self) -> tuple[float, float, float, float, int]:
        """Return the frame for the kernels: focal, reference depth, centre x, y, padding."""
        return self.focal, self.reference, *self.centre, self.padding

    def ground_heights(self) -> Float[np.ndarray, "rows columns"]:
        """Return the ground plane as a height field, not below the horizon."""
        rows, columns = self.shape
        v, u = np.mgrid[:rows, :columns] - float(self.padding)
        a, b, c = self.ground
        return np.maximum(a + b * u + c * v, HORIZON * self.focal).astype(np.float32)

    def is_ground(self) -> Bool[np.ndarray, "rows columns"]:
        """Return the pixels where the height field is known to be the ground."""
        inside = (self.bare > SURELY) & self.ground_known
        return np.asarray(np.pad(inside, self.padding))

    def depth(self, heights: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
        """Return the z-depths, world length, of heights in pixels."""
        return self.reference / (1 + heights / self.focal)

    def reduced(self, long_side: int) -> "HeightView":
        """Return the same view on fewer pixels, each the mean of those it covers."""
        height, width = self.bare.shape
        scale = long_side / max(height, width)
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        if scale >= 1:
            return self

        def shrink(images: np.ndarray) -> np.ndarray:
            return np.stack([cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in images])

        confidence, trust = shrink(self.confidence), shrink(self.trust[None])[0]
        a, b, c = self.ground
        shift = (1 / scale - 1) / 2  # of the first pixel's centre
        return replace(
            self,
            focal=self.focal * scale,
            centre=((self.centre[0] + 0.5) * scale - 0.5, (self.centre[1] + 0.5) * scale - 0.5),
            visibility=shrink(self.visibility * self.confidence) / np.maximum(confidence, 1e-6),
            confidence=confidence,
            bare=shrink(self.bare[None])[0],
            ground_confidence=shrink(self.ground_confidence[None])[0],
            ground=((a + shift * (b + c)) * scale, b, c),
            slopes=shrink(self.slopes * self.trust) / np.maximum(trust, 1e-6) / scale,
            trust=trust,
        )


def height_view(scene: Scene, labels: Labels) -> HeightView:
    """Return the labels of a scene, resampled to an undistorted camera.

    The reference depth is the ground's, known or assumed, in the middle of the picture.
    """
    camera, pose = scene.camera, scene.world_from_camera
    v, u = np.mgrid[: camera.height, : camera.width].astype(float)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fx, np.ones_like(u)], -1)
    at = camera.project(rays).astype(np.float32)

    def look(image: np.ndarray) -> np.ndarray:
        image = np.ascontiguousarray(image, np.float32)
        return cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)

    lights = scene.lights.double().numpy()
    eye = pose.translation
    in_camera = np.concatenate([(lights[:, :3] - lights[:, 3:] * eye) @ pose.rotation, lights[:, 3:]], 1)
    per_ray = pose.rotation[2] / (scene.ground_height - eye[2])  # inverse depth of the ground = per_ray . ray
    inverse = np.maximum(rays @ per_ray, 0)
    reference = 1 / float(np.median(inverse[inverse > 0]))
    slope = reference * per_ray
    offset = camera.fx * (slope[2] - 1) - slope[0] * camera.cx - slope[1] * camera.cy
    turned = np.stack([look(image) for image in (labels.normals.double().numpy() @ pose.rotation).transpose(2, 0, 1)])
    slopes, trust = _slopes(turned, rays, look(labels.normal_confidence.numpy()), camera.fx)
    return HeightView(
        focal=float(camera.fx),
        centre=(float(camera.cx), float(camera.cy)),
        reference=reference,
        lights=np.ascontiguousarray(in_camera),
        visibility=np.stack([look(image) for image in labels.visibility.numpy()]),
        confidence=np.stack([look(image) for image in labels.confidence.numpy()]),
        bare=look(((1 - labels.mask) * labels.mask_confidence).numpy()),
        ground_confidence=look(labels.mask_confidence.numpy()),
        ground=(float(offset), float(slope[0]), float(slope[1])),
        ground_known=scene.ground_known,
        slopes=slopes,
        trust=trust,
    )


def _slopes(
    normals: Float[np.ndarray, "3 height width"],
    rays: Float[np.ndarray, "height width 3"],
    trust: Float[np.ndarray, "height width"],
    focal: float,
) -> tuple[Float[np.ndarray, "2 height width"], Float[np.ndarray, "height width"]]:
    """Convert normals in camera axes to slopes of a height field, with their confidence.

    On a plane n . p = d, inverse depth is n . ray / d, so log(focal + H) has the slope n / (focal n . ray).
    """
    length = np.linalg.norm(normals, axis=0)
    facing = -(normals * np.moveaxis(rays, -1, 0)).sum(0) / np.maximum(length, 1e-6)
    known = (length > HALF) & (facing > STEEPEST)
    slopes = normals[:2] / np.where(known, -focal * facing * length, 1.0)
    return np.where(known, slopes, 0.0), np.where(known, trust, 0.0).astype(np.float64)
