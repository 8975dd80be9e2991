"""Photos of a plane under a handheld flashlight, evaluated from the formula: truth for the light tests, no renderer."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from calibration.camera import Camera
from calibration.light import Light, irradiance
from calibration.pose import Pose
from calibration.posed_camera import PosedCamera
from capture.photos.photo import PhotoStack, decode_srgb, srgb_of

LOBE = (2.2, 0.8, -0.4, 0.9)
POWER = 150000.0
AMBIENT = 0.012
AIM = np.array([30.0, 20.0, 40.0])


def looking_at(eye: np.ndarray, target: np.ndarray) -> Pose:
    """world_from_camera of a camera at eye, the world's up towards the top of its photo."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    return Pose(np.stack([right, np.cross(forward, right), forward], -1), eye)


CAMERA = Camera(640, 480, 620.0, 620.0, 322.0, 236.0, (-0.05, 0.03, 0.0, 0.0, 0.0))
WORLD_FROM_CAMERA = looking_at(np.array([40.0, -480.0, 420.0]), np.array([0.0, 0.0, 0.0]))
POSED_CAMERA = PosedCamera(CAMERA, WORLD_FROM_CAMERA, 0.0)


@dataclass(frozen=True)
class Truth:
    stack: PhotoStack
    lights: tuple[Light, ...]

    def errors(self, lights) -> np.ndarray:
        """Distance of each light from the true one, relative to its range."""
        true = np.array([light.position for light in self.lights], float)
        return np.linalg.norm(self.off(lights), axis=1) / np.linalg.norm(true - AIM, axis=1)

    def off(self, lights) -> np.ndarray:
        """By how much each light misses the true one, mm."""
        found, true = ([light.position for light in which] for which in (lights, self.lights))
        return np.array(found, float) - np.array(true, float)

    def share_inside(self, lights) -> float:
        """Share of coordinates within the stated 95 % interval."""
        return float((np.abs(self.off(lights)) < 1.96 * np.array([light.sigma for light in lights])).mean())


@dataclass(frozen=True)
class Recipe:
    n_photos: int = 10
    noise: float = 0.01  # relative, per pixel
    shadows: bool = True  # an object in the middle and its shadow
    gloss: float = 0.0
    asymmetry: float = 0.0  # of the beam, at 40 degrees off its axis: elliptical, its roll differs from photo to photo
    tone: float = 1.0  # exponent of an unknown tone curve
    contrast: float = 0.0  # of an S-shaped curve on the encoded values: this share of 3 v^2 - 2 v^3
    power_jitter: float = 0.0  # relative, per photo
    width: int = 320  # px, of 4:3 photos
    near: float = 1.0  # the camera's distance, the object's size and the texture's, of the usual ones
    lights: tuple[Light, ...] = field(default=())

    def posed_camera(self) -> PosedCamera:
        return PosedCamera(
            CAMERA, replace(WORLD_FROM_CAMERA, translation=self.near * WORLD_FROM_CAMERA.translation), 0.0
        )


def handheld_lights(n: int, rng: np.random.Generator, reach: tuple[float, float] = (380, 750)) -> tuple[Light, ...]:
    """Lights around the object, each aimed at it within some centimetres."""
    lights = []
    for k in range(n):
        azimuth, elevation = 2 * np.pi * (k + 0.3 * rng.random()) / n, np.radians(rng.uniform(22, 68))
        direction = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        position = AIM + rng.uniform(*reach) * np.array(direction)
        axis = AIM + rng.normal(size=3) * 30 - position
        power = POWER * np.array([1.0, 1.0, 1.0])
        lights.append(
            Light(f"IMG_{k:04d}.jpg", "point", position=position, axis=axis / np.linalg.norm(axis), power=power)
        )
    return tuple(lights)


