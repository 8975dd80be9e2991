"""Spheres and boxes on a ground plane under moving lights: photos and their truth from geometry, without any file.

Millimetres, ground z = 0. One ray per pixel centre, exact hard shadows, Lambertian surfaces, no light between them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float

from calibration.calibration import Calibration
from calibration.camera import Camera
from calibration.light import Light, beam_gain
from calibration.pose import Pose
from capture.photos.photo import PhotoStack
from reconstruct.labels.labels import Labels
from reconstruct.scene import Scene, build_scene
from reconstruct.sdf.grid import SdfGrid

SKIN = 1e-6  # mm along the normal: a shadow ray starts outside the surface it leaves


def _dot(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.einsum("...j,...j", one, other)


@dataclass(frozen=True)
class Sphere:
    """A ball, mm."""

    centre: tuple[float, float, float]
    radius: float
    albedo: tuple[float, float, float] = (0.7, 0.6, 0.5)

    def first(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """First t > 0 along origins + t * directions (inf: none)."""
        offset = origins - np.array(self.centre)
        a, b = _dot(directions, directions), _dot(offset, directions)
        root = b**2 - a * (_dot(offset, offset) - self.radius**2)
        met = root >= 0
        a, b, sqrt = a[met], b[met], np.sqrt(root[met])
        near, far = (-b - sqrt) / a, (-b + sqrt) / a
        t = np.full(len(root), np.inf)
        t[met] = np.where(near > 0, near, np.where(far > 0, far, np.inf))
        return t

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """That t, and the outward normal there."""
        t = self.first(origins, directions)
        at = np.where(np.isfinite(t), t, 0.0)[:, None]
        return t, (origins - np.array(self.centre) + at * directions) / self.radius


@dataclass(frozen=True)
class Box:
    """An upright box between two corners, mm."""

    lower: tuple[float, float, float]
    upper: tuple[float, float, float]
    albedo: tuple[float, float, float] = (0.5, 0.6, 0.7)

    def first(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """First t > 0 along origins + t * directions (inf: none)."""
        return self.hit(origins, directions)[0]

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """That t, and the outward normal there."""
        safe = np.where(directions == 0, 1e-300, directions)
        a, b = (np.array(self.lower) - origins) / safe, (np.array(self.upper) - origins) / safe
        entry, leave = np.minimum(a, b).T, np.maximum(a, b).T
        near = np.maximum(np.maximum(entry[0], entry[1]), entry[2])  # by columns: numpy reduces short rows slowly
        t = np.where((near <= np.minimum(np.minimum(leave[0], leave[1]), leave[2])) & (near > 0), near, np.inf)
        face = np.where(entry[0] == near, 0, np.where(entry[1] == near, 1, 2))
        return t, -np.eye(3)[face] * np.sign(safe[np.arange(len(face)), face])[:, None]


Shape = Sphere | Box
BALL = Sphere((0.0, 0.0, 40.0), 40.0)
HEAP = (Sphere((-25.0, 10.0, 35.0), 35.0), Sphere((30.0, -15.0, 22.0), 22.0), Box((10, 20, 0), (50, 45, 50)))


@dataclass(frozen=True)
class Look:
    """How the photos are taken; the defaults are a plain, noise-free session."""

    width: int = 120
    height: int = 90
    n_lights: int = 16
    kind: str = "point"  # "point" | "directional"
    texture: float = 0.0  # relative amplitude of a smooth pattern on ground and object
    noise: float = 0.0  # one sigma, in units of saturation
    ambient: float = 0.0  # irradiance, as a share of the mean light's on the ground at the origin
    lobe: tuple[float, ...] = ()  # beams point at the origin; see calibration.light.beam_gain
    with_shadow: bool = False  # also give the exact shadow pictures
    with_mask: bool = False  # also give the exact mask
    seed: int = 0


@dataclass(frozen=True)
class Truth:
    """What a perfect reconstruction would find, at pixel centres."""

    depth: Float[np.ndarray, "height width"]  # z-depth, mm, object and ground; inf where the ray meets neither
    points: Float[np.ndarray, "height width 3"]  # world; 0 where nothing
    normals: Float[np.ndarray, "height width 3"]  # world; 0 where nothing
    visibility: Float[np.ndarray, "photos height width"]  # 1 = lit; turned away counts as shadow
    mask: Bool[np.ndarray, "height width"]  # the object
    albedo: Float[np.ndarray, "height width 3"]
    calibration: Calibration
    stack: PhotoStack
    shapes: tuple[Shape, ...] = field(default_factory=tuple)

    def sdf(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Exact distance to the union of the shapes, mm; where shapes overlap inside, a lower bound of it."""
        return np.min([_distance(shape, points) for shape in self.shapes], axis=0)

    def overlap(self, mask: object) -> float:
        """Of what a mask calls object with the object: intersection over union."""
        found = np.asarray(mask) > 0.5
        return float((found & self.mask).sum() / (found | self.mask).sum())

    def degrees(self, normals: object) -> Float[np.ndarray, "height width"]:
        """Angles of unit normals from the true ones."""
        return np.degrees(np.arccos(np.clip((np.asarray(normals) * self.normals).sum(-1), -1, 1)))

    def wrong(self, labels: Any, where: Bool[np.ndarray, "height width"] | None = None) -> float:
        """Share of wrong labels of visibility by their confidence, on the ground or the pixels of a mask."""
        weight = labels.confidence.numpy() * (~self.mask if where is None else where)
        wrong = (labels.visibility.numpy() > 0.5) != (self.visibility > 0.5)
        return float((wrong * weight).sum() / weight.sum())

    def labels(self, confidence: float = 1.0) -> Labels:
        """What is true of mask and normals, and of visibility with this confidence; no albedo."""
        mask, normals, seen = (torch.from_numpy(x).float() for x in (self.mask, self.normals, self.visibility))
        certain = torch.ones_like(mask)
        return Labels(seen, torch.full_like(seen, confidence), mask, certain, normals, mask, 0 * normals)


