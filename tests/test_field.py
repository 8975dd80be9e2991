"""Every representation of a surface answers the same questions, and starts as it should."""

import pytest
import torch

from reconstruct.appearance.brdf import LOBES
from reconstruct.sdf.grid import SdfGrid
from reconstruct.shadowneus.field import GridField, HashField, HashLevels, Materials, Network, NeuralField, specular

REACH, RADIUS, GROUND = 2.0, 1.0, -0.7
SMALL = Network(width=32, depth=3, skip=2, frequencies=3, features=8, material_width=16, material_depth=2)


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def places(count: int = 200) -> torch.Tensor:
    return 3.2 * torch.rand(count, 3, generator=generator()) - 1.6


def grid_field() -> GridField:
    return GridField(33, REACH, RADIUS, GROUND, generator())


def hash_field() -> HashField:
    return HashField(HashLevels(coarsest=8, finest=32, levels=4, rows=2**10), REACH, RADIUS, GROUND, generator())


def neural_field() -> NeuralField:
    return NeuralField(SMALL, RADIUS, generator())


TRAINABLE = {"grid": grid_field, "hash": hash_field, "neural": neural_field}


def test_the_paper_s_network_starts_as_a_ball_and_has_its_sizes():
    field = NeuralField(Network(), RADIUS, generator())
    points = places(500)
    points = points[points.norm(dim=-1) > 0.3]
    distance = points.norm(dim=-1)
    with torch.no_grad():
        sdf = field.sdf(points)
    # The initialisation is a ball in the mean over networks: of one with width 256, to a sixth of the radius.
    assert (sdf[distance < 0.75] < 0).all() and (sdf[distance > 1.4] > 0).all()
    shapes = [tuple(layer.direction.shape) for layer in field.layers]
    assert shapes == [(256, 39), *[(256, 256)] * 2, (217, 256), *[(256, 256)] * 4, (257, 256)]
    materials = Materials(256, Network(), generator())
    albedo, coefficients = materials(points[:5], points[:5], field.features(points[:5]))
    assert albedo.shape == (5, 3) and coefficients.shape == (5, LOBES, 3)
    assert (albedo >= 0).all() and (coefficients >= 0).all()


@pytest.mark.parametrize("name", TRAINABLE)
def test_the_gradient_is_that_of_the_sdf(name):
    field = TRAINABLE[name]()
    points = places(300)
    step = 0.02
    numeric = torch.stack(
        [(field.sdf(points + o) - field.sdf(points - o)) / (2 * step) for o in step * torch.eye(3)], -1
    )
    difference = (field.gradient(points) - numeric).norm(dim=-1)
    assert difference.median() < 0.02  # grids have kinks, so not at every point


def test_the_trainable_grid_reads_like_the_solved_one():
    field, points = grid_field(), 1.3 * places()
    values = field.values.detach().reshape(33, 33, 33)
    same = SdfGrid(values, torch.full((3,), -REACH), 2 * REACH / 32)
    torch.testing.assert_close(field.sdf(points).detach(), same.sdf(points), atol=1e-5, rtol=1e-5)


def test_highlights_add_their_coefficients_at_the_mirror_direction_and_fade_beside_it():
    coefficients = torch.rand(1, LOBES, 3, generator=generator())
    normal = torch.tensor([[0.0, 0.0, 1.0]])
    towards, view = torch.tensor([[0.6, 0.0, 0.8]]), torch.tensor([[0.6, 0.0, -0.8]])
    torch.testing.assert_close(specular(coefficients, normal, towards, view), coefficients.sum(1))
    beside = specular(coefficients, normal, torch.tensor([[0.0, 0.6, 0.8]]), view)
    cosine = torch.nn.functional.normalize(torch.tensor([-0.6, 0.6, 1.6]), dim=0)[2]
    lobes = torch.exp(torch.exp(torch.arange(2.0, 11.0)) * (cosine - 1))
    torch.testing.assert_close(beside, (coefficients * lobes[:, None]).sum(1))
