"""Joint motions of a scene's lights, which a calibration knows worst.

Six of them: the one that changes no shadow where the object moves along, common shifts along the three axes, and
stretches along and away from the ground.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float

from reconstruct.scene import Scene, ground_points

MODES = 6


@dataclass(frozen=True)
class LightMotions:
    """The lights of a scene, moved together by an amount of each of six motions: sigmas of the lights, mean square."""

    calibrated: Scene
    middle: Float[np.ndarray, "3"]  # of the object, in the scene's world
    amounts: Float[np.ndarray, "6"]

    @cached_property
    def _modes(self) -> Float[np.ndarray, "6 photos 3"]:
        """The motions, in sigmas of the lights per unit; 0 where all lights are known."""
        modes = np.concatenate([unseen_motion(self.calibrated)[None], common_motions(self.calibrated)])
        return modes / np.sqrt((modes**2).sum(2).mean(1)).clip(min=1e-12)[:, None, None]

    def nudges(self, turn: float) -> Float[np.ndarray, "6"]:
        """Return the amounts that displace the light that moves most by an angle as seen from the object, rad."""
        lights, sigma = self.calibrated.lights.double().numpy(), self.calibrated.light_sigma.double().numpy()
        distance = np.linalg.norm(lights[:, :3] - lights[:, 3:] * self.middle, axis=1)
        angle = np.linalg.norm(self._modes * sigma, axis=2) / distance
        return turn / angle.max(axis=1).clip(min=1e-12)

    def changed(self, by: Float[np.ndarray, "6"]) -> "LightMotions":
        """Return the lights moved further."""
        return replace(self, amounts=self.amounts + by)

    def scene(self) -> Scene:
        """Return the scene under these lights; a moved direction stays a unit vector."""
        sigma, lights = self.calibrated.light_sigma.double().numpy(), self.calibrated.lights.double().numpy().copy()
        by = np.tensordot(self.amounts, self._modes, 1) * sigma
        lights[:, :3] += by
        turned = (lights[:, 3] == 0) & by.any(1)
        lights[turned, :3] /= np.linalg.norm(lights[turned, :3], axis=1, keepdims=True)
        return replace(self.calibrated, lights=torch.from_numpy(lights).float())


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
