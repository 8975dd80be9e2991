"""A height field from shading: the start of a solve if colour photos show no known ground."""

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reconstruct.hull.normal_integration import MOST_PIXELS, integrate_normals
from reconstruct.initialization.height_field import HeightField, beside_nothing
from reconstruct.initialization.height_view import HeightView
from reconstruct.labels.highlights import material_without_ground, matt_photos
from reconstruct.labels.photometric_stereo import label_object
from reconstruct.scene import Scene, ground_points, reduced

ROUNDS = 4  # of reading normals and integrating them: each takes half of what the last one's tie held back
FINE_ROUNDS = 1  # of that on all pixels, where only detail is left to find
STEEPEST = 0.2  # cosine to the view: a slope of 5, what the outermost pixel of a ball 25 px wide has on the whole
TAIL, BEYOND = 0.005, 0.1  # of the pixels, and of the others' range: depths further off are breaks at the outline
ROOT = 2.0  # px below the assumed plane, where nothing is ever seen to end


def heights_from_shading(scene: Scene, mask: Float[Tensor, "height width"], view: HeightView) -> HeightField:
    """Integrate the normals of robust photometric stereo to a surface at the median depth of the assumed ground.

    Normals are estimated on the current surface and integrated to depth, in turn: first on few pixels, whose equations
    are solved exactly, then on all pixels. Depth has no absolute scale without near lights or a known ground, so its
    median stays that of the assumed plane.

    Args:
        mask: coverage by the object; everything else is empty.
        view: of the scene, for the frame of the result.
    """
    side = max(scene.camera.width, scene.camera.height)
    few = min(side, int(side * (MOST_PIXELS / max(float((mask > 0.5).sum()), 1.0)) ** 0.5))
    coarse = reduced(scene, few)
    plane = _ranges_of_plane(coarse)
    t = _integrated(coarse, _resized(mask.numpy(), coarse) > 0.5, plane, ROUNDS)
    where = mask.numpy() > 0.5
    if few < side:
        t = _resized(_filled(t), scene)
        t = _integrated(scene, where, t, FINE_ROUNDS)
    depth = _filled(t) * (scene.directions @ scene.forward).numpy()
    return _as_field(depth, scene, view)


def _ranges_of_plane(scene: Scene) -> Float[np.ndarray, "height width"]:
    """Return the lengths of the rays to the assumed ground; where they miss it, the median."""
    t = (ground_points(scene) - scene.eye).norm(dim=-1).double().numpy()
    return np.where(np.isfinite(t), t, np.nanmedian(t))


def _integrated(
    scene: Scene, where: Bool[np.ndarray, "height width"], start: Float[np.ndarray, "height width"], rounds: int
) -> Float[np.ndarray, "height width"]:
    """Return the lengths of the rays to the surface; nan where there is none."""
    rays = scene.directions.double().numpy()
    usual = float(np.median(start[where]))
    t, mask = start, torch.from_numpy(where.astype(np.float32))
    for i in range(rounds):
        own = _normals(rays, t)
        points = scene.eye + torch.from_numpy(t[..., None] * rays).float()
        labels = label_object(scene, points, None, mask)
        if i == 0 and (material := material_without_ground(scene, points, labels)) is not None:
            scene = matt_photos(scene, points, labels, material)
            labels = label_object(scene, points, None, mask)
        normals, trust = labels.normals.double().numpy(), labels.normal_confidence.double().numpy()
        t = integrate_normals(rays, np.where(where, t, np.nan), own, _facing(rays, normals), trust, bounds=True)
        t = _filled(t * (usual / np.nanmedian(t)))
    low, high = np.quantile(t[where], [TAIL, 1 - TAIL])
    t = np.clip(t, low - BEYOND * (high - low), high + BEYOND * (high - low))
    return np.where(where, t, np.nan)


def _facing(
    rays: Float[np.ndarray, "height width 3"], normals: Float[np.ndarray, "height width 3"]
) -> Float[np.ndarray, "height width 3"]:
    """Turn normals towards the eye to a cosine of at least STEEPEST: at the outline they are not known better."""
    cosine = -(normals * rays).sum(-1, keepdims=True)
    across = normals + cosine * rays
    sine = np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-12)
    turned = np.sqrt(1 - STEEPEST**2) * across / sine - STEEPEST * rays
    return np.where(cosine < STEEPEST, turned, normals) * (normals != 0).any(-1, keepdims=True)


def _normals(
    rays: Float[np.ndarray, "height width 3"], t: Float[np.ndarray, "height width"]
) -> Float[np.ndarray, "height width 3"]:
    """Return the normals of the surface through the points t * ray, towards the eye."""
    points = t[..., None] * rays
    normals = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
    normals *= -np.sign((normals * rays).sum(-1, keepdims=True))
    return normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)


def _filled(t: Float[np.ndarray, "height width"]) -> Float[np.ndarray, "height width"]:
    """Fill missing values from the nearest pixel."""
    missing = ~np.isfinite(t)
    if not missing.any() or missing.all():
        return t
    _, number = cv2.distanceTransformWithLabels(
        missing.astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    values = np.zeros(number.max() + 1)
    values[number[~missing]] = t[~missing]
    return values[number]


def _resized(image: np.ndarray, scene: Scene) -> np.ndarray:
    size = (scene.camera.width, scene.camera.height)
    return cv2.resize(image.astype(np.float64), size, interpolation=cv2.INTER_LINEAR)


def _as_field(depth: Float[np.ndarray, "height width"], scene: Scene, view: HeightView) -> HeightField:
    """Convert z-depths on the scene's pixels to heights over the padded, undistorted pixels of a view."""
    heights = view.focal * (view.reference / depth - 1)
    rows, columns = view.shape
    v, u = np.mgrid[:rows, :columns] - float(view.padding)
    rays = np.stack([(u - view.centre[0]) / view.focal, (v - view.centre[1]) / view.focal, np.ones_like(u)], -1)
    at = scene.camera.project(rays).astype(np.float32)
    edge = cv2.BORDER_REPLICATE
    shown = cv2.remap(heights.astype(np.float32), at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=edge)
    undersides = view.ground_heights() - np.float32(ROOT)
    return beside_nothing(HeightField(view, shown, undersides))
