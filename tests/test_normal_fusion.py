"""Positions and normals combined, on a ball whose normals and distances are known."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from synthetic import BALL, Look, render
from torch.nn.functional import normalize

from reconstruct.labels.labels import assemble_labels
from reconstruct.labels.outline import local_mean
from reconstruct.labels.supervision import normal_rays, supervise
from reconstruct.sdf import kernels
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.normal_fusion import NormalRays, combine_with_normals
from reconstruct.sdf.rays import find_surface

RADIUS, NODES = 20.0, 52  # voxels; spacing 1, the ball's centre is the world's origin
EYES = ((90.0, 0.0, 0.0), (-45.0, 78.0, 0.0), (-45.0, -78.0, 0.0))


def ball(unevenness: float = 0.0) -> SdfGrid:
    """A ball whose distances are off by smooth noise, voxels."""
    axis = np.arange(NODES) - (NODES - 1) / 2
    away = np.sqrt(sum(x**2 for x in np.meshgrid(axis, axis, axis, indexing="ij"))) - RADIUS
    noise = gaussian_filter(np.random.default_rng(0).standard_normal(away.shape), 2.0)
    values = away + unevenness * noise / noise.std()
    return SdfGrid(torch.from_numpy(values.astype(np.float32)), torch.full((3,), float(axis[0])), 1.0)


def camera(surface: SdfGrid, eye: tuple[float, float, float], trust: float = 0.8) -> NormalRays:
    """Rays over the whole ball and beyond, with the true normals of a ball where they meet the surface."""
    towards = normalize(-torch.tensor(eye), dim=0)
    right = normalize(torch.linalg.cross(towards, torch.tensor([0.0, 0, 1])), dim=0)
    up = torch.linalg.cross(right, towards)
    side = torch.linspace(-0.28, 0.28, 60)
    x, y = (part.reshape(-1, 1) for part in torch.meshgrid(side, side, indexing="xy"))
    rays = normalize(towards + x * right + y * up, dim=1)
    origin = torch.tensor(eye)
    t = find_surface(surface, origin.expand_as(rays), rays)
    hit = t.isfinite()
    points = origin + torch.where(hit, t, torch.zeros(()))[:, None] * rays
    normals = torch.where(hit[:, None], normalize(points, dim=1), torch.zeros(()))
    nothing = np.zeros(len(rays), bool)
    return NormalRays(origin, rays, torch.full((len(rays),), torch.inf), normals.numpy(), trust * hit.numpy(), nothing)


def seen(surface: SdfGrid, eye: tuple[float, float, float]) -> torch.Tensor:
    """Points of the surface that a camera sees."""
    rays = camera(surface, eye)
    t = find_surface(surface, rays.eye.expand_as(rays.directions), rays.directions)
    return (rays.eye + t[:, None] * rays.directions)[t.isfinite()]


def angle(surface: SdfGrid) -> float:
    """Mean angle between the normals of what the cameras see and a ball's, degrees."""
    points = torch.cat([seen(surface, eye) for eye in EYES])
    cosine = (normalize(surface.gradient(points), dim=1) * normalize(points, dim=1)).sum(1)
    return float(cosine.clamp(-1, 1).arccos().rad2deg().mean())


def test_an_uneven_ball_faces_as_its_normals_say_and_keeps_its_place():
    uneven = ball(0.15)
    smooth = combine_with_normals(uneven, [camera(uneven, eye) for eye in EYES])
    assert angle(uneven) > 3
    assert angle(smooth) < angle(uneven) / 3
    radius = [float(torch.cat([seen(one, eye) for eye in EYES]).norm(dim=1).mean()) for one in (uneven, smooth)]
    assert abs(radius[1] - radius[0]) < 0.02


def test_wrong_normals_among_right_ones_hardly_tell():
    uneven = ball(0.15)
    rng = np.random.default_rng(1)

    def spoilt(one: NormalRays) -> NormalRays:
        """A seventh of the normals point anywhere."""
        anywhere = rng.standard_normal(one.normals.shape).astype(np.float32)
        anywhere /= np.linalg.norm(anywhere, axis=1, keepdims=True)
        return replace(one, normals=np.where(rng.random((len(anywhere), 1)) < 1 / 7, anywhere, one.normals))

    after = combine_with_normals(uneven, [spoilt(camera(uneven, eye)) for eye in EYES])
    assert angle(after) < angle(uneven) / 2  # 3.2 degrees before, 0.4 without them, 1.1 with them


def test_outlines_stay_where_pixels_see_them():
    """Normals that lean by 6 degrees would turn the ball's limb; pixels at the outline know where it is."""
    even = ball()
    front = camera(even, EYES[0])
    lean = np.array([0, 0, np.tan(np.radians(6))], np.float32)
    normals = front.normals + lean * (front.trust > 0)[:, None]
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    leaning = replace(front, normals=normals.astype(np.float32))
    facing = np.abs((front.directions.numpy() * front.normals).sum(1))
    limb = (front.trust > 0) & (facing < 0.35)
    free, held = (
        combine_with_normals(even, [replace(leaning, at_outline=flags)]) for flags in (leaning.at_outline, limb)
    )
    points = seen(even, EYES[0])
    at = (normalize(points, dim=1) * normalize(points - front.eye, dim=1)).sum(1).abs() < 0.35
    moved = [float(one.sdf(points[at]).abs().mean()) for one in (free, held)]
    assert moved[1] < 0.5 * moved[0]


@pytest.mark.parametrize("is_colour", [True, False])
def test_normals_are_taken_from_object_pixels_of_photos_and_not_of_shadow_pictures(is_colour):
    scene, _ = render((BALL,), Look(with_shadow=True, with_mask=True))
    scene = scene if is_colour else replace(scene, rgb=None)
    labels = assemble_labels(replace(scene, rgb=None), None, None)
    rays = supervise(scene, replace(labels, mask=local_mean(labels.mask[None], 3)[0]))  # grey at the outline
    rays = replace(rays, normal_confidence=np.ones_like(rays.normal_confidence))
    found = normal_rays(scene, rays)
    object_pixels = rays.role == kernels.OBJECT
    assert object_pixels.any() and (rays.role == kernels.EDGE).any()
    np.testing.assert_array_equal(found.trust > 0, object_pixels & is_colour)
    np.testing.assert_array_equal(found.at_outline, rays.role == kernels.EDGE)
