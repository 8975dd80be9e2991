"""Whether lights that a level moved are kept: shadow rays that never train compare them with the calibrated ones."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from reconstruct.config import FitConfig, Level
from reconstruct.fields import Verdict
from reconstruct.labels.held_out import HeldOut
from reconstruct.labels.supervision import Supervision
from reconstruct.scene import Scene
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.level_set import resampled
from reconstruct.solve.backend import surface_on
from reconstruct.solve.early_stopping import EarlyStopping
from reconstruct.solve.level import fit_level
from reconstruct.solve.light_refine import LightShift, MovingLights, lit_from

TRIAL = 8  # iterations, about a tenth of a level: at its last rate a surface moves by 1 to 3 voxels in them
LARGEST_SHARE = 1 / 3  # of a level's iterations: short levels leave the lights time to move


def before_trial(level: Level) -> Level:
    """A level without the iterations that its trial takes."""
    return replace(level, iterations=level.iterations - min(TRIAL, int(LARGEST_SHARE * level.iterations)))


def try_lights(
    found: SdfGrid,
    scene: Scene,
    rays: Supervision,
    level: Level,
    config: FitConfig,
    first: int,
    shift: LightShift,
    unmoved: LightShift,
    held_out: HeldOut,
    device: torch.device | None,
    tell: Callable[[str], None],
) -> tuple[Verdict, SdfGrid]:
    """The last iterations of a level twice, under lights moved and unmoved; what was seen, and the better's surface.

    Both sides start from the surface that the moved lights have shaped and draw the same rays, so that chance is the
    same for both. The difference of their held-out errors is a weighted mean over photos; its noise follows from how
    it varies between them [the ratio estimator of cluster sampling, Cochran 1977, 6.4].

    Args:
        found: the surface at the end of before_trial(level).
        scene: with its calibrated lights; unmoved: where they have not been moved.
        first: see fit_level.

    Raises:
        NotFiniteError: see fit_level.
    """
    sides, errors = [], []
    for lights in (unmoved, shift):
        lit = lit_from(scene, lights)
        surface = surface_on(device, resampled(found, level.nodes))
        own = replace(rays, error=rays.error.copy(), wrong=rays.wrong.copy())
        held = MovingLights(scene, lights, False)
        done = before_trial(level).iterations
        for _ in fit_level(surface, scene, own, level, config, done, first, held, held_out, EarlyStopping(), tell):
            pass
        sides.append(surface.grid())
        errors.append(held_out.errors(sides[-1], lit))
    verdict = judge(held_out, errors[0], errors[1], len(scene.lights))
    return verdict, sides[int(verdict.is_accepted)]


def judge(held_out: HeldOut, calibrated: np.ndarray, refined: np.ndarray, n_photos: int) -> Verdict:
    """The verdict from the errors of every held-out ray. With no such rays, or one photo, nothing is accepted."""
    weight = np.bincount(held_out.photo, held_out.weight, n_photos)
    before, after = (np.bincount(held_out.photo, held_out.weight * e, n_photos) for e in (calibrated, refined))
    total, seen = float(weight.sum()), int((weight > 0).sum())
    if seen < 2:
        return Verdict(0.0, 0.0, 0.0)
    difference = float((after - before).sum()) / total
    spread = np.sqrt(seen / (seen - 1) * ((after - before - weight * difference) ** 2).sum()) / total
    return Verdict(float(before.sum()) / total, float(after.sum()) / total, float(spread))
