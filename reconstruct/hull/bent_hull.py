"""A shadow hull bent to the normals that one camera sees: the first surface of a solve.

The hull of several views is tight, and nothing ties the depth of one view's integral to what the others see: they are
not bent.

One view's hull is bent in up to three ways. The normals' integral lies behind the hull and touches it where both have
one normal or where rays tell that the hull's matter is there (`integrate_within`). Up to FEW_LIGHTS the hull has
normals of its own, which hide that; so the integral is tied to it everywhere (`integrate_normals`), or the hull is made
anew behind the integral (`on_front`): what a camera sees is mostly one surface, as thick as wide. Shadow pictures have
`integrate_behind`. Shadows on the ground follow no bend, so they judge: a bend that explains them clearly worse than
another, or than the hull as it was carved, is left. So wrong normals, as of a front in the bounce of a white table, do
not ruin a right hull.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from reconstruct.config import FitConfig
from reconstruct.hull.follow_normals import Integrate, SomePixels, follow_normals, some_pixels
from reconstruct.hull.hull_matter import hull_occupancy
from reconstruct.hull.hull_parts import without_specks
from reconstruct.hull.normal_integration import LIKELY, integrate_behind, integrate_normals, integrate_within, likeness
from reconstruct.labels.held_out import draw_blocks, hold_out
from reconstruct.labels.labels import Labels
from reconstruct.labels.observer import Observer
from reconstruct.labels.supervision import supervise
from reconstruct.scene import Scene
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.level_set import resampled

THINNEST = 2.0  # nodes: of matter behind the front
SPECK = 0.05  # of the largest part: smaller ones were shreds of what is now elsewhere
SHADING_ROUNDS = 4  # of estimating the normals on a hull and moving it to their integral, at most
LIT_ROUNDS = 2  # the same from the lights that reach each pixel of shadow pictures
SETTLED = 0.5  # voxels: a median move too small to recompute the labels
JUDGES_SEED = 1  # beside the seed, for the rays that judge the two surfaces: others than those that a level holds out
# Single pixels, px and share of them: judged in blocks, at a lower sharpness, a relief lost a degree.
JUDGES_BLOCK, JUDGES_SHARE = 1, 0.05
FEW_LIGHTS = 20  # up to which the hull has normals of its own
CLEARLY = 0.85  # of a hull's shadow error: shadow pictures bend it below that
BENT_CLEARLY = 0.65  # of a bend's: another bend, or the hull itself, is taken below that; bends hold more than shadows
Say = Callable[[str], None]  # takes a sentence about the step that begins
Seen = tuple[Float[Tensor, "height width 3"], Float[Tensor, "height width 3"]]  # see Observer.seen
Bend = Callable[[SdfGrid, Seen, Labels], SdfGrid]  # bends the surface


def on_front(
    hull: SdfGrid,
    space: SdfGrid,
    scene: Scene,
    seen: tuple[Float[Tensor, "height width 3"], Float[Tensor, "height width 3"]],
    first: Float[Tensor, "height width 3"],
    labels: Labels,
) -> SdfGrid:
    """Return the hull behind the integral of the labels' normals.

    Args:
        hull: as it was carved.
        space: that nothing proves empty.
        seen: world points and normals of the present surface, where each pixel's ray meets it; normals 0 on ground.
        first: world, where each pixel's ray meets that space.

    Returns:
        The grid is no distance function, only its sign is valid.
    """
    some = some_pixels(scene, *seen, labels)
    if some is None:
        return hull
    front = (first - scene.eye).norm(dim=-1)[:: some.step, :: some.step].numpy().astype(np.float64)
    depth = integrate_normals(some.rays, some.before, some.own, some.normals, some.trust, True, front)
    return _behind(depth, some, hull, space, scene)


def _behind(
    depth: Float[np.ndarray, "height width"], some: SomePixels, hull: SdfGrid, space: SdfGrid, scene: Scene
) -> SdfGrid:
    """Return the part of a hull behind a front of given ray lengths, with matter of that space right behind it."""
    there = np.isfinite(depth).astype(np.uint8)
    kind = cv2.DIST_LABEL_PIXEL
    _, number = cv2.distanceTransformWithLabels(1 - there, cv2.DIST_L2, 5, labelType=kind)
    nearest = np.zeros(number.max() + 1)
    nearest[number[there > 0]] = depth[there > 0]
    front = nearest[number]
    pixel = float(np.median(np.linalg.norm(np.diff(some.rays, axis=1), axis=-1)))
    thick = 2 * cv2.distanceTransform(there, cv2.DIST_L2, 5) * pixel * front
    shape = space.values.shape
    nodes = space.origin.numpy() + space.spacing * np.moveaxis(np.indices(shape), 0, -1).reshape(-1, 3)
    uv = (scene.posed_camera.project(nodes) / some.step).astype(np.float32).reshape(shape[0], -1, 2)
    edge = cv2.BORDER_REPLICATE
    begins, lasts = (
        cv2.remap(image.astype(np.float32), uv, None, cv2.INTER_LINEAR, borderMode=edge).reshape(shape)
        for image in (front, thick)
    )
    away = np.linalg.norm(nodes - scene.eye.numpy(), axis=-1).reshape(shape)
    behind = away - begins - np.maximum(lasts, THINNEST * space.spacing)
    behind = np.where(lasts > 0, np.maximum(space.values.numpy(), behind), space.spacing)
    own = hull.sdf(torch.from_numpy(nodes).float()).numpy().reshape(shape)
    values = np.maximum(np.minimum(own, behind), begins - away)
    values[(values < 0) & ~without_specks(values < 0, SPECK)] = space.spacing
    return SdfGrid(torch.from_numpy(values.astype(np.float32)), space.origin, space.spacing)


@dataclass(frozen=True)
class BentHull:
    """What bends the hull of one scene."""

    scene: Scene
    observer: Observer
    config: FitConfig
    say: Say

    def found(self, hull: SdfGrid, space: SdfGrid) -> SdfGrid:
        """Return the hull, bent; itself if shadows on the ground contradict its bends.

        Args:
            hull: on the first level's grid.
            space: that nothing proves empty.
        """
        scene, observer = self.scene, self.observer
        side = observer.seen(hull)
        read = observer.with_normals(observer.labels(hull, scene), hull, scene)
        if scene.rgb is None:
            return self._best([hull, self._rounds(hull, side, read, self._along(integrate_behind))], CLEARLY)
        bends: list[Bend] = [_Within(hull, scene, side)]
        if len(scene.lights) <= FEW_LIGHTS:
            first = observer.seen(space)[0]
            bends.insert(0, self._along(partial(integrate_normals, bounds=True)))
            bends.append(lambda _, seen, labels: on_front(hull, space, scene, seen, first, labels))
        return self._best([*(self._rounds(hull, side, read, bend) for bend in bends), hull], BENT_CLEARLY)

    def _along(self, integrate: Integrate) -> Bend:
        """Return what bends the present surface to the integral of the labels' normals."""

        def bend(now: SdfGrid, seen: Seen, labels: Labels) -> SdfGrid:
            return follow_normals(now, self.scene, *seen, labels, integrate)

        return bend

    def _rounds(self, hull: SdfGrid, seen: Seen, labels: Labels, bent: Bend) -> SdfGrid:
        """Return the hull after rounds of reading the normals on it and bending it to them.

        Args:
            seen: of the hull.
            labels: as read on it, with normals.
        """
        scene, observer = self.scene, self.observer
        rounds = SHADING_ROUNDS if scene.rgb is not None else LIT_ROUNDS
        for number in range(rounds):
            self.say(
                f"bending the first shape to the slopes that the photos show, round {number + 1} of at most {rounds}"
            )
            if number:
                labels = labels if scene.rgb is None else observer.labels(hull, scene)
                labels = observer.with_normals(labels, hull, scene)
            hull = resampled(bent(hull, seen, labels), self.config.levels[0].nodes).grid()
            before, seen = seen, observer.seen(hull)
            shown = (before[1] != 0).any(-1) & (seen[1] != 0).any(-1)
            moved = (seen[0] - before[0])[shown].norm(dim=-1).median()  # nan where nothing is shown
            if not moved >= SETTLED * hull.spacing:
                break
        return hull

    def _best(self, grids: Sequence[SdfGrid], clearly: float) -> SdfGrid:
        """Return the first grid, or a later one whose shadows on the ground, which no bending follows, err less.

        Args:
            clearly: of the least error so far; a later grid is taken below it.
        """
        rays = supervise(self.scene, self.observer.ground_labels())
        width, count = self.scene.camera.width, len(self.scene.lights)
        drawn = draw_blocks(rays.pixels, width, count, (self.config.seed, JUDGES_SEED), JUDGES_BLOCK, JUDGES_SHARE)
        judge = hold_out(rays, drawn)[1]
        best, least = grids[0], judge.error(grids[0], self.scene)
        for grid in grids[1:]:
            error = judge.error(grid, self.scene)
            if error < clearly * least:
                best, least = grid, error
        return best


