"""What held-out shadow rays decide: hull or height field, and whether a result is to be doubted.

The start from shadow pictures alone. A height field holds no slats and no seat above legs; a hull holds no hollow that
no shadow on the ground shows. Which of them an object needs is in the pictures, not in the camera's direction: both are
made at a small size, the hull with the first level of the free surface, and the rays that neither has seen choose.
"""

import numpy as np

from capture.errors import ReconstructionError
from reconstruct.config import FitConfig, Level
from reconstruct.hull.shadow_hull import shadow_hull
from reconstruct.initialization.height_field import HeightConfig, fit_heights
from reconstruct.initialization.height_grid import height_grid
from reconstruct.initialization.height_view import HeightView, height_view
from reconstruct.labels.held_out import HeldOut, draw_blocks, hold_out, without
from reconstruct.labels.labels import not_isolated
from reconstruct.labels.observer import Observer
from reconstruct.labels.outline import wrong_labels
from reconstruct.labels.supervision import DARK_ENOUGH, Supervision, supervise
from reconstruct.scene import Scene, reduced
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.level_set import resampled
from reconstruct.solve.level import LevelFit
from reconstruct.views import Scenes

START_SIDE = 64  # px of the longer side in which both starts are made: a height field costs its third power
START_LEVEL = Level(40, 24, (0.5, 0.4), 4, 4.2e-4)
NODES_PER_PIXEL = 1.75  # of the height field's grid
START_SEED = 2  # beside the seed, for the rays that choose
START_SHARE = 0.05  # of all rays, single pixels
CONTRADICTED = 0.04  # of the shadow that no fit has seen: right surfaces leave .001 to .012, a sheet for a chair .06
FEWEST_DARK = 200  # labels that this share needs
START_SHARPNESS = 4.0  # NeuS s per px of the ground, the same for both


def hull_is_better(scene: Scene, config: FitConfig) -> bool:
    """Return whether the shadow hull, after one level, explains held-out shadow rays better than a height field.

    Args:
        scene: shadow pictures and a mask on a known, level ground.
    """
    small = reduced(scene, START_SIDE)
    labels = Observer(small).ground_labels()
    picture = np.arange(small.camera.width * small.camera.height), small.camera.width, len(small.lights)
    drawn = draw_blocks(*picture, (config.seed, START_SEED), 1, START_SHARE)
    rays = supervise(small, labels)
    rays, held_out = hold_out(rays, drawn[:, rays.pixels], with_outline=True)
    seen = without(labels, drawn)
    view = height_view(small, seen)
    try:
        hull = shadow_hull(small, seen, 1, START_LEVEL.nodes)
    except ReconstructionError:
        return False
    surface = resampled(hull, START_LEVEL.nodes)
    for _ in LevelFit(small, rays, held_out, START_LEVEL, config).steps(surface):
        pass
    field = height_grid(fit_heights(view, HeightConfig(longest=START_SIDE)), small, round(NODES_PER_PIXEL * START_SIDE))
    free, heights = (_error(grid, small, held_out, view) for grid in (surface.grid(), field))
    return free <= heights


def _error(grid: SdfGrid, scene: Scene, held_out: HeldOut, view: HeightView) -> float:
    """Return the held-out error of a surface at a sharpness that is the same in the world for every grid."""
    pixel = view.reference / view.focal
    return held_out.error(grid, scene, START_SHARPNESS * grid.spacing / pixel)


def shadow_doubts(
    scenes: Scenes, observers: tuple[Observer, ...], rays: tuple[Supervision, ...], surface: SdfGrid
) -> tuple[str, ...]:
    """Return a warning for each view whose given shadow pictures contradict the surface.

    Only labels that the fit has not used are asked, without isolated pixels and those beside a shadow's edge.

    Args:
        rays: of each view, of the last level: held-out ones have the confidence 0.
    """
    doubts = []
    for scene, observer, own in zip(scenes, observers, rays, strict=True):
        if scene.shadow is None or scene.rgb is not None:
            continue
        flat = [x.reshape(len(scene.lights), -1)[:, own.pixels] for x in _asked(scene, observer, surface)]
        wrong, dark, alike = (x[own.confidence <= 0] for x in flat)
        count = int((dark & alike).sum())
        share = float((wrong & alike).sum()) / max(1, count)
        if count < FEWEST_DARK or share < CONTRADICTED:
            continue
        doubts.append(
            f"{scene.view + ': ' if scene.view else ''}the surface contradicts {100 * share:.0f} % of the shadow that "
            f"was set aside for a test (edges not counted; below {100 * CONTRADICTED:.0f} % was needed, 1 % is usual). "
            "Do not trust this shape: the lights, the ground or the object's outline are wrong, or the object is too "
            "thin for these pictures. Compare the shadows in report.html; give a mask, or larger pictures."
        )
    return tuple(doubts)


def _asked(scene: Scene, observer: Observer, surface: SdfGrid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return, per photo and pixel, if the surface contradicts the label, if it is dark, and if it is not isolated."""
    assert scene.shadow is not None
    surface = observer.in_world(surface)
    wrong = wrong_labels(scene, surface, observer.seen(surface)[0])
    return wrong, (scene.shadow < DARK_ENOUGH).numpy(), (not_isolated(scene.shadow) > 0).numpy()
