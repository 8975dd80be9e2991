"""Highlights for the photos of tests/synthetic.py: GGX, Smith and Schlick, as renderers have them."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from synthetic import Truth

from calibration.light import Light, irradiance
from reconstruct.scene import Scene


def ggx(
    normals: np.ndarray, towards: np.ndarray, eye: np.ndarray, roughness: float, f0: float
) -> Float[np.ndarray, "*batch"]:
    """pi times the specular BRDF of a dielectric or grey metal."""
    halfway = towards + eye
    halfway = halfway / np.linalg.norm(halfway, axis=-1, keepdims=True)
    nl, nv = (np.maximum((normals * v).sum(-1), 1e-3) for v in (towards, eye))
    nh, lh = (normals * halfway).sum(-1), (towards * halfway).sum(-1)
    a2 = roughness**4
    distribution = a2 / (nh**2 * (a2 - 1) + 1) ** 2
    smith = 0.5 / (nl * np.sqrt(a2 + (1 - a2) * nv**2) + nv * np.sqrt(a2 + (1 - a2) * nl**2))
    return distribution * smith * (f0 + (1 - f0) * (1 - lh) ** 5)


def highlight(truth: Truth, light: Light, roughness: float, f0: float) -> Float[np.ndarray, "height width 3"]:
    """The radiance that gloss adds to the object's pixels under a light, if they see it."""
    points, normals = truth.points[truth.mask], truth.normals[truth.mask]
    xyzw = light.homogeneous()
    towards = xyzw[:3] - xyzw[3] * points
    towards = towards / np.linalg.norm(towards, axis=-1, keepdims=True)
    eye = truth.calibration.world_from_camera.translation - points
    eye = eye / np.linalg.norm(eye, axis=-1, keepdims=True)
    out = np.zeros_like(truth.points)
    out[truth.mask] = ggx(normals, towards, eye, roughness, f0)[:, None] * irradiance(points, normals, light)
    return out


def polished(scene: Scene, truth: Truth, roughness: float, f0: float) -> Scene:
    """The scene with a glossy object; what saturates is clipped and marked as such."""
    assert scene.rgb is not None
    lights = truth.calibration.lights
    added = np.stack([highlight(truth, light, roughness, f0) for light in lights]) * truth.visibility[..., None]
    rgb = scene.rgb + torch.from_numpy(added).float()
    return replace(scene, rgb=rgb.clamp(max=1), usable=scene.usable & (rgb < 1).all(-1))
