"""Where on the ground the shadow of an object can fall, from its outline in one view and the lights."""

import numpy as np
from jaxtyping import Bool, Float

MARGIN = 0.1  # of the outline's box on the ground: lights and outline are not exact
HIGHEST = 0.95  # of the camera's height
SLICES = 12  # of the object by height; neighbours overlap by the margin
NEAREST = 1.0  # per cent of the outline's points that may be nearer than its foot


def most_height(
    eye: Float[np.ndarray, "3"], outline: Float[np.ndarray, "n 3"], reach: Float[np.ndarray, "rays 3"] | None = None
) -> float:
    """Return the height above the ground that the object cannot exceed if none of it is nearer than its foot.

    A ray that meets the ground at the distance r from the point below the camera is (1 - f / r) of the camera's height
    above the ground at the distance f; f is that of the nearest point, r that of the farthest.

    Args:
        eye: camera centre, world.
        outline: world points where the rays of the object's pixels meet the ground.
        reach: world points on all rays that may meet the object, if those are more.
    """
    if len(outline) == 0:
        return 0.0
    away, height = np.linalg.norm(outline[:, :2] - eye[:2], axis=1), float(eye[2] - outline[:, 2].mean())
    foot = float(np.percentile(away, NEAREST))
    if reach is None:
        share = 1 - foot / float(away.max())
    else:
        slope = (reach[:, 2] - eye[2]) / np.linalg.norm(reach[:, :2] - eye[:2], axis=1)
        share = 1 + foot * float(slope.max()) / height
    return min(share, HIGHEST) * height


def shadow_reach(
    eye: Float[np.ndarray, "3"],
    outline: Float[np.ndarray, "n 3"],
    lights: Float[np.ndarray, "photos 4"],
    points: Float[np.ndarray, "*pixels 3"],
) -> Bool[np.ndarray, " photos *pixels"]:
    """Return whether the segment from each point of the ground to each light passes through where the object may be.

    At the height h it may be inside the box of its outline on the ground, drawn towards the camera by h over the
    camera's height.

    Args:
        eye: camera centre, world.
        outline: world points where the rays of the object's pixels meet the ground, at least one.
        lights: homogeneous, world.
        points: world, on the ground; nan gives False.
    """
    ground = float(outline[:, 2].mean())
    low, high = outline[:, :2].min(0), outline[:, :2].max(0)
    pad = MARGIN * (high - low).max()
    low, high = low - pad, high + pad
    reached = np.zeros((len(lights), *points.shape[:-1]), bool)
    for height in np.linspace(0, most_height(eye, outline), SLICES):
        drawn = height / (eye[2] - ground)
        near, far = low + drawn * (eye[:2] - low), high + drawn * (eye[:2] - high)
        for k, light in enumerate(lights):
            rise = light[2] - light[3] * ground
            if rise <= height * light[3]:
                continue
            at = points[..., :2] + (light[:2] - light[3] * points[..., :2]) * (height / rise)
            reached[k] |= ((at > near) & (at < far)).all(-1)
    return reached
