"""A virtual studio for an object: a camera that orbits it, and a key light."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from calibration.camera import Camera
from calibration.light import Light
from calibration.pose import Pose
from calibration.posed_camera import PosedCamera
from reconstruct.fields import SolvedScene
from reconstruct.render.g_buffer import RenderView, SeenPoints, look, seen_material
from reconstruct.render.relight import relight_soft

FILL = 1.05  # diameter of the bounding sphere over the picture's height: most objects fill two thirds of their sphere
ASPECT = 16 / 9  # of pictures from free places; the camera's own keep theirs
FOCAL_HEIGHTS = 2.2  # focal length in heights of the picture: 26 degrees, a portrait lens
ELEVATION = (0.26, 0.7)  # rad (15 to 40 degrees): below, the base shows its edge; above, it looks like a map
KEY_ELEVATION, KEY_TURN = 0.87, -0.87  # rad: 50 degrees high, 50 degrees to the left of the camera
KEY_DISTANCE = 10.0  # in radii of the object: the light changes by less than half across it
KEY_STRENGTH = 0.9  # irradiance at the object's centre: the brightest albedo (0.9), a radius nearer, is just unclipped
FILL_LIGHT = 0.07  # ambient: shadows keep a little colour, as in a room
LAMP_RADII = 0.8  # of the lamp, in radii of the object: edges of shadows widen like those of a small softbox
LAMP_SAMPLES = 9  # shadow rays per pixel: fine grain


@dataclass(frozen=True)
class Studio:
    """Place and size of an object. World frame."""

    centre: Float[np.ndarray, "3"]
    radius: float  # of the sphere around it


def studio_of(bounds: Float[np.ndarray, "2 3"]) -> Studio:
    """Return the studio of an object, given the lower and upper corners of its box, world."""
    return Studio(bounds.mean(0), float(np.linalg.norm(np.ptp(bounds, axis=0))) / 2)


def around(studio: Studio, fields: SolvedScene, turn: float, width: int) -> PosedCamera:
    """Return a camera that looks at the object from the capture camera's place turned by `turn` rad about +z.

    Args:
        width: px; the height follows from ASPECT, and both are even.
    """
    width, height = even(width), even(round(width / ASPECT))
    focal = FOCAL_HEIGHTS * height
    camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    half_angle = FILL * height / 2 / focal
    distance = studio.radius / np.sin(np.arctan(half_angle))
    azimuth, elevation = direction_of(fields.posed_camera.centre - studio.centre)
    eye = studio.centre + distance * towards(azimuth + turn, np.clip(elevation, *ELEVATION))
    return PosedCamera(camera, looking_at(eye, studio.centre), fields.ground_height)


def looking_at(eye: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]) -> Pose:
    """Return world_from_camera of a level camera at `eye` that looks at `target`, not straight down."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return Pose(np.stack([right, np.cross(forward, right), forward], 1), eye)


def towards(azimuth: float, elevation: float) -> Float[np.ndarray, "3"]:
    """Return the unit vector at an azimuth (from +x towards +y) and an elevation above the ground, rad."""
    flat = np.cos(elevation)
    return np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])


def direction_of(vector: Float[np.ndarray, "3"]) -> tuple[float, float]:
    """Return azimuth and elevation of a vector, rad."""
    return float(np.arctan2(vector[1], vector[0])), float(np.arctan2(vector[2], np.hypot(vector[0], vector[1])))


def key_light(studio: Studio, azimuth: float, elevation: float = KEY_ELEVATION) -> Light:
    """Return a lamp in a direction (rad) whose irradiance at the object's centre is KEY_STRENGTH."""
    distance = KEY_DISTANCE * studio.radius
    power = np.full(3, KEY_STRENGTH * distance**2)
    return Light("", "point", position=studio.centre + distance * towards(azimuth, elevation), power=power)


def lit(
    view: RenderView, light: Light, studio: Studio, lamp_size: float | None = None, samples: int = LAMP_SAMPLES
) -> Float[np.ndarray, "height width 3"]:
    """Render a linear picture under a lamp and the ambient FILL_LIGHT.

    Args:
        lamp_size: radius of the lamp, world length; default LAMP_RADII object radii, 0: hard shadows.
        samples: shadow rays per pixel for a lamp with a size.
    """
    radius = LAMP_RADII * studio.radius if lamp_size is None else lamp_size
    return relight_soft(view, light, radius, samples if radius > 0 else 1, (), np.full(3, FILL_LIGHT)).numpy()


def turntable(
    fields: SolvedScene,
    studio: Studio,
    width: int,
    frames: int,
    lamp_size: float | None = None,
    samples: int = LAMP_SAMPLES,
) -> Iterator[Float[np.ndarray, "height width 3"]]:
    """Yield linear pictures of one full turn of the object before fixed camera and lamp; the sequence loops."""
    material = seen_material(fields)
    ground = material.on_ground.values
    mean = ground.mean(0, keepdims=True) if len(ground) else np.full((1, 3), 0.5, np.float32)
    # The photo shows only a part of the ground, so all of it gets the mean of what is seen.
    material = replace(material, on_ground=SeenPoints(np.zeros((1, 3), np.float32), mean))
    first = direction_of(fields.posed_camera.centre - studio.centre)[0]
    for k in range(frames):
        turn = 2 * np.pi * k / frames
        view = look(fields, None, around(studio, fields, turn, width), material)
        yield lit(view, key_light(studio, first + turn + KEY_TURN), studio, lamp_size, samples)


def light_orbit(
    fields: SolvedScene, studio: Studio, width: int, frames: int, lamp_size: float | None = None
) -> Iterator[Float[np.ndarray, "height width 3"]]:
    """Yield linear pictures from the capture camera while the lamp orbits the object once."""
    camera = fields.camera
    size = even(width), even(round(camera.height * width / camera.width))
    view = look(fields, None, fields.posed_camera.resized(*size))
    first = direction_of(fields.posed_camera.centre - studio.centre)[0]
    for k in range(frames):
        yield lit(view, key_light(studio, first + KEY_TURN + 2 * np.pi * k / frames), studio, lamp_size)


def even(size: int) -> int:
    """Round down to an even number, at least 2: video has half the resolution in colour."""
    return max(2, size // 2 * 2)
