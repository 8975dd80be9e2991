"""Built-in objects as implicit functions, negative inside: they are closed and have no inner walls.

Lengths in mm, z up, standing on z = 0.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float
from skimage.measure import marching_cubes

Points = Float[np.ndarray, "*batch 3"]
Values = Float[np.ndarray, "*batch"]
Inside = Callable[[Points], Values]
CELLS = 120  # along the longest side: 1 mm for 120 mm, two pixels of the photos
EMPTY_CELLS = 3  # around the object


@dataclass(frozen=True)
class Solid:
    """A closed shape: a function that is negative inside, and a bounding box."""

    inside: Inside
    low: tuple[float, float, float]
    high: tuple[float, float, float]


def build(name: str, cells: int = CELLS) -> trimesh.Trimesh:
    """Return a built-in shape as a mesh with the normals of its function, so that edges are shaded sharp."""
    return mesh_of(SOLIDS[name](), cells)


def mesh_of(solid: Solid, cells: int) -> trimesh.Trimesh:
    """Return a solid as a mesh, with `cells` along its longest side."""
    step = max(np.subtract(solid.high, solid.low)) / cells
    low = np.array(solid.low) - EMPTY_CELLS * step
    counts = np.ceil((np.array(solid.high) - low) / step).astype(int) + EMPTY_CELLS + 1
    axes = [start + step * np.arange(count) for start, count in zip(low, counts, strict=True)]
    values = np.stack([solid.inside(_plane(axes[0], axes[1], z)) for z in axes[2]], -1)
    vertices, faces, _, _ = marching_cubes(values, 0.0, gradient_direction="descent")
    vertices = low + step * vertices
    return trimesh.Trimesh(vertices, faces, vertex_normals=_gradient(solid.inside, vertices, step / 10), process=False)


def _plane(x: Values, y: Values, z: float) -> Points:
    return np.stack([*np.meshgrid(x, y, indexing="ij"), np.full((len(x), len(y)), z)], -1)


def _gradient(inside: Inside, points: Points, step: float) -> Points:
    shifts = step * np.eye(3)
    slope = np.stack([inside(points + shift) - inside(points - shift) for shift in shifts], -1)
    return slope / np.maximum(np.linalg.norm(slope, axis=-1, keepdims=True), 1e-12)


# --- parts -----------------------------------------------------------------------------------------------------------


def box(p: Points, centre: tuple[float, float, float], size: tuple[float, float, float]) -> Values:
    """Distance to a box with sides along the axes."""
    q = np.abs(p - centre) - np.array(size) / 2
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0)


def rod(p: Points, a: tuple[float, float, float], b: tuple[float, float, float], radius: float) -> Values:
    """Distance to a rod with round ends."""
    along = np.subtract(b, a)
    t = np.clip((p - a) @ along / (along @ along), 0, 1)
    return np.linalg.norm(p - a - t[..., None] * along, axis=-1) - radius


def ring(p: Points, centre: tuple[float, float, float], radius: float, thickness: float) -> Values:
    """Distance to a ring that stands upright in the plane of x and z."""
    q = p - centre
    return np.hypot(np.hypot(q[..., 0], q[..., 2]) - radius, q[..., 1]) - thickness


def ball(p: Points, centre: tuple[float, float, float], radius: float) -> Values:
    """Distance to a ball."""
    return np.linalg.norm(p - centre, axis=-1) - radius


def turned(p: Points, profile: Sequence[tuple[float, float]]) -> Values:
    """Distance to the solid of revolution of a closed outline of (radius, z)."""
    q = np.stack([np.hypot(p[..., 0], p[..., 1]), p[..., 2]], -1)
    nearest, is_inside = np.full(q.shape[:-1], np.inf), np.zeros(q.shape[:-1], bool)
    for a, b in zip(profile, [*profile[1:], profile[0]], strict=True):
        along = np.subtract(b, a)
        t = np.clip((q - a) @ along / (along @ along), 0, 1)
        nearest = np.minimum(nearest, ((q - a - t[..., None] * along) ** 2).sum(-1))
        crosses = (a[1] > q[..., 1]) != (b[1] > q[..., 1])
        if a[1] != b[1]:
            is_inside ^= crosses & (q[..., 0] < a[0] + (q[..., 1] - a[1]) * along[0] / along[1])
    return np.where(is_inside, -1, 1) * np.sqrt(nearest)


def melted(parts: list[Values], softness: float) -> Values:
    """Return the smooth union of parts, with joints rounded over the length `softness`."""
    out = parts[0]
    for part in parts[1:]:
        h = np.maximum(softness - np.abs(out - part), 0) / softness
        out = np.minimum(out, part) - h * h * softness / 4
    return out


def above(p: Points, parts: Values) -> Values:
    """Cut off the part below the table."""
    return np.maximum(parts, -p[..., 2])


def swung(p: Points, degrees: float) -> Points:
    """Return the points in a frame rotated about z."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return p @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


