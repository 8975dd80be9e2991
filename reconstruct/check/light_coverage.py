"""Coverage of the lights' directions and of the shadows on the ground: do the photos show all sides of the object?"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from calibration.calibrated_views import CalibratedViews
from calibration.calibration import Calibration
from calibration.posed_camera import PosedCamera
from reconstruct.labels.field_ground_test import label_ground
from reconstruct.labels.outline import dilated
from reconstruct.scene import Scene, ground_points, reduced

LEAST_APART = np.radians(30.0)  # of two views' directions
LONG_SIDE = 240  # px: a shadow's area and place need no more
KNOWN = 0.3  # confidence of a ground pixel's label from which it counts
RING = 0.5  # of the object's size in the picture: width of the ring of ground around it where shadows begin
LEAST_SHADOW = 0.03  # of the object's area: a smaller shadow does not constrain its shape
LEAST_CUT = 4  # px of object or shadow on the picture's rim from which it counts as cut off
RIM = 2  # px: the labels of the outermost pixels are often missing
SIDES = (
    "from the camera's side",
    "from the camera's side, right",
    "from the right",
    "from behind, right",
    "from behind the object",
    "from behind, left",
    "from the left",
    "from the camera's side, left",
)


def close_pairs(views: CalibratedViews, foot: Float[np.ndarray, "3"]) -> tuple[tuple[str, str, float], ...]:
    """Return the names of views whose directions from the object are closer than LEAST_APART, and their angle, rad.

    Args:
        foot: where the object stands on the ground, world.
    """
    ways = [(view.name, view.calibration.world_from_camera.translation - foot) for view in views.views]
    ways = [(name, way / np.linalg.norm(way)) for name, way in ways]
    found = ((a, b, float(np.arccos(np.clip(one @ other, -1, 1)))) for (a, one), (b, other) in combinations(ways, 2))
    return tuple(pair for pair in found if pair[2] < LEAST_APART)


def directions(calibration: Calibration, centre: Float[np.ndarray, "3"]) -> Float[np.ndarray, "lights 3"]:
    """Return the unit vectors from the object's centre (world) to each light, world."""
    return np.array([light.seen_from(centre)[0] for light in calibration.lights])


def widest_gap(calibration: Calibration, centre: Float[np.ndarray, "3"]) -> tuple[float, float]:
    """Return start and width (rad, counterclockwise from +x) of the widest azimuth range without a used light."""
    ways = directions(calibration, centre)[[light.used for light in calibration.lights]]
    if not len(ways):
        return 0.0, 2 * np.pi
    azimuth = np.sort(np.arctan2(ways[:, 1], ways[:, 0]))
    gaps = np.diff(np.append(azimuth, azimuth[0] + 2 * np.pi))
    widest = int(np.argmax(gaps))
    return float(azimuth[widest]), float(gaps[widest])


def from_the_camera(azimuth: float, camera: PosedCamera, centre: Float[np.ndarray, "3"]) -> float:
    """Return an azimuth (rad) relative to the direction of the camera; positive is to the camera's right."""
    towards = camera.centre - centre
    if np.hypot(towards[0], towards[1]) < 1e-6 * np.linalg.norm(towards):  # straight from above: below in the picture
        towards = camera.world_from_camera.rotation[:, 1]
    return float((azimuth - np.arctan2(towards[1], towards[0]) + np.pi) % (2 * np.pi) - np.pi)


def side_in_words(azimuth: float, calibration: Calibration, centre: Float[np.ndarray, "3"]) -> str:
    """Describe in words where a light of that azimuth (rad) stands, as seen from the camera."""
    turn = from_the_camera(azimuth, calibration.posed_camera, centre)
    return SIDES[round(turn / (2 * np.pi) * len(SIDES)) % len(SIDES)]


@dataclass(frozen=True)
class ShadowCover:
    """Shadows of the object on the ground, counted per pixel of a small picture."""

    times: Int[np.ndarray, "height width"]  # in how many photos each ground pixel is in shadow
    mask: Bool[np.ndarray, "height width"]  # object
    picture: Float[np.ndarray, "height width 3"]  # the photos' mean, linear
    centre: Float[np.ndarray, "3"]  # of the object on the ground, world
    object_share: float  # of the picture
    ground_share: float  # of the picture that is ground whose light is known
    ring_share: float  # of the ground around the object that was both lit and in shadow
    is_cut: bool  # the object goes on beyond the picture
    with_shadow: Bool[np.ndarray, " photos"]  # a shadow large enough to see
    cut: Bool[np.ndarray, " photos"]  # whose shadow leaves the picture


def shadow_cover(scene: Scene) -> ShadowCover:
    """Read the ground's shadows from the photos of a scene.

    Raises:
        ReconstructionError: one photo has more lights than can be distinguished.
    """
    small = reduced(scene, LONG_SIDE)
    assert small.rgb is not None
    ground = label_ground(small)
    known = ground.confidence > KNOWN
    dark, lit = known & (ground.visibility < 0.5), known & (ground.visibility >= 0.5)
    mask = ground.mask > 0.5
    area = int(mask.sum())
    reach = 2 * int(RING * max(area, 1) ** 0.5) + 1
    near = dilated(mask, reach)
    ring = near & ~mask & known.any(0)
    both = dark.any(0) & lit.any(0)
    rim = torch.ones_like(mask)
    rim[RIM:-RIM, RIM:-RIM] = False
    return ShadowCover(
        times=dark.sum(0).numpy(),
        mask=mask.numpy(),
        picture=small.rgb.mean(0).numpy(),
        centre=_foot(small, mask),
        object_share=area / mask.numel(),
        ground_share=float((known.any(0) & ~mask).float().mean()),
        ring_share=float((both & ring).sum() / ring.sum().clamp(min=1)),
        is_cut=int((mask & rim).sum()) >= LEAST_CUT,
        with_shadow=((dark & ~mask).sum((1, 2)) > LEAST_SHADOW * area).numpy(),
        cut=((dark & rim).sum((1, 2)) >= LEAST_CUT).numpy(),
    )


def _foot(scene: Scene, mask: Bool[torch.Tensor, "height width"]) -> Float[np.ndarray, "3"]:
    """Estimate where the object stands (world): the mean ground point of the half of its pixels nearer to the camera.

    Higher parts of the object hide ground farther away. Without an object, use the ground in the picture's middle.
    """
    points = ground_points(scene)
    chosen = points[mask & torch.isfinite(points).all(-1)]
    if len(chosen):
        distance = torch.linalg.vector_norm(chosen - scene.eye, dim=-1)
        return chosen[distance <= distance.median()].median(0).values.double().numpy()
    middle = points[points.shape[0] // 2, points.shape[1] // 2]
    return torch.nan_to_num(middle).double().numpy()
