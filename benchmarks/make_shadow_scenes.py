"""Make scenes of shadow pictures alone, as the paper's binary set has them, or of colour photos, with their truth.

    python benchmarks/make_shadow_scenes.py OUT [--objects chair table ...] [--views above oblique] [--mesh MESH.ply]
        [--paints matt glossy]

With --paints, r_NNN.png are photos of a patterned object on a patterned matt ground, and the outline is given, too.
Without, each scene OUT/OBJECT_VIEW has the ShadowNeuS layout (transforms_train.json, transforms_floor.json and
train/*_white_.png): one camera, level ground of known height, 40 point lights, no mask, no colour. gt/ holds the truth
that `shadowgraph evaluate` reads. A pixel is dark where most of 4 x 4 rays are; a surface turned away is dark, too.
Needs embreex (the extra `generator`).
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import trimesh
from skimage.measure import marching_cubes

SIDE = 200  # px
CAMERA_ANGLE_X = 0.6911112070083618  # rad, horizontal field of view
LIGHTS = 40
SUB = 4  # rays per pixel along each axis
NODES = 320  # of the grid that an object's surface is taken from, along its longest side
SUNK = 0.004  # below the ground, so that no two surfaces coincide
LIFT = 2e-4  # along the normal: a shadow ray starts outside the surface it leaves
EXPOSURE = 0.9  # of the brightest thousandth of all photos
PAINTS = {"matt": (0.5, 0.0), "glossy": (0.25, 0.06)}  # roughness, and reflectance of the gloss at normal incidence
VIEWS = {"above": (0.0, 0.0, 3.6), "oblique": (1.384, -2.397, 1.797)}  # of the camera, world

Distance = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]  # of x, y, z


def box(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> Distance:
    """An upright box between two corners."""

    def distance(*at: np.ndarray) -> np.ndarray:
        beyond = [np.maximum(low - v, v - high) for v, (low, high) in zip(at, (x, y, z), strict=True)]
        return np.maximum(np.maximum(beyond[0], beyond[1]), beyond[2])

    return distance


def rod(start: tuple[float, float, float], end: tuple[float, float, float], radius: float) -> Distance:
    """A rod with round ends."""
    first, along = np.array(start), np.subtract(end, start)

    def distance(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        away = [v - f for v, f in zip((x, y, z), first, strict=True)]
        t = np.clip(sum(v * d for v, d in zip(away, along, strict=True)) / (along @ along), 0, 1)
        return np.sqrt(sum((v - t * d) ** 2 for v, d in zip(away, along, strict=True))) - radius

    return distance


def ring(centre: tuple[float, float, float], axis: tuple[float, float, float], radius: float, thick: float) -> Distance:
    """A torus about an axis."""
    normal = np.array(axis) / np.linalg.norm(axis)

    def distance(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        away = [v - c for v, c in zip((x, y, z), centre, strict=True)]
        up = sum(v * n for v, n in zip(away, normal, strict=True))
        out = np.sqrt(np.maximum(sum(v * v for v in away) - up**2, 0)) - radius
        return np.sqrt(out**2 + up**2) - thick

    return distance


def disc(centre: tuple[float, float, float], radius: float, thick: float) -> Distance:
    """A level round plate."""
    cx, cy, cz = centre
    return lambda x, y, z: np.maximum(np.hypot(x - cx, y - cy) - radius, np.abs(z - cz) - thick / 2)


def chair() -> list[Distance]:
    """Four legs, a seat, two posts, four slats and a rail; height 1.4, legs 0.07 wide."""
    parts = [box((-0.4, 0.4), (-0.4, 0.4), (-0.15, -0.07)), box((-0.4, 0.4), (0.33, 0.4), (0.58, 0.7))]
    for x in (-0.4, 0.33):
        parts += [box((x, x + 0.07), (-0.4, -0.33), (-0.704, -0.1)), box((x, x + 0.07), (0.33, 0.4), (-0.704, 0.65))]
    return parts + [box((x, x + 0.05), (0.345, 0.385), (-0.1, 0.6)) for x in (-0.24, -0.1, 0.05, 0.19)]


def table() -> list[Distance]:
    """A round top on four slanting legs with struts across; height 0.85."""
    parts = [disc((0, 0, 0.11), 0.75, 0.07)]
    feet = [(0.55 * np.cos(a), 0.55 * np.sin(a)) for a in np.arange(4) * np.pi / 2]
    parts += [rod((x, y, -0.74), (0.8 * x, 0.8 * y, 0.1), 0.04) for x, y in feet]
    return parts + [rod((0.9 * x, 0.9 * y, -0.3), (-0.9 * x, -0.9 * y, -0.3), 0.03) for x, y in feet[:2]]


def wheel() -> list[Distance]:
    """A leaning wheel with a hub and eight spokes on a stand; radius 0.6."""
    axis, middle = np.array([0.0, -0.57, 0.82]), np.array([0.0, 0.0, -0.05])
    across, up = np.array([1.0, 0, 0]), np.array([0.0, 0.82, 0.57])
    parts = [
        ring(tuple(middle), tuple(axis), 0.6, 0.06),
        rod(tuple(middle - 0.1 * axis), tuple(middle + 0.1 * axis), 0.1),
    ]
    for angle in np.arange(8) * np.pi / 4:
        end = middle + 0.6 * (np.cos(angle) * across + np.sin(angle) * up)
        parts.append(rod(tuple(middle), tuple(end), 0.03))
    return [*parts, rod((0, 0, -0.1), (0, 0, -0.66), 0.06), box((-0.3, 0.3), (-0.3, 0.3), (-0.704, -0.62))]


def vase() -> list[Distance]:
    """A solid: a ball on a foot beside a block and a flat step."""
    return [
        lambda x, y, z: np.sqrt((x + 0.25) ** 2 + (y - 0.2) ** 2 + (z + 0.15) ** 2) - 0.42,
        rod((-0.25, 0.2, -0.7), (-0.25, 0.2, -0.4), 0.2),
        box((0.1, 0.6), (-0.5, 0.05), (-0.704, -0.1)),
        box((-0.5, 0.1), (-0.6, -0.2), (-0.704, -0.55)),
    ]


def figure() -> list[Distance]:
    """Three lumps, one of which hangs out over the other two, and an arm to the side."""

    def lump(at: tuple[float, float, float], size: tuple[float, float, float]) -> Distance:
        def distance(*where: np.ndarray) -> np.ndarray:
            scaled = [(v - c) / s for v, c, s in zip(where, at, size, strict=True)]
            return (np.sqrt(sum(v * v for v in scaled)) - 1) * min(size)

        return distance

    parts = [lump((0, 0.1, -0.4), (0.5, 0.45, 0.42)), lump((0, 0, 0.1), (0.36, 0.32, 0.4))]
    return [*parts, lump((0.05, -0.2, 0.55), (0.3, 0.33, 0.26)), rod((0.3, 0, 0.15), (0.75, -0.2, 0.4), 0.1)]


def teapot() -> list[Distance]:
    """A round pot with a lid and its knob, a spout and a handle."""
    parts = [
        lambda x, y, z: np.sqrt(x**2 + y**2 + ((z + 0.3) / 0.85) ** 2) - 0.47,
        disc((0, 0, -0.66), 0.3, 0.1),
        lambda x, y, z: np.sqrt(x**2 + y**2 + (z - 0.17) ** 2) - 0.08,
    ]
    spout = [rod((0.4, 0, -0.4), (0.62, 0, -0.25), 0.09), rod((0.62, 0, -0.25), (0.75, 0, 0.02), 0.06)]
    return [*parts, *spout, ring((-0.48, 0, -0.28), (0, 1, 0), 0.22, 0.05)]


def plant() -> list[Distance]:
    """A pot, a stem and seven leaves: flat, thin, pointing up and outward."""

    def leaf(azimuth: float, low: float, rise: float) -> Distance:
        out = np.array([np.cos(azimuth), np.sin(azimuth), 0])
        along = np.cos(rise) * out + [0, 0, np.sin(rise)]
        across = np.array([-np.sin(azimuth), np.cos(azimuth), 0])
        middle, normal = np.array([0, 0, low]) + 0.36 * along, np.cross(along, across)

        def distance(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
            away = [v - c for v, c in zip((x, y, z), middle, strict=True)]
            a, b, c = (sum(v * d for v, d in zip(away, axis, strict=True)) for axis in (along, across, normal))
            outline = (np.sqrt((a / 0.34) ** 2 + (b / 0.15) ** 2) - 1) * 0.15
            return np.maximum(outline, np.abs(c) - 0.02)

        return distance

    leaves = [leaf(2.4 * k, -0.2 + 0.09 * k, 0.25 + 0.12 * k) for k in range(7)]
    pot = [disc((0, 0, -0.5), 0.3, 0.4), rod((0, 0, -0.4), (0, 0, 0.6), 0.035)]
    return [*pot, *leaves]


OBJECTS = {"chair": (chair, 25.0), "table": (table, 17.0), "wheel": (wheel, 40.0), "vase": (vase, 10.0)}  # degrees
OBJECTS |= {"figure": (figure, 30.0), "teapot": (teapot, 35.0), "plant": (plant, 20.0)}


def surface(parts: list[Distance], turned: float) -> trimesh.Trimesh:
    """The closed surface of a union of parts, world."""
    low, high = np.full(3, -1.0), np.full(3, 1.0)
    step = (high - low).max() / (NODES - 1)
    x, y, z = (low[a] + step * np.arange(NODES, dtype=np.float32) for a in range(3))
    phi = np.full((NODES,) * 3, 1.0, np.float32)
    for part in parts:
        np.minimum(phi, part(x[:, None, None], y[None, :, None], z[None, None, :]), out=phi)
    vertices, faces, _, _ = marching_cubes(phi, 0.0, gradient_direction="descent")
    mesh = trimesh.Trimesh(low + step * vertices, faces[:, ::-1], process=True)
    mesh = mesh if mesh.volume > 0 else trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=True)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.radians(turned), [0, 0, 1]))
    return mesh


def looking(place: np.ndarray) -> np.ndarray:
    """World from something at a place that looks at the origin along its -z, x level (OpenGL axes)."""
    z = place / np.linalg.norm(place)
    x = np.cross([0.0, 0.0, 1.0], z)
    x = np.array([1.0, 0, 0]) if np.linalg.norm(x) < 1e-6 else x / np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3] = np.c_[x, np.cross(z, x), z, place]
    return pose


def lights(seed: int) -> np.ndarray:
    """Point lights spread over the sky, 15 to 75 degrees high, (n, 3) world."""
    generator = np.random.default_rng(seed)
    share = (np.arange(LIGHTS) + 0.5) / LIGHTS
    sine = np.sin(np.radians(15)) * (1 - share) + np.sin(np.radians(75)) * share
    azimuth = np.arange(LIGHTS) * np.pi * (3 - np.sqrt(5)) + generator.uniform(0, 2 * np.pi)
    distance = generator.uniform(2.9, 4.0, LIGHTS)
    level = np.sqrt(1 - sine**2)
    return distance[:, None] * np.c_[level * np.cos(azimuth), level * np.sin(azimuth), sine]


def first_hits(mesh: trimesh.Trimesh, eye: np.ndarray, rays: np.ndarray, ground: float) -> tuple[np.ndarray, ...]:
    """Length along each ray, unit normal, and whether the object is hit, of object and ground."""
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    t = np.where(rays[:, 2] < 0, (ground - eye[2]) / np.minimum(rays[:, 2], -1e-9), np.inf)
    normals = np.tile([0.0, 0.0, 1.0], (len(rays), 1))
    triangle = RayMeshIntersector(mesh).intersects_first(np.broadcast_to(eye, rays.shape), rays)
    k = np.flatnonzero(triangle >= 0)
    facing = mesh.face_normals[triangle[k]]
    near = ((mesh.triangles[triangle[k], 0] - eye) * facing).sum(1) / (facing * rays[k]).sum(1)
    nearer = near < t[k]
    t[k[nearer]], normals[k[nearer]] = near[nearer], facing[nearer]
    on_object = np.zeros(len(rays), bool)
    on_object[k[nearer]] = True
    return t, normals, on_object


def pattern(points: np.ndarray, on_object: np.ndarray) -> np.ndarray:
    """Albedo of object and ground at world points, (n, 3)."""
    waves = np.stack([np.sin(points @ w) for w in np.array([[9.0, 4, 3], [-3, 7, 8], [5, -6, 7]])], -1)
    own = np.where(waves[:, :1] + waves[:, 1:2] > 0.2, [0.65, 0.45, 0.3], [0.3, 0.45, 0.6]) * (1 + 0.15 * waves)
    grain = 1 + 0.2 * np.sin(23 * points[:, :1]) * np.sin(19 * points[:, 1:2]) + 0.1 * waves[:, 2:]
    return np.where(on_object[:, None], own, np.array([0.55, 0.5, 0.45]) * grain)


def shaded(surface: tuple[np.ndarray, ...], towards: np.ndarray, eye: np.ndarray, paint: str) -> np.ndarray:
    """Radiance under one unshadowed light of intensity 1: matt, and a GGX lobe on the object [Walter et al. 2007]."""
    points, normals, albedo, on_object = surface
    distance = np.linalg.norm(towards, axis=1)
    light, view = towards / distance[:, None], eye - points
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    half = light + view
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    cosine, out, middle = (np.clip((normals * v).sum(1), 1e-4, 1) for v in (light, view, half))
    roughness, mirror = PAINTS[paint]
    alpha = roughness**2
    spread = alpha**2 / (np.pi * (middle**2 * (alpha**2 - 1) + 1) ** 2)
    masked = [c + np.sqrt(alpha**2 + (1 - alpha**2) * c**2) for c in (cosine, out)]
    fresnel = mirror + (1 - mirror) * (1 - (half * view).sum(1)) ** 5
    gloss = np.where(on_object & (mirror > 0), spread * fresnel / (masked[0] * masked[1]), 0)
    return (albedo / np.pi + gloss[:, None]) * (cosine / distance**2)[:, None]


def encoded(linear: np.ndarray) -> np.ndarray:
    """Linear radiance as 8-bit sRGB."""
    x = np.clip(linear, 0, 1)
    return np.round(255 * np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)).astype(np.uint8)


def render(
    mesh: trimesh.Trimesh, eye: np.ndarray, ground: float, places: np.ndarray, out: Path, paint: str | None
) -> None:
    """Write one scene; without a paint, of shadow pictures alone."""
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    pose, focal = looking(eye), SIDE / 2 / np.tan(CAMERA_ANGLE_X / 2)
    rotation = pose[:3, :3] @ np.diag([1.0, -1, -1])

    def rays(n: int) -> np.ndarray:
        v, u = np.mgrid[: n * SIDE, : n * SIDE]
        u, v = (u + 0.5) / n, (v + 0.5) / n
        local = np.stack([(u - SIDE / 2) / focal, (v - SIDE / 2) / focal, np.ones_like(u)], -1)
        return local.reshape(-1, 3) @ rotation.T

    for folder in ("train", "gt"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    many = rays(SUB)
    t, normals, on_object = first_hits(mesh, eye, many, ground)
    points = eye + t[:, None] * many + LIFT * normals
    seen = points, normals, pattern(points, on_object), on_object
    tracer, frames, photos = RayMeshIntersector(mesh), [], []
    for k, place in enumerate(places):
        towards = place - points
        lit = (towards * normals).sum(1) > 0
        lit[lit] = ~tracer.intersects_any(points[lit], towards[lit])
        share = lit.reshape(SIDE, SUB, SIDE, SUB).mean((1, 3))
        cv2.imwrite(str(out / f"train/r_{k:03d}_white_.png"), np.where(share >= 0.5, 255, 0).astype(np.uint8))
        bright = lit[:, None] * (shaded(seen, towards, eye, paint) if paint else np.ones(3))
        photos.append(bright.reshape(SIDE, SUB, SIDE, SUB, 3).mean((1, 3)))
        sun = {"transform_matrix": pose.tolist(), "transform_matrix_sun": looking(place).tolist()}
        frames.append({"file_path": f"train/r_{k:03d}", **sun})
    most = np.quantile(photos, 0.999) / EXPOSURE
    for k, photo in enumerate(photos):
        grey = np.repeat(np.where(photo[..., :1] >= 0.5, 255, 0), 3, -1)
        shown = encoded(photo / most)[..., ::-1] if paint else grey
        opaque = np.full((SIDE, SIDE), 255)
        cv2.imwrite(str(out / f"train/r_{k:03d}.png"), np.dstack([shown, opaque]).astype(np.uint8))
    if paint:
        cover = 255 * on_object.reshape(SIDE, SUB, SIDE, SUB).mean((1, 3))
        (out / "test_one").mkdir(exist_ok=True)
        cv2.imwrite(str(out / "test_one/r_000.png"), np.dstack([cover] * 4).astype(np.uint8))
    depth, facing, mask = first_hits(mesh, eye, rays(1), ground)
    floor = np.eye(4)
    floor[2, 3] = ground
    angle = {"camera_angle_x": CAMERA_ANGLE_X}
    floors = [{"file_path": "floor/r_000", "transform_matrix": pose.tolist(), "transform_ground": floor.tolist()}]
    (out / "transforms_train.json").write_text(json.dumps({**angle, "frames": frames}))
    (out / "transforms_floor.json").write_text(json.dumps({**angle, "frames": floors}))
    np.save(out / "gt/depth.npy", depth.reshape(SIDE, SIDE).astype(np.float32))
    np.save(out / "gt/normal.npy", facing.reshape(SIDE, SIDE, 3).astype(np.float32))
    cv2.imwrite(str(out / "gt/mask.png"), np.where(mask.reshape(SIDE, SIDE), 255, 0).astype(np.uint8))
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = rotation, eye
    k = [[focal, 0, SIDE / 2], [0, focal, SIDE / 2], [0, 0, 1]]
    camera = {"width": SIDE, "height": SIDE, "K": k, "world_from_camera": world.tolist()}
    (out / "gt/camera.json").write_text(json.dumps(camera))
    (out / "gt/ground.json").write_text(json.dumps({"type": "plane", "plane": [0, 0, 1, -ground], "z": ground}))
    mesh.export(out / "gt/mesh.ply")


def main() -> None:
    """Parse, make each object, render each view of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--objects", nargs="*", default=list(OBJECTS), choices=OBJECTS)
    parser.add_argument("--views", nargs="+", default=list(VIEWS), choices=VIEWS)
    parser.add_argument("--mesh", type=Path, help="a further object: a closed mesh, z up, on its lowest point")
    parser.add_argument("--paints", nargs="*", default=[], choices=PAINTS, help="colour photos of such surfaces")
    parser.add_argument("--seed", type=int, default=0, help="of the lights")
    options = parser.parse_args()
    made = {name: surface(OBJECTS[name][0](), OBJECTS[name][1]) for name in options.objects}
    if options.mesh:
        made[options.mesh.stem] = trimesh.load(options.mesh, process=False, force="mesh")
    for name, mesh in made.items():
        ground = float(mesh.bounds[0, 2]) + SUNK
        for view in options.views:
            for paint in options.paints or [None]:
                folder = options.out / "_".join([name, view, *([paint] if paint else [])])
                render(mesh, np.array(VIEWS[view]), ground, lights(options.seed), folder, paint)
                print(folder, flush=True)


if __name__ == "__main__":
    main()