# --- objects ---------------------------------------------------------------------------------------------------------


def table() -> Solid:
    """A small table on four thin legs."""

    def inside(p: Points) -> Values:
        parts = [box(p, (0, 0, 77), (120, 84, 6))]
        parts += [rod(p, (x, y, 0), (0.92 * x, 0.92 * y, 76), 2.5) for x in (-54, 54) for y in (-36, 36)]
        return above(p, np.minimum.reduce(parts))

    return Solid(inside, (-61, -43, 0), (61, 43, 81))


def chair() -> Solid:
    """A chair with a slatted back."""

    def inside(p: Points) -> Values:
        parts = [box(p, (0, 0, 52), (56, 56, 5)), box(p, (-25, 0, 112), (5, 56, 8))]
        parts += [rod(p, (24, y, 0), (24, y, 52), 2.5) for y in (-24, 24)]
        parts += [rod(p, (-25, y, 0), (-25, y, 112), 2.5) for y in (-25.5, 25.5)]
        parts += [rod(p, (-25, y, 52), (-25, y, 112), 2.0) for y in (-12, 0, 12)]
        return above(p, np.minimum.reduce(parts))

    return Solid(inside, (-29, -29, 0), (29, 29, 117))


def vase() -> Solid:
    """A hollow jug with a handle."""
    outer = [(0, 0), (24, 0), (26, 3), (34, 20), (40, 45), (36, 70), (24, 90), (19, 102), (23, 116), (26, 120)]
    inner = [(23, 120), (19.5, 115), (15.5, 102), (20, 91), (32, 69), (36, 45), (30, 20), (22, 6), (0, 6)]

    def inside(p: Points) -> Values:
        handle = np.maximum(ring(p, (36, 0, 78), 25, 3.5), -turned(p, [*inner, (0, 120)]))
        return above(p, np.minimum(turned(p, outer + inner), handle))

    return Solid(inside, (-41, -41, 0), (66, 41, 121))


def figurine() -> Solid:
    """A small animal that sits on a round base."""

    def inside(p: Points) -> Values:
        mirrored = p * [1, -1, 1]
        body = [ball(p, (0, 0, 38), 27), ball(p, (6, 0, 62), 19), ball(p, (14, 0, 92), 20), ball(p, (34, 0, 87), 9)]
        for q in (p, mirrored):
            body += [rod(q, (14, 18, 56), (30, 15, 16), 6.5), rod(q, (2, 22, 22), (26, 20, 14), 9)]
            body += [rod(q, (8, 12, 108), (4, 19, 124), 5)]
        body += [rod(p, (-22, 0, 24), (-44, 0, 46), 6)]
        base = np.maximum(np.hypot(p[..., 0], p[..., 1]) - 46, np.abs(p[..., 2] - 5) - 5)
        return above(p, melted([melted(body, 9.0), base], 3.0))

    return Solid(inside, (-52, -48, 0), (48, 48, 131))


