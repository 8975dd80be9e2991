"""Truth: a sphere over a plane, whose shadow, depth and view of the sky have closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from flashlight_photos import looking_at
from synthetic import Sphere, grid_of

from calibration.camera import Camera
from calibration.light import Light
from calibration.pose import Pose
from calibration.posed_camera import PosedCamera
from reconstruct.appearance.brdf import MATERIALS, Gloss, Material, conserving, reflectance
from reconstruct.fields import SolvedScene
from reconstruct.render.environment import WHITE_PAPER, exposed, ground_light, patches
from reconstruct.render.g_buffer import RenderView, look, surface_maps
from reconstruct.render.relight import environment, lit_share, relight
from reconstruct.sdf.grid import SdfGrid

CENTRE, RADIUS = torch.tensor([0.1, -0.1, 0.6]), 0.45
SPACING = 0.04
MIDDLE = np.array([0.0, 0.0, 0.4])


def sphere_grid() -> SdfGrid:
    return grid_of((Sphere((0.1, -0.1, 0.6), RADIUS),), SPACING)


CAMERA = Camera(64, 48, 70.0, 70.0, 31.0, 24.5, (0.1, -0.05, 0.002, -0.001, 0.0))
POSE = looking_at(np.array([0.3, -3.0, 2.2]), MIDDLE)


NOTHING = SdfGrid(torch.ones(2, 2, 2), torch.full((3,), 50.0), 0.01)


def fields(albedo: torch.Tensor | None = None, grid: SdfGrid | None = None) -> SolvedScene:
    albedo = torch.full((48, 64, 3), 0.5) if albedo is None else albedo
    return SolvedScene(grid or sphere_grid(), albedo, CAMERA, POSE, 0.0, "scene")


def everywhere(view: RenderView, material: Material) -> RenderView:
    """Put one material on all that is seen; it reflects at most all light."""
    lobes, seen = material.coefficients(), torch.isfinite(view.maps.depth)
    points, normals = view.maps.points[seen], view.maps.normals[seen]
    cosine = (normals * torch.nn.functional.normalize(view.eye - points, dim=-1)).sum(-1)
    albedo, colour = view.albedo.clone(), torch.tensor(material.albedo).expand(len(points), 3)
    albedo[seen], _ = conserving(colour, lobes.expand(len(points), *lobes.shape), cosine)
    return replace(view, albedo=albedo, gloss=Gloss(lobes[None], seen[..., None].float()))


def evening(size: tuple[int, int]) -> torch.Tensor:
    """A low sun of one texel, which sends about half of all light, in a sky that is brighter overhead."""
    sky = patches(size)[0][..., 2:].clamp(min=0) * torch.tensor([0.3, 0.5, 1.0])
    sky[2 * size[0] // 5, size[1] // 20] = 0.1 * size[0] * size[1] * torch.tensor([1.0, 0.6, 0.3])
    return sky


@pytest.fixture(scope="module")
def view():
    return look(fields())


LIGHTS = [
    Light("p", "point", np.array([1.2, 0.6, 2.0])),
    Light("d", "directional", direction=np.array([-0.48, 0.6, 0.64])),
]


@pytest.mark.parametrize("light", LIGHTS)
def test_the_shadow_on_the_ground_is_where_the_segment_to_the_light_meets_the_sphere(view, light):
    picture = relight(view, light)
    ground = ~view.maps.mask
    points = view.maps.points[ground]
    xyzw = torch.from_numpy(light.homogeneous()).float()
    towards = torch.nn.functional.normalize(xyzw[:3] - xyzw[3] * points, dim=-1)
    nearest = ((CENTRE - points) * towards).sum(-1, keepdim=True)
    passing = (points + nearest * towards - CENTRE).norm(dim=-1) - RADIUS
    clear = passing.abs() > SPACING  # nearer, the edge is a ramp
    lit = picture[ground].amax(-1) > 1e-3
    assert torch.equal(lit[clear], (passing > 0)[clear])
    assert 0.02 < (~lit).float().mean() < 0.5


def test_unshadowed_ground_obeys_the_inverse_square_law_and_the_ambient_term(view):
    light = Light("p", "point", np.array([0.0, -1.0, 3.0]), power=np.array([2.0, 4.0, 6.0]))
    picture = relight(view, light, ambient=np.array([0.1, 0.1, 0.1]))
    corner = view.maps.points[-1, 0].double().numpy()
    towards = np.array([0.0, -1.0, 3.0]) - corner
    expected = 0.5 * (np.array([2.0, 4.0, 6.0]) * towards[2] / np.linalg.norm(towards) ** 3 + 0.1)
    assert np.allclose(picture[-1, 0].numpy(), expected, rtol=1e-4)


def test_the_penumbra_of_an_edge_is_as_wide_as_similar_triangles_say():
    top, bottom, lamp_height, radius, spacing = 0.5, 0.4, 2.5, 0.2, 0.02
    x, _, z = torch.meshgrid(*[spacing * torch.arange(n) for n in (60, 60, 30)], indexing="ij")
    slab = torch.maximum(x - 0.6, (z - 0.45).abs() - 0.05)  # a plate whose edge lies under the lamp
    edge = SdfGrid(slab.float(), torch.tensor([-0.6, -0.6, 0.0]), spacing)
    above = Camera(240, 3, 300.0, 300.0, 119.5, 1.0, (0.0, 0.0, 0.0, 0.0, 0.0))
    down = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.4]))
    seen = surface_maps(NOTHING, PosedCamera(above, down, 0.0))
    lamp = Light("p", "point", np.array([0.0, 0.0, lamp_height]))
    share = lit_share(RenderView(seen, torch.ones(3, 240, 3), edge, torch.zeros(3)), lamp, radius, 400)[1]
    along = seen.points[1, :, 0]
    width = along[share < 0.9].max() - along[share > 0.1].min()
    # an edge that hides 10 % of a disc lies 0.687 radii from its middle; the top limits the outer half of the penumbra
    expected = 0.687 * radius * (top / (lamp_height - top) + bottom / (lamp_height - bottom))
    assert abs(width / expected - 1) < 0.05


def test_under_a_white_sky_every_surface_shows_its_albedo_times_the_sky_it_sees(view):
    picture = environment(view, torch.ones(32, 64, 3), rows=32)[..., 0] / 0.5
    maps = view.maps
    sphere = maps.mask & (maps.normals[..., 2] > 0)  # below its equator, the ground's horizon is one voxel away
    assert (picture[sphere] - (1 + maps.normals[..., 2][sphere]) / 2).abs().max() < 0.005
    offset = CENTRE - maps.points[~maps.mask]
    covered = RADIUS**2 * offset[:, 2] / offset.norm(dim=-1) ** 3  # form factor of a sphere above the horizon
    error = (picture[~maps.mask] - (1 - covered)).abs()
    assert error.max() < 0.01


def brute_force(view: RenderView, radiance: torch.Tensor, turn: float = 0.0) -> torch.Tensor:
    """The sum over all texels above the horizon, one at a time, with cosine, shadow and solid angle."""
    total, (rows, columns) = torch.zeros_like(view.albedo), radiance.shape[:2]
    for row in range(rows // 2):
        band = math.cos(math.pi * row / rows) - math.cos(math.pi * (row + 1) / rows)
        for column in range(columns):
            theta, phi = math.pi * (row + 0.5) / rows, 2 * math.pi * (column + 0.5) / columns + turn
            direction = [math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), math.cos(theta)]
            power = radiance[row, column].double().numpy() * band * 2 / columns
            total += relight(view, Light("", "directional", direction=np.array(direction), power=power))
    return total


def test_a_surrounding_equals_the_sum_over_all_texels_to_a_hundredth():
    small = look(fields(), width=20)
    radiance = exposed(evening((16, 32)))
    exact = brute_force(small, radiance, turn=0.7)
    error = (environment(small, radiance, rows=16, turn=0.7) - exact).abs()
    assert error.mean() < 0.01 * exact.mean() and error.max() < 0.01 * exact.max()


@pytest.mark.parametrize("sky", [evening((64, 128)), torch.ones(64, 128, 3), 7 * evening((64, 128)).roll(9, 1)])
def test_white_paper_on_open_ground_is_as_bright_under_every_sky(sky):
    free = look(fields(grid=NOTHING), width=8)
    sky = exposed(sky)
    white = environment(free, sky) / free.albedo
    assert torch.allclose(white, ground_light(sky).expand_as(white), rtol=0.02)
    assert abs(float(white[0, 0] @ torch.tensor([0.2126, 0.7152, 0.0722])) / WHITE_PAPER - 1) < 0.02


def test_what_the_camera_cannot_see_is_painted_from_the_nearest_that_it_can():
    albedo = torch.full((48, 64, 3), 0.25)
    albedo[look(fields()).maps.mask] = torch.tensor([0.8, 0.4, 0.2])
    behind = look(fields(albedo), posed_camera=PosedCamera(CAMERA, looking_at(np.array([0.0, 3.0, 2.2]), MIDDLE), 0.0))
    assert torch.allclose(behind.albedo[behind.maps.mask], torch.tensor([0.8, 0.4, 0.2]), atol=1e-5)
    assert torch.allclose(behind.albedo[~behind.maps.mask], torch.tensor(0.25), atol=1e-5)


GLOSSY = Material((0.3, 0.2, 0.1), (0.3, 0.3, 0.3), 0.45)
SHARP = Material((1.0, 1.0, 1.0), (0.1, 0.1, 0.1), 0.15)


@pytest.mark.parametrize("material", [GLOSSY, SHARP, MATERIALS["gold"]])
def test_in_a_white_furnace_a_surface_shows_what_it_reflects_and_never_more_than_all(material):
    furnace = everywhere(look(fields(grid=NOTHING), width=8), material)
    picture = environment(furnace, torch.ones(16, 32, 3))
    cosine = (furnace.eye - furnace.maps.points)[..., 2] / (furnace.eye - furnace.maps.points).norm(dim=-1)
    mirrored = reflectance(material.coefficients().expand(*cosine.shape, -1, -1), cosine)
    assert material.albedo is not None
    expected = mirrored + torch.minimum(torch.tensor(material.albedo), 1 - mirrored)
    assert (picture / expected - 1).abs().max() < 0.02
    assert picture.max() < 1.02
