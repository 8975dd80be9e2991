"""Truth: glossy spheres by GGX, which the lobes have to approximate, and matt ones without any gloss."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from glossy import highlight, polished
from jaxtyping import Float
from scipy import ndimage
from synthetic import BALL, Look, Sphere, Truth, grid_of, render
from test_mesh import glb_parts
from torch import Tensor

from calibration.light import Light, irradiance
from reconstruct.appearance.brdf import Material, facing_reflectance, specular
from reconstruct.appearance.lobe_fit import Indirect, Samples, fit_lobes, from_endless_ground
from reconstruct.fields import SolvedScene
from reconstruct.labels.ground_test import test_ground as check_ground
from reconstruct.labels.highlights import (
    lit_pixels,
    material_without_ground,
    matt_photos,
    surface_appearance,
    with_lit_ground,
)
from reconstruct.labels.photometric_stereo import label_object
from reconstruct.mesh.mesh import extract_mesh, mesh_material, save_mesh
from reconstruct.render.g_buffer import look
from reconstruct.render.relight import relight
from reconstruct.scene import Scene
from reconstruct.sdf.grid import SdfGrid

LOOK = Look(n_lights=24, texture=0.3, noise=0.002)
ROUGHNESS, F0 = 0.4, 0.08
UNSEEN = Light("unseen", "point", np.array([150.0, -350.0, 300.0]), power=np.full(3, 0.6 * 400.0**2))
SPACING = 2.5


def tensor(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values)).float()


def dark(scene: Scene) -> Indirect:
    return from_endless_ground(torch.zeros(len(scene.lights)))


def solved(scene: Scene, truth: Truth) -> SolvedScene:
    """The true surface with the material read from the photos."""
    normals = tensor(truth.normals * truth.mask[..., None])
    lit = lit_pixels(scene, grid_of((BALL,), SPACING), tensor(truth.points), normals)
    albedo, gloss = surface_appearance(scene, tensor(truth.points), normals, lit, dark(scene))
    albedo = torch.where(torch.from_numpy(truth.mask)[..., None], albedo, tensor(truth.albedo))
    pose = truth.calibration.world_from_camera
    return SolvedScene(grid_of((BALL,), SPACING), albedo, truth.calibration.camera, pose, 0.0, "mm", gloss=gloss)


@pytest.fixture(scope="module")
def matt() -> tuple[Scene, Truth]:
    return render((BALL,), LOOK)


@pytest.fixture(scope="module")
def glossy(matt) -> Scene:
    return polished(*matt, ROUGHNESS, F0)


@pytest.fixture(scope="module")
def fields(matt, glossy) -> SolvedScene:
    return solved(glossy, matt[1])


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((a - b) ** 2)))


def test_a_picture_under_an_unseen_light_shows_the_highlight(matt, fields):
    _, truth = matt
    picture = relight(look(fields), UNSEEN).numpy()
    direct = truth.albedo * irradiance(truth.points, truth.normals, UNSEEN)
    expected = direct + highlight(truth, UNSEEN, ROUGHNESS, F0)  # its shadows are not compared
    lit = truth.mask & (picture.max(-1) > 0) & (expected.max(-1) > 0.02)
    lambert = relight(look(replace(fields, gloss=None)), UNSEEN).numpy()
    assert psnr(picture[lit], expected[lit]) > 36
    assert psnr(picture[lit], expected[lit]) > psnr(lambert[lit], expected[lit]) + 8


def test_wide_highlights_and_misstated_powers_do_not_tilt_normals_without_a_ground(matt):
    scene, truth = matt
    shiny, points, mask = polished(scene, truth, 0.5, 0.3), tensor(truth.points), tensor(truth.mask)
    assert shiny.rgb is not None
    misstated = torch.ones(len(shiny.lights))
    misstated[:4] = 1.3
    given = replace(shiny, rgb=shiny.rgb * misstated[:, None, None, None])
    before = label_object(given, points, None, mask)
    material = material_without_ground(given, points, before)
    assert material is not None and material.lobes.any()
    after = label_object(matt_photos(given, points, before, material), points, None, mask)
    assert mean_angle(after.normals, truth) < 0.5 * mean_angle(before.normals, truth)
    assert torch.allclose(material.log_gains[:4], misstated[:4].log(), atol=0.05)
    assert material.log_gains[4:].abs().max() < 0.15  # lights that few pixels face share what the lobes do not fit


def mean_angle(normals: Float[Tensor, "height width 3"], truth: Truth) -> float:
    return float(truth.degrees(normals)[truth.mask].mean())


def test_a_matt_ball_has_no_lobes(matt):
    scene, truth = matt
    assert solved(scene, truth).gloss is None


def test_gloss_is_that_of_the_part_that_shines():
    apart = (Sphere((-32.0, 0.0, 28.0), 28.0), Sphere((32.0, 0.0, 28.0), 28.0))
    scene, truth = render(apart, LOOK)
    shiny = polished(scene, truth, ROUGHNESS, F0)
    left = torch.from_numpy(truth.points[..., 0] < 0)
    assert scene.rgb is not None and shiny.rgb is not None
    half = replace(shiny, rgb=torch.where(left[..., None], shiny.rgb, scene.rgb), usable=shiny.usable | ~left)
    nowhere = SdfGrid(torch.full((2, 2, 2), 100.0), torch.full((3,), 500.0), 1.0)
    normals = tensor(truth.normals * truth.mask[..., None])
    lit = lit_pixels(half, nowhere, tensor(truth.points), normals)
    _, gloss = surface_appearance(half, tensor(truth.points), normals, lit, dark(scene))
    assert gloss is not None
    scale, on_object = gloss.weights[..., 0], torch.from_numpy(truth.mask)
    assert scale[on_object & ~left].median() < 0.2 * scale[on_object & left].median()


def test_the_glb_says_how_rough_the_object_is(fields, tmp_path):
    mesh = extract_mesh(fields)
    save_mesh(mesh, tmp_path / "mesh.ply", tmp_path / "mesh.glb", "mm", mesh_material(fields, mesh))
    material = glb_parts(tmp_path / "mesh.glb")[0]["materials"][0]["pbrMetallicRoughness"]
    assert material["roughnessFactor"] == pytest.approx(ROUGHNESS, abs=0.08)
    assert material["metallicFactor"] < 0.15
    assert mesh_material(replace(fields, gloss=None), mesh) is None


@pytest.mark.parametrize("seed", range(2))
def test_no_lobe_is_made_up_that_no_photo_shows(seed):
    """Half vectors all stay some 13 degrees off the normal: of sharper lobes than the true ones there is only noise."""
    generator = torch.Generator().manual_seed(seed)
    points, photos, true = 200, 20, Material(None, (0.06, 0.06, 0.06), 0.6).coefficients()

    def spread(shape: tuple[int, ...], by: tuple[float, ...], about: float) -> Tensor:
        drawn = torch.randn(*shape, 3, generator=generator) * torch.tensor(by)
        return torch.nn.functional.normalize(drawn + torch.tensor([0.0, 0.0, about]), dim=-1)

    normals, eye = spread((points,), (0.4, 0.4, 0.1), 1.0), torch.tensor([[0.0, 0.0, 1.0]]).repeat(points, 1)
    towards = spread((photos,), (1.0, 1.0, 0.2), 0.8).repeat(points, 1, 1)
    halfway = torch.nn.functional.normalize(towards + eye[:, None], dim=-1)
    facing = (towards * normals[:, None]).sum(-1, keepdim=True)
    beside = (halfway * normals[:, None]).sum(-1) < 0.975
    albedo = 0.3 + 0.3 * torch.rand(points, 1, 3, generator=generator)
    value = (albedo + specular(true, normals[:, None], towards, eye[:, None])) * facing.clamp(min=0)
    value = value + 0.01 * torch.randn(value.shape, generator=generator)
    lit = (beside & (facing[..., 0] > 0.1)).float()
    found = fit_lobes(Samples(value, lit, torch.ones_like(value), torch.zeros_like(value), towards, eye, normals))
    assert torch.allclose(facing_reflectance(found.coefficients), torch.tensor(0.06), rtol=0.25)


def test_ground_without_a_lit_label_gets_its_albedo_where_the_surface_lets_light_arrive():
    """The labels of a print's edges fail; ground that the ball shades from every light stays unknown."""
    scene, truth = render((BALL,), Look(width=96, height=72, n_lights=3, texture=0.2, ambient=0.05))
    assert scene.rgb is not None
    once = {"lights": scene.lights, "power": scene.power, "rgb": scene.rgb}  # three photos under one light
    scene = replace(scene, **{name: value[:1].expand_as(value) for name, value in once.items()})
    points = torch.from_numpy(np.where(np.isfinite(truth.depth)[..., None], truth.points, np.nan)).float()
    normals = torch.from_numpy(np.where(truth.mask[..., None], truth.normals, 0.0)).float()
    ground = np.isfinite(truth.depth) & ~truth.mask
    true = torch.from_numpy(truth.albedo).float()
    missing = torch.from_numpy(ground)[..., None]
    known = torch.where(missing, 0.0, true)
    found = with_lit_ground(scene, check_ground(scene), grid_of((BALL,), 2.0), points, normals, known).numpy()
    shade = ground & (ndimage.maximum_filter(truth.visibility[0], 5) == 0)
    light = ground & (ndimage.minimum_filter(truth.visibility[0], 5) == 1)
    assert shade.sum() > 50 and not found[shade].any()
    assert np.median(np.abs(found / truth.albedo - 1)[light]) < 0.02
    assert np.array_equal(found[truth.mask], truth.albedo[truth.mask].astype(np.float32))