def render(
    shapes: tuple[Shape, ...] = (BALL,), look: Look | None = None, view: tuple[Camera, Pose] | None = None
) -> tuple[Scene, Truth]:
    """A Scene of the shapes on the ground, and its truth; `view`: a camera of look's size, else default_camera."""
    look = look or Look()
    rng = np.random.default_rng(look.seed)
    camera, world_from_camera = view or default_camera(look.width, look.height)
    rays = world_from_camera.rotate(camera.unproject(camera.pixel_grid())).reshape(-1, 3)
    eye = np.broadcast_to(world_from_camera.translation, rays.shape)
    depth, normals, albedo, is_object = first_hit(shapes, eye, rays)
    seen = np.isfinite(depth)
    points = np.where(seen[:, None], eye + np.where(seen, depth, 0.0)[:, None] * rays, 0.0)
    albedo = albedo * (1 + look.texture * _pattern(points))[:, None] * seen[:, None]
    lights = default_lights(look)
    ambient = look.ambient * float(np.mean([_irradiance(x, np.zeros((1, 3)), look.lobe)[1] for x in lights]))
    visibility, rgb = [], []
    for light in lights:
        towards, strength = _irradiance(light, points, look.lobe)
        cosine = (normals * towards).sum(-1)
        lit = (cosine > 0) & seen & ~_is_blocked(shapes, points + SKIN * normals, light)
        visibility.append(lit)
        direct = strength * np.where(lit, cosine, 0.0)[:, None]
        rgb.append(albedo * (direct + ambient) + look.noise * rng.standard_normal(rays.shape))
    grid = (look.height, look.width)
    pictures = np.clip(np.array(rgb), 0, 1).astype(np.float32).reshape(-1, *grid, 3)
    stack = PhotoStack(
        rgb=pictures,
        clipped=(pictures >= 1).any(-1),
        paths=tuple(Path(light.photo) for light in lights),
        full_width=look.width,
        full_height=look.height,
        gains=(1.0,) * len(lights),
    )
    calibration = Calibration(
        camera, world_from_camera, 0.0, tuple(lights), beam=look.lobe, ambient=np.full(3, ambient)
    )
    truth = Truth(
        depth=depth.reshape(grid),
        points=points.reshape(*grid, 3),
        normals=(normals * seen[:, None]).reshape(*grid, 3),
        visibility=np.array(visibility, dtype=float).reshape(-1, *grid),
        mask=(is_object & seen).reshape(grid),
        albedo=albedo.reshape(*grid, 3),
        calibration=calibration,
        stack=stack,
        shapes=tuple(shapes),
    )
    shadow = truth.visibility if look.with_shadow else None
    mask = truth.mask.astype(float) if look.with_mask else None
    return build_scene(stack, calibration, max(grid), shadow=shadow, mask=mask), truth


