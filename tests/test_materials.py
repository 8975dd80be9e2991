"""Truth: integrals over the hemisphere by brute force, and materials whose answer is known."""

import math

import pytest
import torch

from reconstruct.appearance.brdf import LOBES, MATERIALS, Material, conserving, metal_rough, reflectance, specular

UP = torch.tensor([0.0, 0.0, 1.0])


def hemisphere(rows: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Directions over the upper half, and the solid angle of each."""
    theta = 0.5 * math.pi * (torch.arange(rows) + 0.5) / rows
    phi = 0.5 * math.pi * (torch.arange(4 * rows) + 0.5) / rows
    side = theta.sin()[:, None]
    x, y = side * phi.cos(), side * phi.sin()
    patch = (0.5 * math.pi / rows) ** 2 * side.expand_as(x)
    return torch.stack([x, y, theta.cos()[:, None].expand_as(x)], -1).reshape(-1, 3), patch.reshape(-1, 1)


def looking(degrees: float) -> torch.Tensor:
    angle = math.radians(degrees)
    return torch.tensor([math.sin(angle), 0.0, math.cos(angle)])


def coefficients(roughness: float, mirrored: float) -> torch.Tensor:
    return Material(None, (mirrored, mirrored, mirrored), roughness).coefficients()


@pytest.mark.parametrize("roughness", [0.65, 0.4, 0.25])
@pytest.mark.parametrize("degrees", [0.0, 30.0, 60.0, 80.0])
def test_reflectance_is_the_integral_of_the_lobes_over_all_lights(roughness, degrees):
    towards, patch = hemisphere(200)
    eye, each = looking(degrees), coefficients(roughness, 0.3)
    summed = (specular(each, UP, towards, eye) * towards[:, 2:] * patch / math.pi).sum(0)
    assert torch.allclose(summed, reflectance(each[None], eye[None, 2])[0], rtol=0.01)


def test_no_conserving_material_reflects_more_than_all_light():
    generator = torch.Generator().manual_seed(0)
    albedo = torch.rand(500, 3, generator=generator) * 1.5
    lobes = torch.rand(500, LOBES, 3, generator=generator) * 20
    cosine = torch.rand(500, generator=generator)
    albedo, lobes = conserving(albedo, lobes, cosine)
    assert (albedo + reflectance(lobes, cosine)).max() < 1.02
    assert albedo.min() >= 0


def test_gold_becomes_metal_and_plastic_does_not():
    gold, plastic = MATERIALS["gold"], MATERIALS["plastic"]
    as_metal = metal_rough(torch.zeros(2, 3), gold.coefficients().expand(2, -1, -1))
    assert as_metal.metallic > 0.99
    assert torch.allclose(as_metal.base, torch.tensor(gold.mirrored), atol=0.01)
    assert as_metal.roughness == pytest.approx(gold.roughness, rel=0.02)
    as_plastic = metal_rough(torch.full((2, 3), 0.5), plastic.coefficients().expand(2, -1, -1))
    assert as_plastic.metallic < 0.01
    assert torch.allclose(as_plastic.base, torch.tensor(0.5 / 0.96), atol=1e-3)
    assert as_plastic.roughness == pytest.approx(plastic.roughness, rel=0.02)


def test_without_lobes_a_surface_is_rough_and_keeps_its_colour():
    matt = metal_rough(torch.tensor([[0.2, 0.4, 0.6]]), torch.zeros(1, LOBES, 3))
    assert (matt.metallic, matt.roughness) == (0.0, 1.0)
    assert torch.allclose(matt.base, torch.tensor([[0.2, 0.4, 0.6]]))


def test_a_material_that_mirrors_more_than_all_light_is_refused():
    with pytest.raises(ValueError, match="lie in"):
        Material(None, (1.2, 1.0, 1.0))


@pytest.mark.parametrize("roughness", [0.2, 0.12])
@pytest.mark.parametrize("degrees", [20.0, 45.0])
def test_lights_six_degrees_apart_are_mirrored_as_the_even_light_they_stand_for(roughness, degrees):
    """Lobes of 0.12 are narrower than the gaps: unless they are widened, hardly any light meets them."""
    rows = 16
    step = 0.5 * math.pi / rows
    towards, weights = [], []
    for theta in (step * (i + 0.5) for i in range(rows)):
        count = round(2 * math.pi * math.sin(theta) / step)
        phi = 2 * math.pi * (torch.arange(count) + 0.5) / count
        level = torch.full((count,), math.cos(theta))
        towards.append(torch.stack([math.sin(theta) * phi.cos(), math.sin(theta) * phi.sin(), level], -1))
        ring = math.cos(theta - step / 2) - math.cos(theta + step / 2)
        weights.append(level * 2 * ring / count)  # solid angle * cosine / pi
    eye, each = looking(degrees), coefficients(roughness, 0.3)
    summed = (specular(each, UP, torch.cat(towards), eye, blur=step) * torch.cat(weights)[:, None]).sum(0)
    assert torch.allclose(summed, reflectance(each[None], eye[None, 2])[0], rtol=0.05)