def relief() -> Solid:
    """A plate with a raised rim, rays and a dome."""

    def inside(p: Points) -> Values:
        r, angle = np.hypot(p[..., 0], p[..., 1]), np.arctan2(p[..., 1], p[..., 0])
        rim = 3.0 * np.exp(-(((r - 56) / 3.5) ** 2))
        rays = 2.2 * np.clip(np.cos(8 * angle), 0, 1) * np.exp(-(((r - 36) / 9) ** 2))
        dome = 5.0 * np.sqrt(np.clip(1 - (r / 18) ** 2, 0, 1))
        return np.maximum(np.maximum(r - 60, p[..., 2] - 6 - rim - rays - dome), -p[..., 2])

    return Solid(inside, (-61, -61, 0), (61, 61, 12))


def tower() -> Solid:
    """Tall and slender: a square column, twisted, under a ball."""

    def inside(p: Points) -> Values:
        turn = np.radians(0.35) * p[..., 2]
        x, y = np.cos(turn) * p[..., 0] + np.sin(turn) * p[..., 1], np.cos(turn) * p[..., 1] - np.sin(turn) * p[..., 0]
        column = np.maximum(np.maximum(np.abs(x), np.abs(y)) - (30 - 0.05 * p[..., 2]), np.abs(p[..., 2] - 105) - 105)
        return above(p, np.minimum(column, ball(p, (0, 0, 228), 26)))

    return Solid(inside, (-43, -43, 0), (43, 43, 255))


def boxes() -> Solid:
    """Three blocks with flat faces, one upon another and one beside them."""

    def inside(p: Points) -> Values:
        q = swung(p, 30)
        return np.minimum.reduce(
            [box(p, (0, 0, 20), (90, 56, 40)), box(q, (4, 4, 60), (44, 44, 40)), box(q, (52, -34, 14), (36, 36, 28))]
        )

    return Solid(inside, (-46, -60, 0), (88, 60, 81))


def ball_on_table() -> Solid:
    """A ball, flattened a little where it stands."""
    return Solid(lambda p: above(p, ball(p, (0, 0, 38), 40)), (-41, -41, 0), (41, 41, 79))


def bowl() -> Solid:
    """An open bowl on a low foot."""
    outer = [(0, 0), (22, 0), (22, 4), (40, 22), (52, 48)]
    inner = [(48, 48), (36, 24), (18, 8), (0, 8)]
    return Solid(lambda p: above(p, turned(p, outer + inner)), (-53, -53, 0), (53, 53, 49))


def rock() -> Solid:
    """A boulder with bumps, a notch and a hole from the side: nothing on it is flat or symmetric."""

    def inside(p: Points) -> Values:
        parts = [ball(p, (0, 0, 30), 36), ball(p, (22, 14, 56), 25), ball(p, (-24, -8, 58), 21)]
        parts += [ball(p, (-4, 20, 84), 19), ball(p, (30, -16, 26), 20), ball(p, (-30, 22, 20), 20)]
        body = melted(parts, 12.0)
        waves = ((0.11, 0.07, 0.13), (-0.12, 0.15, 0.06), (0.05, -0.17, 0.16), (0.27, 0.2, -0.1), (-0.1, 0.21, 0.3))
        wave = sum(np.sin(p @ np.array(k) + i) for i, k in enumerate(waves)) / 2
        cuts = melted([rod(p, (10, -60, 62), (2, -14, 44), 11), rod(p, (-60, 4, 34), (-26, 2, 40), 9)], 4.0)
        return above(p, np.maximum(body + 1.6 * wave, -cuts))

    return Solid(inside, (-54, -46, 0), (54, 46, 108))


def disc() -> Solid:
    """A low disc, as a large coin."""
    return Solid(lambda p: above(p, turned(p, [(0, -1), (16, -1), (16, 7), (0, 7)])), (-17, -17, 0), (17, 17, 8))