def grid_of(shapes: Sequence[Shape], spacing: float) -> SdfGrid:
    """The exact distances from shapes, in a box that goes four nodes beyond them."""
    low = np.min([np.subtract(s.centre, s.radius) if isinstance(s, Sphere) else s.lower for s in shapes], axis=0)
    high = np.max([np.add(s.centre, s.radius) if isinstance(s, Sphere) else s.upper for s in shapes], axis=0)
    axes = [np.arange(a, b, spacing) for a, b in zip(low - 4 * spacing, high + 4 * spacing, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    values = np.min([_distance(shape, nodes) for shape in shapes], axis=0)
    return SdfGrid(torch.from_numpy(values).float(), torch.from_numpy(nodes[0, 0, 0]).float(), spacing)


def default_camera(width: int, height: int) -> tuple[Camera, Pose]:
    """A camera 520 mm from the origin that looks down at it by 45 degrees and sees about 240 mm of ground."""
    focal = 2.1 * width
    camera = Camera(width, height, focal, focal, width / 2 - 0.5, height / 2 - 0.5)
    eye = np.array([0.0, -368.0, 368.0])
    forward = np.array([0.0, 0.0, 15.0]) - eye
    forward /= np.linalg.norm(forward)
    right = np.array([1.0, 0.0, 0.0])
    return camera, Pose(np.stack([right, np.cross(forward, right), forward], 1), eye)


def default_lights(look: Look) -> list[Light]:
    """Lights all around, 20 to 70 degrees above the ground and 400 to 600 mm away, photos well exposed."""
    rng = np.random.default_rng(look.seed + 1)
    azimuth = 2 * np.pi * (np.arange(look.n_lights) * 0.618034 + rng.random() * 0.1)
    elevation = np.radians(20 + 50 * (np.arange(look.n_lights) + 0.5) / look.n_lights)
    elevation = rng.permutation(elevation)
    distance = rng.uniform(400, 600, look.n_lights)
    out = []
    for i in range(look.n_lights):
        flat = np.array([np.cos(azimuth[i]), np.sin(azimuth[i])]) * np.cos(elevation[i])
        towards = np.array([*flat, np.sin(elevation[i])])
        name = f"photo_{i:02d}.png"
        if look.kind == "directional":
            out.append(Light(name, "directional", direction=towards, power=np.full(3, 0.8)))
        else:
            axis = -towards if look.lobe else None
            power = np.full(3, 0.6 * 400.0**2)
            out.append(Light(name, "point", position=distance[i] * towards, power=power, axis=axis))
    return out


def first_hit(
    shapes: tuple[Shape, ...], origins: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """t of the first surface along each ray, its normal, its albedo, and whether it is an object (else ground)."""
    with np.errstate(divide="ignore"):
        t = -origins[:, 2] / directions[:, 2]
    t = np.where(t > 0, t, np.inf)
    normals = np.tile([0.0, 0.0, 1.0], (len(t), 1))
    albedo = np.full((len(t), 3), 0.6)
    is_object = np.zeros(len(t), bool)
    for shape in shapes:
        here, normal = shape.hit(origins, directions)
        nearer = here < t
        t = np.where(nearer, here, t)
        normals = np.where(nearer[:, None], normal, normals)
        albedo = np.where(nearer[:, None], np.array(shape.albedo), albedo)
        is_object |= nearer
    return t, normals, albedo, is_object


def _irradiance(light: Light, points: np.ndarray, lobe: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    place = light.homogeneous()
    towards = place[:3] - place[3] * points
    distance = np.linalg.norm(towards, axis=-1, keepdims=True)
    towards = towards / distance
    strength = np.where(place[3] > 0, distance**-2.0, 1.0) * light.power
    if light.axis is not None:
        strength = strength * beam_gain(-(towards @ light.axis), lobe)[:, None]
    return towards, strength


def _is_blocked(shapes: tuple[Shape, ...], points: np.ndarray, light: Light) -> np.ndarray:
    place = light.homogeneous()
    towards = place[:3] - place[3] * points
    last = 1.0 if place[3] > 0 else np.inf  # of a point light: t = 1 is the light itself
    return np.any([shape.first(points, towards) < last for shape in shapes], axis=0)


def _pattern(points: np.ndarray) -> np.ndarray:
    """Smooth stripes and spots in [-1, 1], about 25 mm wide."""
    x, y, z = np.moveaxis(points, -1, 0) / 8.0
    return 0.5 * np.sin(x + 0.7 * z) + 0.5 * np.sin(1.3 * y - 0.4 * x + z)


def _distance(shape: Shape, points: np.ndarray) -> np.ndarray:
    if isinstance(shape, Sphere):
        return np.linalg.norm(points - np.array(shape.centre), axis=-1) - shape.radius
    lower, upper = np.array(shape.lower), np.array(shape.upper)
    outside = np.maximum(lower - points, points - upper)
    return np.linalg.norm(np.maximum(outside, 0), axis=-1) + np.minimum(outside.max(-1), 0)