def photograph(recipe: Recipe, seed: int = 0) -> Truth:
    """The photos of a recipe on a textured plane."""
    rng = np.random.default_rng(seed)
    lights = recipe.lights or handheld_lights(recipe.n_photos, rng)
    height = recipe.width * 3 // 4
    camera = CAMERA.resized(recipe.width, height)
    rays = WORLD_FROM_CAMERA.rotate(camera.unproject(camera.pixel_grid()))
    eye = recipe.near * WORLD_FROM_CAMERA.translation
    points = eye - (eye[2] / np.minimum(rays[..., 2:], -1e-3)) * rays
    x, y = points[..., 0] / recipe.near, points[..., 1] / recipe.near
    albedo = 0.5 + 0.1 * np.sin(x / 23) * np.cos(y / 31) + 0.05 * np.sin((x + y) / 90)
    albedo = albedo[..., None] * [1.0, 0.9, 0.75]
    lights = tuple(replace(k, power=k.power * (1 + recipe.power_jitter * rng.normal())) for k in lights)
    rolls = rng.uniform(0, np.pi, len(lights))
    photos = [_photo(light, points, albedo, recipe, eye, roll) for light, roll in zip(lights, rolls, strict=True)]
    photos = [_with_contrast(photo**recipe.tone, recipe.contrast) for photo in photos]
    rgb = np.stack(photos) * (1 + recipe.noise * rng.normal(size=(len(photos), height, recipe.width, 3)))
    rgb = np.clip(rgb, 1e-4, 1).astype(np.float32)
    paths = tuple(Path(light.photo) for light in lights)
    stack = PhotoStack(rgb, (rgb >= 1).any(-1), paths, 640, 480, (1.0,) * len(photos))
    return Truth(stack, lights)


def _with_contrast(linear: np.ndarray, share: float) -> np.ndarray:
    value = srgb_of(np.clip(linear, 0, 1))
    return decode_srgb(value + share * (value**2 * (3 - 2 * value) - value)) if share else linear


def _lopsided(light: Light, points: np.ndarray, amount: float, roll: float) -> np.ndarray:
    """Factor on the beam: exp(amount cos 2 phi (theta / 40 degrees)^2), theta off the axis, phi about it."""
    assert light.position is not None and light.axis is not None
    toward = points - light.position
    toward = toward / np.linalg.norm(toward, axis=-1, keepdims=True)
    side = np.linalg.svd(light.axis[None])[2][1:]
    theta = np.arccos(np.clip(toward @ light.axis, -1, 1))
    phi = np.arctan2(toward @ side[1], toward @ side[0]) - roll
    return np.exp(amount * np.cos(2 * phi) * (theta / np.radians(40)) ** 2)


def _photo(
    light: Light, points: np.ndarray, albedo: np.ndarray, recipe: Recipe, eye: np.ndarray, roll: float
) -> np.ndarray:
    up = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    flash = irradiance(points, up, light, LOBE)
    if recipe.asymmetry:
        flash = flash * _lopsided(light, points, recipe.asymmetry, roll)[..., None]
    if light.position is None:
        return albedo * (flash + AMBIENT)
    away = -(light.position - AIM)[:2] / np.linalg.norm((light.position - AIM)[:2])
    if recipe.gloss:
        toward, view = (v - points for v in (light.position, eye))
        half = toward / np.linalg.norm(toward, axis=-1, keepdims=True) + view / np.linalg.norm(
            view, axis=-1, keepdims=True
        )
        cosine = half[..., 2] / np.linalg.norm(half, axis=-1)
        flash = flash * (1 + recipe.gloss * cosine[..., None] ** 60)
    if recipe.shadows:
        offset = points[..., :2] / recipe.near - AIM[:2]
        along, across = offset @ away, np.abs(offset @ np.array([-away[1], away[0]]))
        shadow = (across < 45) & (along > 0) & (along < 160)
        flash = np.where(shadow[..., None], 0.02 * flash, flash)
        is_object = np.linalg.norm(offset, axis=-1) < 50
        facing = 0.5 + 0.5 * np.clip(offset @ -away / 50, -1, 1)
        flash = np.where(is_object[..., None], flash * (0.3 + facing[..., None]), flash)
    return albedo * (flash + AMBIENT)
