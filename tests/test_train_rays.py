"""Camera and shadow rays of the trainer on a ball, against geometry; its losses where the truth is known."""

import math

import pytest
import torch
from torch import Tensor, nn

from reconstruct.appearance.brdf import LOBES
from reconstruct.sdf.grid import SdfGrid
from reconstruct.shadowneus.camera_rays import (
    CameraRays,
    ShadowRays,
    expected_depth,
    find_hits,
    light_left,
    light_left_telescoped,
    place_samples,
)
from reconstruct.shadowneus.config import ShadowSamples, TrainConfig
from reconstruct.shadowneus.field import GridField, HashField, HashLevels, Materials, Network, NeuralField, specular
from reconstruct.shadowneus.train_step import bound_loss, contain_loss
from reconstruct.shadowneus.trainer import learning_factor
from reconstruct.torch_sdf import equations as render

RADIUS, GROUND, BOUND = 0.6, -0.6, 2.0
EYE = torch.tensor([0.0, -5.0, 2.0])
PIXEL = 0.01


class Ball(nn.Module):
    """A ball that touches the ground, exact, with a radius that can be trained."""

    def __init__(self, with_ground: bool = True):
        super().__init__()
        self.radius = nn.Parameter(torch.tensor(RADIUS))
        self.ground = GROUND if with_ground else -9.0

    def sdf(self, points: Tensor) -> Tensor:
        return torch.minimum(points.norm(dim=-1) - self.radius, points[:, 2] - self.ground)

    def gradient(self, points: Tensor) -> Tensor:
        return nn.functional.normalize(points, dim=-1)

    def features(self, points: Tensor) -> Tensor:
        return points.new_zeros(len(points), 0)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def camera_rays(count: int = 400) -> CameraRays:
    targets = 2.4 * torch.rand(count, 3, generator=generator()) - 1.2
    directions = nn.functional.normalize(targets - EYE, dim=-1)
    t = (GROUND - EYE[2]) / directions[:, 2]
    return CameraRays(EYE, directions, torch.where(t > 0, t, torch.inf), PIXEL)


def distance_beside(rays: CameraRays) -> Tensor:
    """How far each ray passes the ball's surface, outside positive."""
    return torch.linalg.cross(EYE.expand_as(rays.directions), rays.directions).norm(dim=-1) - RADIUS


def test_a_ray_within_half_a_pixel_of_the_silhouette_is_a_boundary_ray_with_its_share():
    rays = camera_rays(4000)
    hits = find_hits(Ball(), rays, BOUND, 256, with_edges=True)
    beside = distance_beside(rays)
    half = 0.5 * PIXEL * (-(EYE * rays.directions).sum(-1))  # of a pixel's width at the ray's nearest point
    is_edge = hits.edge_t.isfinite()
    sure = (beside.abs() - half).abs() > 2e-3
    assert is_edge.sum() > 20
    assert torch.equal(is_edge[sure], (beside.abs() < half)[sure])
    # Behind a silhouette is the ground, not the ball.
    assert (rays.at(hits.t)[is_edge, 2] - GROUND).abs().max() < 1e-3
    minimum = Ball().sdf(rays.at(hits.edge_t)[is_edge])
    share = render.area_ratio(minimum, PIXEL * hits.edge_t[is_edge])
    torch.testing.assert_close(share, (0.5 - beside / (2 * half))[is_edge].clamp(0, 1), atol=0.02, rtol=0.02)


def test_the_expected_depth_tends_to_the_intersection_away_from_the_silhouette():
    rays = camera_rays()
    t = expected_depth(Ball(with_ground=False), rays, BOUND, 256, torch.tensor(400.0))
    hits = find_hits(Ball(with_ground=False), rays, BOUND, 256, with_edges=False)
    clear = (distance_beside(rays).abs() > 0.1) & rays.ground_t.isfinite()
    torch.testing.assert_close(t[clear], hits.t[clear], atol=0.02, rtol=0.0)  # a march step is 0.016


def ground_rays(count: int = 300) -> ShadowRays:
    """From the ground towards a light, the ball in some of their ways."""
    flat = 2.4 * torch.rand(count, 2, generator=generator(1)) - 1.2
    flat = flat[flat.norm(dim=-1) > 0.2]
    starts = torch.cat([flat, torch.full((len(flat), 1), GROUND)], 1)
    offset = torch.tensor([1.5, 1.0, 3.0]) - starts
    lengths = offset.norm(dim=-1)
    up = torch.tensor([0.0, 0.0, 1.0]).expand_as(starts)
    return ShadowRays(starts, offset / lengths[:, None], up, lengths)


