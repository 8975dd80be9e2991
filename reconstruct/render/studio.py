"""A small stage for an object: a camera that goes around it, and a light that suits pictures."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from calibration.camera import Camera
from calibration.light import Light
from calibration.pose import Pose
from calibration.posed_camera import PosedCamera
from reconstruct.fields import Fields
from reconstruct.render.g_buffer import Paint, View, look, paint
from reconstruct.render.relight import relight_soft

FILL = 1.05  # of the height that the sphere around the object takes: most objects fill two thirds of theirs
ASPECT = 16 / 9  # of pictures from free places; the camera's own keep theirs
FOCAL_HEIGHTS = 2.2  # focal length in heights of the picture: 26 degrees, a portrait lens
ELEVATION = (0.26, 0.7)  # rad (15 to 40 degrees): below, the base shows its edge; above, it looks like a map
KEY_ELEVATION, KEY_TURN = 0.87, -0.87  # rad: 50 degrees high, 50 degrees to the left of the camera
KEY_DISTANCE = 10.0  # in radii of the object: the light changes by less than half across it
KEY_STRENGTH = 0.9  # irradiance at the middle: the brightest albedo (0.9), a radius nearer, is just not white
FILL_LIGHT = 0.07  # from everywhere, so that shadows keep a little colour, as in a room
LAMP_RADII = 0.8  # of the lamp, in radii of the object: edges of shadows widen like those of a small softbox
LAMP_SAMPLES = 9  # shadow rays per pixel: fine grain


@dataclass(frozen=True)
class Stage:
    """Where the object stands, and how large it is. World frame."""

    centre: Float[np.ndarray, "3"]
    radius: float  # of the sphere around it


def stage_of(bounds: Float[np.ndarray, "2 3"]) -> Stage:
    """The stage of an object with these lower and upper corners."""
    return Stage(bounds.mean(0), float(np.linalg.norm(np.ptp(bounds, axis=0))) / 2)


def around(stage: Stage, fields: Fields, turn: float, width: int) -> PosedCamera:
    """A camera that looks at the object from `turn` radians (about +z) beside the capture camera.

    Args:
        width: px; the height follows from ASPECT, and both are even.
    """
    width, height = even(width), even(round(width / ASPECT))
    focal = FOCAL_HEIGHTS * height
    camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    half_angle = FILL * height / 2 / focal
    distance = stage.radius / np.sin(np.arctan(half_angle))
    azimuth, elevation = direction_of(fields.posed_camera.centre - stage.centre)
    eye = stage.centre + distance * towards(azimuth + turn, np.clip(elevation, *ELEVATION))
    return PosedCamera(camera, looking_at(eye, stage.centre), fields.ground_height)


def looking_at(eye: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]) -> Pose:
    """world_from_camera of a level camera that looks from one place to another; not straight down."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return Pose(np.stack([right, np.cross(forward, right), forward], 1), eye)


def towards(azimuth: float, elevation: float) -> Float[np.ndarray, "3"]:
    """The unit vector at an azimuth (from +x towards +y) and an elevation above the ground, rad."""
    flat = np.cos(elevation)
    return np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])


def direction_of(vector: Float[np.ndarray, "3"]) -> tuple[float, float]:
    """Azimuth and elevation of a vector, rad."""
    return float(np.arctan2(vector[1], vector[0])), float(np.arctan2(vector[2], np.hypot(vector[0], vector[1])))


def key_light(stage: Stage, azimuth: float, elevation: float = KEY_ELEVATION) -> Light:
    """A lamp that lights the object's middle with KEY_STRENGTH from a direction, rad."""
    distance = KEY_DISTANCE * stage.radius
    power = np.full(3, KEY_STRENGTH * distance**2)
    return Light("", "point", position=stage.centre + distance * towards(azimuth, elevation), power=power)


def lit(
    view: View, light: Light, stage: Stage, lamp_size: float | None = None, samples: int = LAMP_SAMPLES
) -> Float[np.ndarray, "height width 3"]:
    """Linear picture under that lamp and FILL_LIGHT.

    Args:
        lamp_size: its radius, world length; LAMP_RADII unless given, 0: hard shadows.
        samples: shadow rays per pixel, where it has a size.
    """
    radius = LAMP_RADII * stage.radius if lamp_size is None else lamp_size
    return relight_soft(view, light, radius, samples if radius > 0 else 1, (), np.full(3, FILL_LIGHT)).numpy()


def turntable(
    fields: Fields,
    stage: Stage,
    width: int,
    frames: int,
    lamp_size: float | None = None,
    samples: int = LAMP_SAMPLES,
) -> Iterator[Float[np.ndarray, "height width 3"]]:
    """Linear pictures of one full turn of the object before camera and lamp; the last leads into the first."""
    painted = even_ground(paint(fields))
    first = direction_of(fields.posed_camera.centre - stage.centre)[0]
    for k in range(frames):
        turn = 2 * np.pi * k / frames
        view = look(fields, None, around(stage, fields, turn, width), painted)
        yield lit(view, key_light(stage, first + turn + KEY_TURN), stage, lamp_size, samples)


def light_orbit(
    fields: Fields, stage: Stage, width: int, frames: int, lamp_size: float | None = None
) -> Iterator[Float[np.ndarray, "height width 3"]]:
    """Linear pictures from the capture camera while the lamp goes around the object once."""
    camera = fields.camera
    size = even(width), even(round(camera.height * width / camera.width))
    view = look(fields, None, fields.posed_camera.resized(*size))
    first = direction_of(fields.posed_camera.centre - stage.centre)[0]
    for k in range(frames):
        yield lit(view, key_light(stage, first + KEY_TURN + 2 * np.pi * k / frames), stage, lamp_size)


def even_ground(painted: Paint) -> Paint:
    """Ground of one colour, the mean of what is seen of it: the photo shows only a part of it."""
    seen = painted.ground_albedo
    mean = seen.mean(0, keepdims=True) if len(seen) else np.full((1, 3), 0.5, np.float32)
    return replace(painted, ground_points=np.zeros((1, 3), np.float32), ground_albedo=mean)


def even(size: int) -> int:
    """The next smaller even number, at least 2: video halves its colours."""
    return max(2, size // 2 * 2)
