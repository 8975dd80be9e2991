"""Refine the motion between two object poses on the rays of one: Gauss-Newton on what the solver's rays compare.

The surface stands still, and all cameras and lights of the pose move together: six numbers. Residuals are the
differences between transmittance and label of the pose's shadow rays, and between opacity and mask of its camera rays,
with weights that fall with the difference: a ray past a part that no pose saw is wrong under every motion.

Six joint motions of each scene's lights are free besides: the one that changes no shadow where the object moves along
[Kriegman and Belhumeur 2001], common shifts and stretches. A calibration that reads the ground's shading knows these
worst, and shadow labels that are all too wide look like them. Held still, they would turn into a motion of the pose
towards the camera. They are unknowns of the refinement alone: the lights stay as calibrated.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.linalg import block_diag

from calibration.pose import Pose
from capture.checks.robust import cauchy, geman_mcclure
from reconstruct.labels.held_out import HeldOut, draw_blocks, hold_out
from reconstruct.labels.supervision import SURE_ENOUGH, Supervision
from reconstruct.object_poses.alignment import mean_difference, stepped
from reconstruct.object_poses.light_motions import MODES, LightMotions
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
CORRELATED = 100.0  # rays along a shadow's edge that count as one
GROUPS = 10_000  # more than the photos of a scene
NUDGE = 0.05  # voxels at the object's edge, over the sharpness of 8: of the finite differences


@dataclass(frozen=True)
class ObjectPoseRays:
    """The supervised rays of a pose's scenes, in the pose's world."""

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
    start: Pose,
    surface: SdfGrid,
    object_pose: ObjectPoseRays,
    about: Float[np.ndarray, "3"],
    radius: float,
    seed: int = 0,
) -> tuple[Pose, ObjectPoseRays]:
    """Return the motion, from a start near it, under which a pose's rays agree best with a surface.

    The rays are returned with it under the lights, moved together, under which they agree so.

    Args:
        start: object_from_world.
        surface: of the other poses, in the object's frame: one that this pose has shaped would hold the motion back.
        about: the object's centre there, and `radius` its size, world length: what a turn is measured with.
    """
    samples = _samples(object_pose, seed, is_judging=False)
    motion, middle = start, start.inverse().apply(about)
    lights = [LightMotions(scene, middle, np.zeros(MODES)) for scene in object_pose.scenes]
    for sharpness in SHARPNESS:
        shift = NUDGE * SHARPNESS[-1] / sharpness * surface.spacing
        steps = shift * np.array([1 / radius] * 3 + [1.0] * 3)
        nudges = [own.nudges(shift / radius) for own in lights]
        sigma = np.concatenate([np.full(6, np.inf), *(1 / own for own in nudges)])

        def residuals(pose: Pose, lit: list[LightMotions], sharpness: float = sharpness) -> Float[np.ndarray, " n"]:
            pairs = zip(samples, lit, strict=True)
            return np.concatenate([sample.residuals(surface, pose, sharpness, own.scene()) for sample, own in pairs])

        for _ in range(STEPS):
            columns = []
            for own in np.diag(steps):
                ahead, behind = (residuals(stepped(motion, sign * own, about), lights) for sign in (1, -1))
                columns.append((ahead - behind) / 2)
            each = zip(samples, lights, nudges, strict=True)
            of_lights = [sample.light_slopes(surface, motion, sharpness, own, nudge) for sample, own, nudge in each]
            slopes = np.concatenate([np.stack(columns, 1), block_diag(*of_lights)], 1)
            at = np.concatenate([np.zeros(6), *(own.amounts / by for own, by in zip(lights, nudges, strict=True))])
            step = _least_squares(slopes, residuals(motion, lights), at, sigma)
            motion = stepped(motion, steps * step[:6], about)
            changes = np.concatenate(nudges) * step[6:]
            lights = [own.changed(by) for own, by in zip(lights, changes.reshape(-1, MODES), strict=True)]
    return motion, replace(object_pose, scenes=tuple(own.scene() for own in lights))


def _least_squares(
    slopes: Float[np.ndarray, "n unknowns"],
    now: Float[np.ndarray, " n"],
    at: Float[np.ndarray, " unknowns"],
    sigma: Float[np.ndarray, " unknowns"],
) -> Float[np.ndarray, " unknowns"]:
    """Return the step that makes the residuals least, with weights that fall with the residual.

    Args:
        at: the unknowns, whose prior is 0 with one `sigma` (inf: none); CORRELATED rays count as one.
    """
    weight = geman_mcclure((now / WIDTH) ** 2)
    normal = (slopes * weight[:, None]).T @ slopes
    prior = CORRELATED * float((weight * now**2).sum() / weight.sum()) / sigma**2
    normal += np.diag(prior) + 1e-9 * np.diag(np.diag(normal)) + 1e-12 * np.eye(len(normal))
    return -np.linalg.solve(normal, (slopes * weight[:, None]).T @ now + prior * at)


def compare(
    surface: SdfGrid, before: tuple[Pose, ObjectPoseRays], after: tuple[Pose, ObjectPoseRays], seed: int = 0
) -> MotionTrial:
    """Judge two motions by rays that refined_motion did not use, on a surface to which this pose has not contributed.

    Args:
        before, after: each motion with the same pose's rays, under the lights that go with it.
    """
    samples, errors = _samples(before[1], seed, is_judging=True), []  # the same rays under either lights
    for motion, object_pose in (before, after):
        pairs = zip(samples, object_pose.scenes, strict=True)
        off = np.concatenate([sample.residuals(surface, motion, SHARPNESS[-1], scene) for sample, scene in pairs])
        errors.append(1 - cauchy((off / WIDTH) ** 2))
    groups = np.concatenate([sample.groups(k) for k, sample in enumerate(samples)])
    of_photo = np.unique(groups, return_inverse=True)[1]
    _, noise = mean_difference(errors[1], errors[0], of_photo)
    return MotionTrial(float(errors[0].mean()), float(errors[1].mean()), noise)


def _samples(object_pose: ObjectPoseRays, seed: int, is_judging: bool) -> "list[_Sample]":
    """Draw the rays of each scene that refine, or the others that judge: whole blocks of pixels."""
    found = []
    for number, (scene, own) in enumerate(zip(object_pose.scenes, object_pose.rays, strict=True)):
        drawn = draw_blocks(own.pixels, scene.camera.width, 1, (seed, SEED + number), share=JUDGING)[0]
        found.append(_Sample(scene, own, drawn == is_judging, seed, MOST_RAYS // len(object_pose.scenes)))
    return found


class _Sample:
    """Some shadow rays and camera rays of some pixels of a scene."""

    def __init__(self, scene: Scene, rays: Supervision, chosen: Bool[np.ndarray, " pixels"], seed: int, most: int):
        rng = np.random.default_rng(seed)
        sure = np.flatnonzero(chosen & (rays.confidence > SURE_ENOUGH))
        wanted = np.zeros(rays.confidence.shape, bool)
        wanted.flat[rng.permutation(sure)[:most]] = True
        self.count = len(scene.lights)
        self.shadow = hold_out(rays, wanted, with_outline=True)[1]
        seen = np.flatnonzero(chosen & (rays.mask_confidence > SURE_ENOUGH) & np.isfinite(rays.ground_t))
        self.pixels = np.sort(rng.permutation(seen)[:most])
        self.mask, self.weight = rays.mask[self.pixels], np.sqrt(rays.mask_confidence[self.pixels])

    def residuals(self, surface: SdfGrid, motion: Pose, sharpness: float, scene: Scene) -> Float[np.ndarray, " n"]:
        """Return the weighted differences of all rays under a motion and the scene's lights."""
        scene, directions = self._there(motion, scene)
        which = torch.from_numpy(self.pixels)
        ground = scene.eye + self.shadow.ground_t[which, None] * directions[which]
        ends = torch.cat([ground, torch.ones(len(ground), 1)], 1)
        open_sight = visibility(surface, scene.eye.expand_as(ground).contiguous(), ends, sharpness / surface.spacing)
        shades = self._shades(surface, sharpness, scene, directions)
        return np.concatenate([shades, self.weight * (1 - open_sight.numpy() - self.mask)])

    def light_slopes(
        self, surface: SdfGrid, motion: Pose, sharpness: float, lights: LightMotions, nudges: Float[np.ndarray, "6"]
    ) -> Float[np.ndarray, "n 6"]:
        """Return the change of the residuals as each joint motion of the lights grows by its nudge."""
        columns = []
        for own in np.diag(nudges):
            ends = (self._there(motion, lights.changed(sign * own).scene()) for sign in (1, -1))
            ahead, behind = (self._shades(surface, sharpness, *there) for there in ends)
            columns.append((ahead - behind) / 2)
        return np.pad(np.stack(columns, 1), ((0, len(self.pixels)), (0, 0)))  # a camera ray knows no light

    def _there(self, motion: Pose, scene: Scene) -> tuple[Scene, Float[torch.Tensor, "pixels 3"]]:
        """Return the scene in the surface's frame, and the rays of its pixels."""
        directions = torch.from_numpy(motion.rotate(self.shadow.directions.double().numpy())).float()
        return placed(replace(scene, object_from_world=motion)), directions

    def _shades(
        self, surface: SdfGrid, sharpness: float, scene: Scene, directions: Float[torch.Tensor, "pixels 3"]
    ) -> Float[np.ndarray, " rays"]:
        shadow: HeldOut = replace(self.shadow, directions=directions)
        return np.sqrt(shadow.weight) * shadow.differences(surface, scene, sharpness)

    def groups(self, number: int) -> Int[np.ndarray, " n"]:
        """Return a number for each residual: that of its photo, or one for all camera rays of the scene `number`."""
        first, count = number * GROUPS, self.count
        return first + np.concatenate([self.shadow.photo, np.full(len(self.pixels), count)])
