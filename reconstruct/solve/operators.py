"""One iteration of the solver: cast the rays that are not settled, and compute errors and gradients on the surface."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from reconstruct.config import FitConfig
from reconstruct.labels.supervision import Supervision
from reconstruct.scene import Scene
from reconstruct.sdf import kernels
from reconstruct.sdf.blocks import Blocks
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.level_set import LevelSet
from reconstruct.sdf.rays import lights_to_grid, to_grid
from reconstruct.sdf.settled import Tiles, Views, unsettled_rays, unsettled_views
from reconstruct.solve.ray_operators import DrawnRays, RayOperators, Sums
from reconstruct.views import Scenes, first_photos

FEWEST_RAYS = 20_000  # weight of all shadow rays in an iteration, at least: of few pixels, too
AGREES = 6.0  # s times the SDF at which T is within 0.0025 of 0 or 1
EMPHASIS = 1.5  # weight of an unsettled ray over that of a uniform draw: rays_per_iteration of all
RAYS_PER_VOXEL = 1.0  # of each light and iteration: more differ by less than what the grid can show
SPARE = 4.0  # times as many are looked at: each iteration draws others, or their noise would add up until the next look
GOLDEN = 0.5 * (5**0.5 - 1)  # spreads the photos of a pixel evenly over the draws
MOST_WRONG = 60  # contradictions in a row that are counted
NO_GROUND = 1e9  # voxels, along rays above the horizon


class RayPasses:
    """Choose the rays that may leave a gradient, apply the operators to them, and count their contradictions."""

    def __init__(self, surface: LevelSet, scene: Scene, rays: Supervision, config: FitConfig):
        self.scene, self.rays, self.config = scene, rays, config
        self.operators = RayOperators(surface, scene, rays, config)
        self._count = int((rays.confidence > kernels.NO_WEIGHT).sum())
        self._every_tile: Tiles | None = None
        self._weights = 0.0, 0.0  # of all shadow rays and all camera rays
        self._unsettled, self._share = _NO_RAYS, 1.0  # shadow rays, and the share of them that an iteration draws
        self.sums: dict[str, Sums] = {}  # of the last call, by name
        self.shadow_rays, self.camera_rays = _NO_RAYS, _NO_RAYS

    def look(self, surface: SdfGrid, iteration: int, sharpness: float, motion: float) -> None:
        """Choose the rays of the iterations until the next look.

        Args:
            surface: a distance function.
            iteration: of the whole solve; with the seed it determines which pixels a coarse grid looks at.
            sharpness: least NeuS s per voxel until then.
            motion: voxels that the surface may move until then: rays that come within reach are chosen, too.
        """
        scene, rays, need = self.scene, self.rays, AGREES / sharpness + motion
        field, views = surface.blocks, views_in_grid(surface, scene, rays)
        lights = lights_to_grid(surface, scene.lights)
        enough = share_of_pixels(field, views)
        kept_share = min(1.0, SPARE * enough)
        tiles = self._tiles(iteration, kept_share, scene.camera.width)
        places = unsettled_rays(field, tiles, views, lights, rays.label, rays.confidence, need)
        photo, pixel = places.T
        wrong = rays.wrong[photo, pixel]
        rays.wrong[:, slice(None) if kept_share >= 1 else tiles.order] = 0  # those that agree do not contradict
        rays.wrong[photo, pixel] = wrong
        self._share = min(1.0, max(enough / kept_share, FEWEST_RAYS / max(1, len(places))))
        cast = rays_per_iteration(self.config, len(rays.pixels))
        of_shadows = EMPHASIS * cast / max(1, self._count)
        weight = of_shadows / (kept_share * self._share) * rays.confidence[photo, pixel].astype(np.float64)
        self._unsettled = DrawnRays(places, weight, np.empty(len(places)))
        confidence = np.float32(self.config.mask_weight) * rays.mask_confidence
        chosen = unsettled_views(field, views, rays.mask, confidence, need)
        share = self.config.mask_share * cast / max(1, len(rays.pixels))
        weight = share * confidence[chosen].astype(np.float64)
        self.camera_rays = DrawnRays(chosen[:, None], weight, np.empty(len(chosen)))
        self._weights = of_shadows * float(rays.confidence.sum()), share * float(confidence.sum())

    def _tiles(self, iteration: int, share: float, width: int) -> Tiles:
        """Return the tiles of a random share of the pixels; those of all pixels are made once."""
        if share >= 1:
            if self._every_tile is None:
                self._every_tile = Tiles(self.rays.pixels, width, np.arange(len(self.rays.pixels)))
            return self._every_tile
        return Tiles(self.rays.pixels, width, np.flatnonzero(self._random(iteration, 0) < share))

    def __call__(self, iteration: int, sharpness: float) -> dict[str, float]:
        """Find the surface, cast the rays, accumulate their gradients on it, and return the mean errors by name.

        Args:
            iteration: of the whole solve; with the seed it determines every random number.
            sharpness: NeuS s per voxel.
        """
        operators = self.operators
        operators.find_surface()
        self.shadow_rays = self._drawn(iteration)
        shadow, _ = operators.shadow(self.shadow_rays, iteration, sharpness)
        mask, _ = operators.mask(self.camera_rays, iteration, sharpness)
        normal, weight = operators.normal()
        self._count_contradictions()
        # Settled rays have no error, but count.
        self.sums = {"shadow": (shadow, self._weights[0]), "mask": (mask, self._weights[1]), "normal": (normal, weight)}
        return _means(self.sums)

    def _drawn(self, iteration: int) -> DrawnRays:
        """Return the shadow rays of an iteration; contradictions in a row make them weigh less."""
        places, weights = self._unsettled.places, self._unsettled.weights
        if self._share < 1:
            # By ray, not by its place in the list: a ray more or less leaves the draw of the others as it was.
            photo, pixel = places.T
            chosen = np.flatnonzero((self._random(iteration, 1)[pixel] + GOLDEN * photo) % 1 < self._share)
            places, weights = places[chosen], weights[chosen]
        wrong = self.rays.wrong[places[:, 0], places[:, 1]]
        return DrawnRays(places, weights / (1 + wrong / kernels.PATIENCE), np.empty(len(places)))

    def _random(self, iteration: int, use: int) -> Float[np.ndarray, " pixels"]:
        return np.random.default_rng((self.config.seed, iteration, use)).random(len(self.rays.pixels))

    def _count_contradictions(self) -> None:
        """Count in how many iterations in a row each ray contradicted its label."""
        photo, pixel = self.shadow_rays.places.T
        again = np.minimum(self.rays.wrong[photo, pixel] + 1, MOST_WRONG)
        again[~(self.shadow_rays.misses > kernels.WRONG)] = 0
        self.rays.wrong[photo, pixel] = again

    def faulty(self) -> list[int]:
        """Return the photos whose shadow rays gave non-finite values in the last call."""
        return np.unique(self.shadow_rays.places[~np.isfinite(self.shadow_rays.misses), 0]).tolist()


class JointPasses:
    """The ray passes of all views over one surface: their gradients add up on it."""

    def __init__(self, surface: LevelSet, scenes: Scenes, rays: tuple[Supervision, ...], config: FitConfig):
        self._scenes = scenes
        self.passes = tuple(RayPasses(surface, *view, config) for view in zip(scenes, rays, strict=True))

    def look(self, surface: SdfGrid, iteration: int, sharpness: float, motion: float) -> None:
        """Choose the rays of all views until the next look, see RayPasses.look."""
        for one in self.passes:
            one.look(surface, iteration, sharpness, motion)

    def __call__(self, iteration: int, sharpness: float) -> dict[str, float]:
        """Cast the rays of all views and return the mean errors by name, see RayPasses.__call__."""
        for one in self.passes:
            one(iteration, sharpness)
        every = [one.sums for one in self.passes]
        return _means({name: (sum(s[name][0] for s in every), sum(s[name][1] for s in every)) for name in every[0]})

    def faulty(self) -> list[int]:
        """Return the photos whose shadow rays gave non-finite values in the last call, numbered through all views."""
        first = first_photos(self._scenes)
        return [start + photo for start, one in zip(first, self.passes, strict=True) for photo in one.faulty()]


def _means(sums: Mapping[str, Sums]) -> dict[str, float]:
    return {name: total / max(weight, 1e-9) for name, (total, weight) in sums.items()}


def rays_per_iteration(config: FitConfig, pixels: int) -> int:
    """Return the weight of all shadow rays in an iteration, settled ones included, for a number of pixels."""
    return min(config.rays, max(FEWEST_RAYS, int(config.rays_per_pixel * pixels)))


def share_of_pixels(field: Blocks, views: Views) -> float:
    """Return the share of pixels that a grid needs: RAYS_PER_VOXEL of them per light and face of a voxel, or all."""
    middle = 0.5 * np.array(field.nodes) - views.eye
    side = views.width * float(np.sqrt(middle @ middle))  # of a pixel at the object, voxels
    return min(1.0, RAYS_PER_VOXEL * side * side)


def views_in_grid(grid: SdfGrid, scene: Scene, rays: Supervision) -> Views:
    """Return the supervised pixels' rays in the frame of a grid."""
    ground_t = np.where(np.isfinite(rays.ground_t), rays.ground_t / grid.spacing, NO_GROUND)
    return Views(to_grid(grid, scene.eye), rays.directions, ground_t, float(scene.pixel_angle), rays.role)


_NO_RAYS = DrawnRays(np.empty((0, 2), np.int64), np.empty(0), np.empty(0))