def mug() -> Solid:
    """A straight mug with a handle."""
    outer, inner = [(0, 0), (37, 0), (40, 3), (40, 94)], [(36.5, 94), (36.5, 8), (33, 5), (0, 5)]

    def inside(p: Points) -> Values:
        handle = np.maximum(ring(p, (40, 0, 48), 25, 5.0), -turned(p, [*inner, (0, 94)]))
        return above(p, np.minimum(turned(p, outer + inner), handle))

    return Solid(inside, (-41, -41, 0), (71, 41, 95))


def carton() -> Solid:
    """A box as food is sold in, lying or standing."""
    return Solid(lambda p: box(p, (0, 0, 44), (62, 38, 88)), (-32, -20, 0), (32, 20, 89))


def saucer() -> Solid:
    """A cup on its saucer."""
    plate = [(0, 0), (26, 0), (28, 2), (62, 10), (64, 13), (60, 13), (27, 6), (0, 6)]
    outer, inner = [(0, 5), (20, 5), (23, 9), (34, 28), (37, 58)], [(34, 58), (31, 29), (19, 11), (0, 11)]

    def inside(p: Points) -> Values:
        handle = np.maximum(ring(p, (37, 0, 36), 14, 3.2), -turned(p, [*inner, (0, 58)]))
        return np.minimum.reduce([turned(p, plate), turned(p, outer + inner), above(p, handle)])

    return Solid(inside, (-65, -65, 0), (65, 65, 59))


def slipper() -> Solid:
    """A shoe without a heel: a closed toe, and an opening into which one sees."""

    def inside(p: Points) -> Values:
        parts = [rod(p, (46, 4, 6), (46, 4, 10), 22), rod(p, (0, 0, 8), (30, 2, 12), 25)]
        parts += [rod(p, (-62, 0, 8), (-20, 0, 14), 22)]
        hollow = melted([rod(p, (24, 2, 22), (-62, 0, 34), 18), rod(p, (-20, 0, 50), (-60, 0, 50), 24)], 8.0)
        return above(p, np.maximum(melted(parts, 16.0), -hollow))

    return Solid(inside, (-86, -28, 0), (70, 30, 42))


def spectacles() -> Solid:
    """A frame without glasses, standing on its rims and the ends of its temples."""

    def inside(p: Points) -> Values:
        q = np.abs(p * [1, 0, 0]) + p * [0, 1, 1]
        parts = [ring(q, (32, 0, 22), 20, 2.6), rod(q, (0, 0, 28), (13, 0, 28), 2.6)]
        parts += [rod(q, (51, 0, 28), (56, 4, 28), 2.6), rod(q, (56, 4, 28), (55, 84, 26), 2.6)]
        return above(p, np.minimum.reduce([*parts, rod(q, (55, 84, 26), (53, 112, 2), 2.6)]))

    return Solid(inside, (-60, -4, 0), (60, 116, 46))


def pair() -> Solid:
    """Two things that touch: a ball and a tin."""

    def inside(p: Points) -> Values:
        tin = np.maximum(np.hypot(p[..., 0] - 21, p[..., 1]) - 21, np.abs(p[..., 2] - 30) - 30)
        return above(p, np.minimum(tin, ball(p, (-26, 6, 26), 27)))

    return Solid(inside, (-54, -22, 0), (43, 34, 61))


SOLIDS: dict[str, Callable[[], Solid]] = {
    "table": table,
    "chair": chair,
    "vase": vase,
    "figurine": figurine,
    "relief": relief,
    "tower": tower,
    "boxes": boxes,
    "ball": ball_on_table,
    "bowl": bowl,
    "disc": disc,
    "rock": rock,
    "mug": mug,
    "carton": carton,
    "saucer": saucer,
    "slipper": slipper,
    "spectacles": spectacles,
    "pair": pair,
}
