"""A shadow hull bent to the normals that one camera sees: the first surface of a solve.

The hull of several views is tight, and nothing ties the depth of one view's integral to what the others see: they are
not bent.

The normals' integral lies behind the hull and touches it where both have one normal or where rays tell that the hull's
matter is there (`integrate_within`). Shadow pictures have `integrate_behind`. Shadows on the ground follow no bend, so
they judge: a bend that explains them clearly worse than the hull as it was carved is left. So wrong normals, as of a
front in the bounce of a white table, do not ruin a right hull.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float
from torch import Tensor

from reconstruct.config import FitConfig
from reconstruct.hull.follow_normals import follow_normals
from reconstruct.hull.hull_matter import hull_occupancy
from reconstruct.hull.normal_integration import LIKELY, integrate_behind, integrate_within, likeness
from reconstruct.labels.held_out import draw_blocks, hold_out
from reconstruct.labels.labels import Labels
from reconstruct.labels.observer import Observer
from reconstruct.labels.supervision import supervise
from reconstruct.scene import Scene
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.level_set import resampled

SHADING_ROUNDS = 4  # of estimating the normals on a hull and moving it to their integral, at most
LIT_ROUNDS = 2  # the same from the lights that reach each pixel of shadow pictures
SETTLED = 0.5  # voxels: a median move too small to recompute the labels
JUDGES_SEED = 1  # beside the seed, for the rays that judge the two surfaces: others than those that a level holds out
# Single pixels, px and share of them: judged in blocks, at a lower sharpness, a relief lost a degree.
JUDGES_BLOCK, JUDGES_SHARE = 1, 0.05
CLEARLY = 0.85  # of a hull's shadow error: shadow pictures bend it below that
BENT_CLEARLY = 0.65  # of a bend's: the hull itself is taken below that; bends hold more than shadows
Say = Callable[[str], None]  # takes a sentence about the step that begins
Seen = tuple[Float[Tensor, "height width 3"], Float[Tensor, "height width 3"]]  # see Observer.seen
Bend = Callable[[SdfGrid, Seen, Labels], SdfGrid]  # bends the surface


@dataclass(frozen=True)
class BentHull:
    """What bends the hull of one scene."""

    scene: Scene
    observer: Observer
    config: FitConfig
    say: Say

    def found(self, hull: SdfGrid) -> SdfGrid:
        """Return the hull, on the first level's grid, bent; itself if shadows on the ground contradict its bend."""
        scene, observer = self.scene, self.observer
        side = observer.seen(hull)
        read = observer.with_normals(observer.labels(hull, scene), hull, scene)
        if scene.rgb is None:
            return self._best(hull, self._rounds(hull, side, read, self._lit), CLEARLY)
        return self._best(self._rounds(hull, side, read, _Within(hull, scene, side)), hull, BENT_CLEARLY)

    def _lit(self, now: SdfGrid, seen: Seen, labels: Labels) -> SdfGrid:
        """Bend the present hull of shadow pictures."""
        return follow_normals(now, self.scene, *seen, labels, integrate_behind)

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

    def _best(self, first: SdfGrid, other: SdfGrid, clearly: float) -> SdfGrid:
        """Return the first grid, or the other if its shadows on the ground, which no bending follows, err less.

        Args:
            clearly: of the first one's error; the other is taken below it.
        """
        rays = supervise(self.scene, self.observer.ground_labels())
        width, count = self.scene.camera.width, len(self.scene.lights)
        drawn = draw_blocks(rays.pixels, width, count, (self.config.seed, JUDGES_SEED), JUDGES_BLOCK, JUDGES_SHARE)
        judge = hold_out(rays, drawn)[1]
        return other if judge.error(other, self.scene) < clearly * judge.error(first, self.scene) else first


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
