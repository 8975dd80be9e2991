"""Refinement of lights along the gradient of the shadow rays, with the calibrated positions as prior."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.linalg import block_diag

from reconstruct.scene import Scene, carried_lights, ground_points, lights_in_frame
from reconstruct.views import Scenes, Some, by_scene, each

FIRST_ITERATION = 8  # before, the surface is still the hull and would drag the lights along
STEP = 1.0  # sigmas per unit of the level set's rate at full agreement: 0.03 of the distance at 3 % of uncertainty
MEMORY = 0.8  # of the running mean of the pull: an iteration sees all shadow edges, from a surface that is moving
PRIOR = 0.1  # balance of the rays, 0 to 1, that holds a light one sigma away from its calibrated place
FARTHEST = 3.0  # sigmas


@dataclass(frozen=True)
class LightShift:
    """Displacement of the lights from their calibrated positions, in sigmas, and the running mean of the pull."""

    shift: Float[np.ndarray, "photos 3"]
    pull: Float[np.ndarray, "photos 3"]


def no_shift(scenes: Scene | Scenes) -> LightShift:
    """Return the zero shift: every light at its calibrated position."""
    count = sum(len(scene.lights) for scene in each(scenes))
    return LightShift(np.zeros((count, 3)), np.zeros((count, 3)))


def lit_from(scene: Some, state: LightShift) -> Some:
    """Return a calibrated scene, or scenes, with the lights moved; the same object if none has moved."""
    if not state.shift.any():
        return scene
    if isinstance(scene, tuple):
        parts = zip(scene, by_scene(scene, state.shift), by_scene(scene, state.pull), strict=True)
        return tuple(lit_from(one, LightShift(shift, pull)) for one, shift, pull in parts)
    lights = _displaced(scene.lights.double().numpy(), state.shift * scene.light_sigma.double().numpy())
    return replace(scene, lights=torch.from_numpy(lights).float())


class MovingLights:
    """The lights of a scene, or of several, during refinement. A light with sigma 0 is known and does not move.

    In units of sigma, u = (q - q0) / sigma. Let g be the gradient of the shadow rays with respect to the light's
    position (or direction) and c the sum of its magnitudes. The pull p = g sigma / (c max sigma) lies in the unit ball;
    its length is 1 if all rays agree. A light moves by -rate STEP (mean p + PRIOR u); well-known axes move least. Then
    joint motions of a view's lights that change (almost) no shadow are projected out: the calibration determines them.
    """

    def __init__(self, scenes: Scene | Scenes, shift: LightShift, may_move: bool = True):
        self.shift = shift
        self._lights = np.concatenate([scene.lights.double().numpy() for scene in each(scenes)])
        self._sigma = np.concatenate([scene.light_sigma.double().numpy() for scene in each(scenes)])
        self.are_free = may_move and bool((self._sigma > 0).any())
        own = [np.concatenate([unseen_motion(s)[None], common_motions(s)]).reshape(6, -1) for s in each(scenes)]
        modes = np.asarray(block_diag(*own))
        self._scenes = each(scenes)
        left, size, _ = np.linalg.svd(modes.T, full_matrices=False)
        self._held = left[:, size > 1e-6 * size.max(initial=0.0)]

    def follow(self, gradient: Float[np.ndarray, "photos 4"], rate: float, iteration: int) -> None:
        """Move the lights by one step.

        Args:
            gradient: see RayOperators.light_gradient.
            rate: of the level set, voxels: it falls with the iterations, and so do the steps of the lights.
            iteration: of the whole solve.
        """
        gradient = self._turned(gradient, back=True)
        size = gradient[:, 3:] * self._sigma.max(1, keepdims=True)
        now = np.where(size > 0, gradient[:, :3] * self._sigma / np.where(size > 0, size, 1.0), 0.0)
        shift, pull = self.shift.shift, MEMORY * self.shift.pull + (1 - MEMORY) * now
        if iteration >= FIRST_ITERATION:
            shift = shift - rate * STEP * (pull + PRIOR * shift)
            shift = shift - (self._held @ (self._held.T @ shift.reshape(-1))).reshape(-1, 3)
            shift = shift / np.maximum(np.linalg.norm(shift, axis=1, keepdims=True) / FARTHEST, 1.0)
        self.shift = LightShift(shift, pull)

    def in_grid(self, origin: Float[np.ndarray, "3"], spacing: float) -> Float[np.ndarray, "photos 4"]:
        """Return the current lights, homogeneous, in the frame of a grid (origin: the surface's frame)."""
        lights = self._turned(_displaced(self._lights, self.shift.shift * self._sigma))
        return lights_in_frame(torch.from_numpy(lights), torch.from_numpy(origin), spacing).numpy()

    def _turned(self, values: Float[np.ndarray, "photos 4"], back: bool = False) -> Float[np.ndarray, "photos 4"]:
        """Return homogeneous lights of each scene's world in the surface's frame; gradients `back` from there."""
        if all(scene.object_from_world is None for scene in self._scenes):
            return values
        parts = [part.copy() for part in by_scene(self._scenes, values)]
        for scene, part in zip(self._scenes, parts, strict=True):
            motion = scene.object_from_world
            if motion is not None and back:
                part[:, :3] = motion.inverse().rotate(part[:, :3])
            elif motion is not None:
                part[:] = carried_lights(part, motion)
        return np.concatenate(parts)


def unseen_motion(scene: Scene) -> Float[np.ndarray, "photos 3"]:
    """Return the motion of all lights, with the object, that changes no shadow in the picture, in sigmas per unit.

    x -> (x + m h eye) / (1 + m h), h the height above the ground, preserves straight lines, every point of the ground
    and every camera ray, and so the picture of every shadow [Kriegman and Belhumeur 2001, What shadows reveal about
    object structure]. At m = 0 a point moves by h (eye - x), a direction d by d_z (eye - the ground in sight); the
    latter is exact only for a camera that is also far away.
    """
    lights, sigma = scene.lights.double().numpy(), scene.light_sigma.double().numpy()
    eye, places = scene.eye.double().numpy(), lights[:, :3]
    view = eye - np.nanmedian(ground_points(scene).reshape(-1, 3).double().numpy(), axis=0)
    across = view - (view * places).sum(1, keepdims=True) * places
    as_point, as_direction = (places[:, 2:] - scene.ground_height) * (eye - places), places[:, 2:] * across
    motion = np.where(lights[:, 3:] > 0, as_point, as_direction)
    return np.where(sigma > 0, motion / np.where(sigma > 0, sigma, 1.0), 0.0)


def common_motions(scene: Scene) -> Float[np.ndarray, "motions photos 3"]:
    """Return five joint motions of all lights, in sigmas: common shifts, and stretches along and away from the ground.

    Shadow labels that are all slightly too wide or too narrow cause just these motions; the calibration, averaged over
    all photos, is more accurate.
    """
    lights, sigma = scene.lights.double().numpy(), scene.light_sigma.double().numpy()
    middle = np.nanmedian(ground_points(scene).reshape(-1, 3).double().numpy(), axis=0)
    arm = lights[:, :3] - lights[:, 3:] * middle
    along, away = arm * [1, 1, 0], arm * [0, 0, 1]
    motions = np.stack([*(lights[:, 3:] * axis for axis in np.eye(3)), along, away])
    motions /= np.abs(motions).max(axis=(1, 2), keepdims=True).clip(min=1e-12)
    return np.where(sigma > 0, motions / np.where(sigma > 0, sigma, 1.0), 0.0)


def _displaced(
    lights: Float[np.ndarray, "photos 4"], by: Float[np.ndarray, "photos 3"]
) -> Float[np.ndarray, "photos 4"]:
    """Move homogeneous lights by world lengths, or radians; a moved direction stays a unit vector."""
    out = lights.copy()
    out[:, :3] += by
    turned = (lights[:, 3] == 0) & by.any(1)
    out[turned, :3] /= np.linalg.norm(out[turned, :3], axis=1, keepdims=True)
    return out
