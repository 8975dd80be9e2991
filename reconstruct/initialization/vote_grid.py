"""A box of nodes that ground pixels vote on, and the shadows that the remaining nodes cast on the ground."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import label

from reconstruct.initialization import mask_kernels
from reconstruct.labels.uneven_ground import near_ground
from reconstruct.scene import Scene
from reconstruct.sdf.rays import run

MAP_CELLS = 500  # of the map from ground to pixels along its longer side
LIGHTS_PER_DARK = 10  # a node is matter if a tenth of the lights, and at least two, throw its shadow on a dark pixel
SPECK = 0.01  # of the largest part
FOOTPRINT = 1.2  # of a node's size in the picture: no gaps between the pixels of neighbours


@dataclass(frozen=True)
class ShadowPictures:
    """Shadow values of the pixels, and the ground points behind them."""

    scene: Scene
    dark: UInt8[np.ndarray, "photos pixels"]  # 1 = in shadow
    points: Float[np.ndarray, "pixels 3"]  # world; 0 where the ray meets no ground, or far away
    on_ground: Bool[np.ndarray, " pixels"]
    cells: np.ndarray  # see mask_kernels.count_votes
    corner: np.ndarray  # (2,) world
    cell: float
    lights: Float[np.ndarray, "photos 4"]

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width."""
        return self.scene.camera.height, self.scene.camera.width


def shadow_pictures(scene: Scene) -> ShadowPictures:
    """Return the shadow pictures of a scene over its ground plane."""
    assert scene.shadow is not None
    dark = (scene.shadow < 0.5).numpy().astype(np.uint8).reshape(len(scene.shadow), -1)
    points = near_ground(scene).reshape(-1, 3)
    on_ground = np.asarray(np.isfinite(points).all(1))
    dark[:, ~on_ground & dark.all(0)] = 0  # the sky is no shadow
    seen = points[on_ground, :2]
    size = np.ptp(seen, axis=0)
    cell = float(size.max() / MAP_CELLS)
    counts = np.ceil(size / cell).astype(int) + 1
    xs, ys = (seen[:, a].min() + cell * np.arange(counts[a]) for a in (0, 1))
    world = np.stack(np.broadcast_arrays(xs[:, None], ys[None, :], scene.ground_height), -1)
    cells = _pixels(scene, world.reshape(-1, 3)).reshape(counts)
    lights = scene.lights.numpy().astype(float)
    points = np.where(on_ground[:, None], points, 0.0)
    return ShadowPictures(scene, dark, points, on_ground, cells, seen.min(0), cell, lights)


def _pixels(scene: Scene, world: np.ndarray) -> np.ndarray:
    """Return the flat index of the pixel that shows a point, -1 outside the picture; int32."""
    height, width = scene.camera.height, scene.camera.width
    pixels, depth = scene.posed_camera.project_with_depth(world)
    column, row = np.rint(pixels).T
    inside = (depth > 0) & (row >= 0) & (row < height) & (column >= 0) & (column < width)
    return np.where(inside, row * width + column, -1).astype(np.int32)


@dataclass(frozen=True)
class VoteGrid:
    """Nodes at lower + spacing * (i, j, k), world."""

    lower: Float[np.ndarray, "3"]
    spacing: float
    shape: tuple[int, int, int]

    def matter(
        self, pictures: ShadowPictures, silent: Bool[np.ndarray, "height width"], share: float
    ) -> Bool[np.ndarray, "nx ny nz"]:
        """Find the nodes that are dark by at least this share of their votes, without specks.

        Each light that casts a node's shadow on a pixel gives one vote, as if that pixel were bare ground. Silent
        pixels do not vote.
        """
        n_dark, n_lit = np.zeros(self.shape, np.int16), np.zeros(self.shape, np.int16)
        where = (pictures.cells, pictures.corner, pictures.cell, pictures.scene.ground_height)
        quiet = silent.ravel().astype(np.uint8)
        seen = (pictures.lights, pictures.dark, quiet)
        run(mask_kernels.count_votes, self.shape[0], n_dark, n_lit, self.lower, self.spacing, *seen, *where)
        fewest = max(2, len(pictures.lights) // LIGHTS_PER_DARK)
        kept = (n_dark >= fewest) & (n_dark >= share * (n_dark + n_lit))
        parts = np.empty(self.shape, np.int32)
        label(kept, np.ones((3, 3, 3)), output=parts)
        sizes = np.bincount(parts.ravel())
        sizes[0] = 0
        return np.isin(parts, np.flatnonzero(sizes >= max(1, SPECK * sizes.max())))

    def places(self, matter: Bool[np.ndarray, "nx ny nz"]) -> Float[np.ndarray, "n 3"]:
        """Return the world points of the nodes."""
        return self.lower + self.spacing * np.argwhere(matter)

    def silhouette(
        self, pictures: ShadowPictures, matter: Bool[np.ndarray, "nx ny nz"]
    ) -> Bool[np.ndarray, "height width"]:
        """Return the pixels that show matter."""
        scene, places = pictures.scene, self.places(matter)
        pixels = _pixels(scene, places)
        image = np.zeros(pictures.shape, np.uint8)
        image.reshape(-1)[pixels[pixels >= 0]] = 1
        distance = np.linalg.norm(places.mean(0) - scene.eye.numpy()) if len(places) else 1.0
        side = 2 * int(np.ceil(0.5 * FOOTPRINT * self.spacing / (distance * scene.pixel_angle))) + 1
        return cv2.morphologyEx(image, cv2.MORPH_CLOSE, np.ones((side, side), np.uint8)) > 0

    def shadows(
        self,
        pictures: ShadowPictures,
        matter: Bool[np.ndarray, "nx ny nz"],
        wanted: Bool[np.ndarray, "photos height width"],
    ) -> Bool[np.ndarray, "photos height width"]:
        """Return the shadows of the matter on the ground behind each pixel; False where not wanted."""
        dark = np.zeros_like(pictures.dark)
        asked = (wanted.reshape(dark.shape) & pictures.on_ground).astype(np.uint8)
        solid = matter.astype(np.uint8)
        where = (pictures.points, pictures.lights, solid, self.lower, self.spacing)
        run(mask_kernels.cast_shadows, dark.shape[1], dark, asked, *where)
        return dark.reshape(wanted.shape) > 0


def box_around(lower: np.ndarray, upper: np.ndarray, nodes: int) -> VoteGrid:
    """A box with `nodes` nodes along its longest side."""
    spacing = float((upper - lower).max() / (nodes - 1))
    shape = np.maximum(np.ceil((upper - lower) / spacing).astype(int) + 1, 4)
    return VoteGrid(np.asarray(lower, float), spacing, (int(shape[0]), int(shape[1]), int(shape[2])))