def is_blocked(rays: ShadowRays) -> Tensor:
    """How far inside the ball each ray passes, positive where it is in the way."""
    nearest = torch.linalg.cross(rays.starts, rays.towards).norm(dim=-1)
    ahead = -(rays.starts * rays.towards).sum(-1) > 0
    return torch.where(ahead, RADIUS - nearest, -1.0)


@pytest.mark.parametrize("way", ["sampled", "telescoped"])
def test_sharp_visibility_is_the_geometric_shadow(way):
    field, rays, sharpness = Ball(), ground_rays(), torch.tensor(300.0)
    t, sdf = place_samples(field, rays, BOUND, ShadowSamples(), generator())
    assert (t[:, 1:] >= t[:, :-1]).all()
    if way == "sampled":
        seen = light_left(field, rays, t, sharpness, 1.0)
    else:
        seen = light_left_telescoped(field, rays, t, sdf, sharpness)
    depth = is_blocked(rays)
    clear = depth.abs() > 0.03  # 1/s is 0.003
    assert ((seen < 0.5) == (depth > 0))[clear].all()


def test_sampled_and_closed_form_agree_in_value_and_gradient():
    field, rays, sharpness = Ball(), ground_rays(), torch.tensor(20.0)
    t, sdf = place_samples(field, rays, BOUND, ShadowSamples(), generator())
    out = []
    for seen in (light_left(field, rays, t, sharpness, 1.0), light_left_telescoped(field, rays, t, sdf, sharpness)):
        (gradient,) = torch.autograd.grad(seen.sum(), field.radius)
        out.append((seen.detach(), gradient))
    torch.testing.assert_close(out[0][0], out[1][0], atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(out[0][1], out[1][1], atol=1e-3, rtol=1e-3)


def test_early_annealing_gives_a_gradient_to_rays_that_leave_the_surface():
    field = Ball(with_ground=False)
    up, flat = torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([[0.98, 0.0, 0.2]])
    rays = ShadowRays(RADIUS * up, nn.functional.normalize(flat, dim=-1), up, torch.tensor([5.0]))
    t, _ = place_samples(field, rays, BOUND, ShadowSamples(), generator())
    for anneal, blocked in ((1.0, False), (0.0, True)):
        seen = light_left(field, rays, t, torch.tensor(20.0), anneal)
        assert (float(seen.detach()) < 0.95) == blocked


def test_the_known_ground_and_an_object_inside_the_sphere_cost_nothing():
    field, rays = Ball(), camera_rays()
    hits = find_hits(field, rays, BOUND, 256, with_edges=False)
    on_ball = distance_beside(rays) < 0
    contain, _ = contain_loss(field, rays, hits, on_ball, BOUND, generator())
    bound, wrong = bound_loss(field, 500, BOUND, GROUND, generator(), torch.device("cpu"))
    assert float(contain.detach()) < 1e-6 and float(bound.detach()) == 0 and not len(wrong)


def test_the_learning_rate_warms_up_and_falls_to_its_last_value():
    config = TrainConfig()
    assert learning_factor(0, config) == 1 / 5000
    assert learning_factor(5000, config) == 1.0
    assert math.isclose(learning_factor(150_000, config), 0.05)
    middle = learning_factor(77_500, config)
    assert math.isclose(middle, 0.525)


# --- representations of a surface ------------------------------------------------------------------------------------


REACH, START, LEVEL = 2.0, 1.0, -0.7
SMALL = Network(width=32, depth=3, skip=2, frequencies=3, features=8, material_width=16, material_depth=2)


def places(count: int = 200) -> torch.Tensor:
    return 3.2 * torch.rand(count, 3, generator=generator()) - 1.6


LEVELS = HashLevels(coarsest=8, finest=32, levels=4, rows=2**10)
TRAINABLE = {
    "grid": lambda: GridField(33, REACH, START, LEVEL, generator()),
    "hash": lambda: HashField(LEVELS, REACH, START, LEVEL, generator()),
    "neural": lambda: NeuralField(SMALL, START, generator()),
}


def test_the_paper_s_network_starts_as_a_ball_and_has_its_sizes():
    field = NeuralField(Network(), START, generator())
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
    field, points = TRAINABLE["grid"](), 1.3 * places()
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
