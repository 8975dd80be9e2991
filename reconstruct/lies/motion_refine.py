"""Refine the motion between two lies on the rays of one of them: Gauss-Newton on what the solver's rays compare.

The surface stands still, and all cameras and lights of the lie move together: six numbers. Residuals are the
differences between transmittance and label of the lie's shadow rays, and between opacity and mask of its camera rays,
with weights that fall with the difference: a ray past a part that no lie saw is wrong under every motion.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from calibration.pose import Pose
from reconstruct.labels.held_out import HeldOut, draw_blocks, hold_out
from reconstruct.labels.supervision import SURE_ENOUGH, Supervision
from reconstruct.lies.noise import mean_difference
from reconstruct.lies.rotations import stepped
from reconstruct.scene import Scene
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.rays import visibility
from reconstruct.views import Scenes, placed

SHARPNESS = (4.0, 8.0)  # NeuS s per voxel: the first sees an edge from a voxel away
STEPS = 3  # of least squares at each
MOST_RAYS = 40_000  # of all shadow rays, and of all camera rays
WIDTH = 0.3  # difference from which a ray counts less
SEED = 2000  # of the rays that judge, beside the seed
JUDGING = 0.15  # of the blocks
SIGMAS = 2.0  # of the noise: by more a refined motion is worse
GROUPS = 10_000  # more than the photos of a scene
NUDGE = 0.05  # voxels at the object's edge, over the sharpness of 8: of the finite differences


@dataclass(frozen=True)
class LieRays:
    """The supervised rays of a lie's scenes, in the lie's world."""

    scenes: Scenes
    rays: tuple[Supervision, ...]


@dataclass(frozen=True)
class MotionTrial:
    """Mean robust error of held-out rays, shadow and camera rays together, in [0, 1], under two motions."""

    before: float
    after: float
    noise: float = 0.0  # one sigma of their difference, from how it varies between photos

    @property
    def is_kept(self) -> bool:
        """Whether the refined motion is kept: held-out rays do not clearly agree worse with it.

        It is the one that most rays agree with. The surface that judges is partly a guess, whose errors may hide the
        gain: what held-out rays cannot tell from noise is no reason against it.
        """
        return self.after - self.before <= SIGMAS * self.noise


def refined_motion(
    start: Pose, surface: SdfGrid, lie: LieRays, about: Float[np.ndarray, "3"], radius: float, seed: int = 0
) -> Pose:
    """Return the motion, from a start near it, under which a lie's rays agree best with a surface.

    Args:
        start: object_from_lie.
        surface: of the other lies, in the object's frame: one that this lie has shaped would hold the motion back.
        about: the object's centre there, and `radius` its size, world length: what a turn is measured with.
    """
    samples = _samples(lie, seed, is_judging=False)
    motion = start
    for sharpness in SHARPNESS:
        nudge = NUDGE * SHARPNESS[-1] / sharpness * surface.spacing
        steps = nudge * np.array([1 / radius] * 3 + [1.0] * 3)

        def residuals(pose: Pose, sharpness: float = sharpness) -> Float[np.ndarray, " n"]:
            return np.concatenate([sample.residuals(surface, pose, sharpness) for sample in samples])

        for _ in range(STEPS):
            now, columns = residuals(motion), []
            for own in np.diag(steps):
                ahead, behind = residuals(stepped(motion, own, about)), residuals(stepped(motion, -own, about))
                columns.append((ahead - behind) / 2)
            slopes, weight = np.stack(columns, 1), 1 / (1 + (now / WIDTH) ** 2) ** 2
            normal = (slopes * weight[:, None]).T @ slopes
            normal += 1e-9 * np.diag(np.diag(normal)) + 1e-12 * np.eye(6)
            motion = stepped(motion, -steps * np.linalg.solve(normal, (slopes * weight[:, None]).T @ now), about)
    return motion


def compare(lie: LieRays, surface: SdfGrid, before: Pose, after: Pose, seed: int = 0) -> MotionTrial:
    """Judge two motions by rays that refined_motion did not use, on a surface to which this lie has not contributed."""
    samples, errors = _samples(lie, seed, is_judging=True), []
    for motion in (before, after):
        off = np.concatenate([sample.residuals(surface, motion, SHARPNESS[-1]) for sample in samples])
        square = (off / WIDTH) ** 2
        errors.append(square / (1 + square))
    groups = np.unique(np.concatenate([sample.groups(k) for k, sample in enumerate(samples)]), return_inverse=True)[1]
    _, noise = mean_difference(errors[1], errors[0], groups)
    return MotionTrial(float(errors[0].mean()), float(errors[1].mean()), noise)


def _samples(lie: LieRays, seed: int, is_judging: bool) -> "list[_Sample]":
    """Draw the rays of each scene that refine, or the others that judge: whole blocks of pixels."""
    found = []
    for number, (scene, own) in enumerate(zip(lie.scenes, lie.rays, strict=True)):
        drawn = draw_blocks(own.pixels, scene.camera.width, 1, (seed, SEED + number), share=JUDGING)[0]
        found.append(_Sample(scene, own, drawn == is_judging, seed, MOST_RAYS // len(lie.scenes)))
    return found


class _Sample:
    """Some shadow rays and camera rays of some pixels of a scene."""

    def __init__(self, scene: Scene, rays: Supervision, chosen: Bool[np.ndarray, " pixels"], seed: int, most: int):
        rng = np.random.default_rng(seed)
        sure = np.flatnonzero(chosen & (rays.confidence > SURE_ENOUGH))
        wanted = np.zeros(rays.confidence.shape, bool)
        wanted.flat[rng.permutation(sure)[:most]] = True
        self.scene = scene
        self.shadow = hold_out(rays, wanted, with_outline=True)[1]
        seen = np.flatnonzero(chosen & (rays.mask_confidence > SURE_ENOUGH) & np.isfinite(rays.ground_t))
        self.pixels = np.sort(rng.permutation(seen)[:most])
        self.mask, self.weight = rays.mask[self.pixels], np.sqrt(rays.mask_confidence[self.pixels])

    def residuals(self, surface: SdfGrid, motion: Pose, sharpness: float) -> Float[np.ndarray, " n"]:
        """Return the weighted differences of all rays under a motion."""
        scene = placed(replace(self.scene, object_from_world=motion))
        directions = torch.from_numpy(motion.rotate(self.shadow.directions.double().numpy())).float()
        shadow: HeldOut = replace(self.shadow, directions=directions)
        shades = np.sqrt(shadow.weight) * shadow.differences(surface, scene, sharpness)
        which = torch.from_numpy(self.pixels)
        ground = scene.eye + shadow.ground_t[which, None] * directions[which]
        ends = torch.cat([ground, torch.ones(len(ground), 1)], 1)
        open_sight = visibility(surface, scene.eye.expand_as(ground).contiguous(), ends, sharpness / surface.spacing)
        return np.concatenate([shades, self.weight * (1 - open_sight.numpy() - self.mask)])

    def groups(self, number: int) -> Int[np.ndarray, " n"]:
        """Return a number for each residual: that of its photo, or one for all camera rays of the scene `number`."""
        first, count = number * GROUPS, len(self.scene.lights)
        return first + np.concatenate([self.shadow.photo, np.full(len(self.pixels), count)])