class _Within:
    """Bends a hull, always as it was carved, to the integral of the labels' normals behind it.

    From the second time on the hull's matter is kept where rays tell that it is there, see `hull_occupancy`.
    """

    def __init__(self, hull: SdfGrid, scene: Scene, seen: Seen):
        self._hull, self._scene, self._seen = hull, scene, seen
        self._behind = np.zeros((0, 0))  # lengths of rays to the integral; where the matter is kept, as it was before

    def __call__(self, now: SdfGrid, seen: Seen, labels: Labels) -> SdfGrid:
        integrate = partial(self._integrate, labels)
        return follow_normals(self._hull, self._scene, *self._seen, labels, integrate)

    def _integrate(
        self,
        labels: Labels,
        rays: Float[np.ndarray, "height width 3"],
        hull: Float[np.ndarray, "height width"],
        own: Float[np.ndarray, "height width 3"],
        normals: Float[np.ndarray, "height width 3"],
        trust: Float[np.ndarray, "height width"],
    ) -> Float[np.ndarray, "height width"]:
        if self._behind.shape != hull.shape:  # the first time, or other pixels than last time
            self._behind = integrate_within(rays, hull, own, normals, trust)
            return self._behind
        step = -(-self._scene.camera.width // hull.shape[1])
        alike = likeness(own, normals, trust)
        matter = hull_occupancy(self._hull, self._scene, labels, self._behind, step, alike)
        t = integrate_within(rays, hull, own, normals, trust, self._behind, matter)
        self._behind = np.where(matter > LIKELY, self._behind, t)
        return t
