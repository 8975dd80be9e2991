"""Accept or reject the refined lights of a level: held-out shadow rays compare them with the calibrated ones."""

from dataclasses import replace

import numpy as np
import torch

from reconstruct.config import Level
from reconstruct.fields import Verdict
from reconstruct.labels.held_out import HeldOut, HeldOuts
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.level_set import resampled
from reconstruct.solve.backend import surface_on
from reconstruct.solve.level import LevelFit
from reconstruct.solve.light_refine import LightShift, MovingLights, lit_from
from reconstruct.views import each, placed

TRIAL = 8  # iterations, about a tenth of a level: at its last rate a surface moves by 1 to 3 voxels in them
LARGEST_SHARE = 1 / 3  # of a level's iterations: short levels leave the lights time to move


def before_trial(level: Level) -> Level:
    """Return the level without the iterations of its trial."""
    return replace(level, iterations=level.iterations - min(TRIAL, int(LARGEST_SHARE * level.iterations)))


def try_lights(
    fit: LevelFit, found: SdfGrid, shift: LightShift, unmoved: LightShift, device: torch.device | None
) -> tuple[Verdict, SdfGrid]:
    """Run a level's last iterations twice, with moved and unmoved lights; return the verdict and the better surface.

    Both runs start from the surface solved under the moved lights and draw the same rays, so that random effects are
    equal. The difference of their held-out errors is a weighted mean over photos; its noise follows from its variation
    between photos [the ratio estimator of cluster sampling, Cochran 1977, 6.4].

    Args:
        fit: of the whole level, under the calibrated lights.
        found: the surface at the end of before_trial(level).
        unmoved: the shift of unmoved lights.

    Raises:
        NotFiniteError: see LevelFit.steps.
    """
    sides, errors = [], []
    for lights in (unmoved, shift):
        surface = surface_on(device, resampled(found, fit.level.nodes))
        own = replace(fit, rays=tuple(replace(rays, wrong=rays.wrong.copy()) for rays in each(fit.rays)))
        for _ in own.steps(surface, MovingLights(fit.scenes, lights, False), before_trial(fit.level).iterations):
            pass
        sides.append(surface.grid())
        errors.append(fit.held_out.errors(sides[-1], placed(lit_from(fit.scenes, lights))))
    verdict = judge(fit.held_out, errors[0], errors[1], len(unmoved.shift))
    return verdict, sides[int(verdict.is_accepted)]


def judge(held_out: HeldOut | HeldOuts, calibrated: np.ndarray, refined: np.ndarray, n_photos: int) -> Verdict:
    """Decide from the errors of every held-out ray. Without such rays, or with one photo, nothing is accepted."""
    weight = np.bincount(held_out.photo, held_out.weight, n_photos)
    before, after = (np.bincount(held_out.photo, held_out.weight * e, n_photos) for e in (calibrated, refined))
    total, seen = float(weight.sum()), int((weight > 0).sum())
    if seen < 2:
        return Verdict(0.0, 0.0, 0.0)
    difference = float((after - before).sum()) / total
    spread = np.sqrt(seen / (seen - 1) * ((after - before - weight * difference) ** 2).sum()) / total
    return Verdict(float(before.sum()) / total, float(after.sum()) / total, float(spread))
