"""One pixel's normal from few photos."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from reconstruct.shading.joint_normals import Picture, fit_together
from reconstruct.shading.noise import Noise
from reconstruct.shading.normal_fit import Pixels, Prior, fit_normals, normals_of_lit

ALBEDO = 0.4
LIGHTS = normalize(
    torch.tensor([[0.7, -0.6, 0.6], [-0.6, -0.6, 0.6], [0.1, 0.8, 0.6], [-0.9, 0.1, 0.5], [0.5, -0.1, 0.9]]), dim=-1
)


@pytest.fixture
def normals():
    rng = np.random.default_rng(0)
    around = np.array([0.05, -0.8, 0.6]) + rng.normal(scale=0.25, size=(200, 3))
    return normalize(torch.from_numpy(around).float(), dim=-1)


def seen(normals, lit):
    """What the lights numbered in `lit` show of the normals; the others' light is blocked."""
    n = len(normals)
    value = ALBEDO * (normals @ LIGHTS.T).clamp(min=0)
    value[:, [k for k in range(len(LIGHTS)) if k not in lit]] = 0
    usable = torch.ones(n, len(LIGHTS), dtype=torch.bool)
    towards = LIGHTS.expand(n, -1, -1).contiguous()
    return Pixels(value, usable, towards, torch.ones(n, len(LIGHTS)), torch.zeros(len(LIGHTS)), 0.0, Noise(1e-3, 0.01))


def tilted(normals, degrees):
    torch.manual_seed(1)
    aside = torch.linalg.cross(normals, torch.randn_like(normals))
    aside = normalize(aside, dim=-1)
    angle = np.radians(degrees)
    return np.cos(angle) * normals + np.sin(angle) * aside


def degrees(found, true):
    """Angles between vectors, of which the true ones have length 1."""
    return torch.rad2deg((normalize(found, dim=-1) * true).sum(-1).clamp(-1, 1).acos())


def test_two_photos_and_the_neighbours_albedo_give_a_normal(normals):
    prior = Prior(torch.full((len(normals),), ALBEDO), tilted(normals, 20))
    solved, _ = fit_normals(seen(normals, (0, 1)), prior)
    assert degrees(solved, normals).median() < 9


def test_a_dark_photo_is_a_surface_turned_away_rather_than_the_shadow_of_something_else():
    rng = np.random.default_rng(1)
    around = torch.from_numpy(np.array([0.0, -0.2, 0.8]) + rng.normal(scale=0.9, size=(3000, 3))).float()
    normals = normalize(around, dim=-1)
    lit_by = (normals @ LIGHTS.T > 0.05).sum(1)  # of five lights; from the others the surface is turned away
    turned = normals[(lit_by == 2) & (normals[:, 2] > 0.05)]
    assert len(turned) > 150
    prior = Prior(torch.full((len(turned),), 0.7 * ALBEDO), None)
    solved, _ = fit_normals(seen(turned, range(5)), prior)  # nothing blocks any light
    assert (degrees(solved, turned) > 20).float().mean() < 0.1


# --- from light and shadow alone -------------------------------------------------------------------------------------


RAY = torch.tensor([0.0, 0.6, -0.8])


def sky(count: int, lowest: float = 15, highest: float = 75) -> torch.Tensor:
    """Directions over the sky, degrees high."""
    share = (torch.arange(count) + 0.5) / count
    sine = np.sin(np.radians(lowest)) * (1 - share) + np.sin(np.radians(highest)) * share
    azimuth, level = torch.arange(count) * 2.4, (1 - sine**2).sqrt()
    return torch.stack([level * azimuth.cos(), level * azimuth.sin(), sine], -1)


def seen_normals(count: int) -> torch.Tensor:
    """Normals of a ball that the camera sees and that face up."""
    drawn = torch.randn(20 * count, 3, generator=torch.Generator().manual_seed(0))
    drawn = normalize(drawn, dim=-1)
    return drawn[(drawn @ RAY < -0.2) & (drawn[:, 2] > 0.2)][:count]


def read(true: torch.Tensor, towards: torch.Tensor, lit: torch.Tensor, free: torch.Tensor):
    n = len(true)
    everywhere = towards[:, None].expand(-1, n, 3)
    return normals_of_lit(lit, torch.ones(lit.shape), everywhere, free, RAY.expand(n, 3))


@pytest.mark.parametrize(("count", "error"), [(20, 10), (40, 7)])
def test_normals_of_a_ball_without_cast_shadows(count, error):
    true, towards = seen_normals(300), sky(count)
    lit = (towards @ true.T > 0).float()
    normal, confidence = read(true, towards, lit, torch.ones(lit.shape))
    sure = confidence > 0.5
    assert sure.float().mean() > 0.3
    assert degrees(normal, true)[sure].mean() < error


def test_a_cast_shadow_behind_known_matter_turns_no_normal_and_few_lights_leave_it_open():
    true, towards = torch.tensor([[0.0, 0, 1]]), sky(40)
    lit = torch.ones(40, 1)
    lit[towards[:, 0] > 0.5] = 0  # something stands on that side
    turned, _ = read(true, towards, lit, torch.ones(40, 1))
    kept, _ = read(true, towards, lit, lit)
    assert degrees(kept, true)[0] < 16 < 24 < degrees(turned, true)[0]
    towards = sky(4, 40, 50)
    _, confidence = read(torch.tensor([[0.0, 0, 1]]), towards, torch.ones(4, 1), torch.ones(4, 1))
    assert confidence[0] < 0.1


# --- all pixels together ---------------------------------------------------------------------------------------------


PALE, DARK = 0.7, 0.3


@pytest.fixture(scope="module")
def ball():
    """A ball seen from the origin along z, light from five sides; half of it is dark and red."""
    v, u = torch.meshgrid(torch.linspace(-0.22, 0.22, 36), torch.linspace(-0.22, 0.22, 36), indexing="ij")
    rays = normalize(torch.stack([u, v, torch.ones_like(u)], -1), dim=-1)
    centre = torch.tensor([0.0, 0.0, 10.0])
    along = rays @ centre
    inside = 4.0 - (100.0 - along**2)  # radius 2
    places = torch.nonzero(inside > 0.1)
    row, column = places.unbind(1)
    points = (along - inside.clamp(min=0).sqrt())[row, column, None] * rays[row, column]
    normals = normalize(points - centre, dim=-1)
    azimuth = torch.arange(5) * (2 * torch.pi / 5) + 0.3
    lights = normalize(torch.stack([azimuth.cos(), azimuth.sin(), torch.full((5,), -0.2)], -1), dim=-1)
    is_dark = points[:, 0] > 0.4
    albedo = torch.where(is_dark, DARK, PALE)
    noise = 0.002 * torch.randn(len(points), 5, generator=torch.Generator().manual_seed(0))
    value = albedo[:, None] * (normals @ lights.T).clamp(min=0) + noise
    every = torch.ones_like(value)
    pixels = Pixels(
        value=value,
        usable=every.bool(),
        towards=lights.expand(len(points), 5, 3).contiguous(),
        strength=every,
        bounce=torch.zeros(5),
        ambient=0.0,
        noise=Noise(0.002, 0.005),
    )
    grey, red = torch.full((3,), 1 / 3), torch.tensor([0.6, 0.2, 0.2])
    return Picture(places, rays, torch.where(is_dark[:, None], red, grey)), pixels, normals, albedo


def test_neighbours_tell_the_normals_that_two_lit_photos_leave_open(ball):
    picture, pixels, normals, albedo = ball
    lit = (normals @ pixels.towards[0].T > 0).sum(1)
    assert float((lit < 4).float().mean()) > 0.5  # few photos light a pixel
    alone, _ = fit_normals(pixels, Prior(torch.full((len(normals),), 0.5), None))
    together, weight = fit_together(picture, pixels, None, alone)
    assert degrees(together, normals).mean() < 0.6 * degrees(alone, normals).mean()
    two = lit == 2
    assert degrees(together, normals)[two].mean() < 12 < 30 < degrees(alone, normals)[two].mean()
    off = (together.norm(dim=-1) / albedo).log().abs()
    assert float(off.median()) < 0.1  # the dark half is no slope
    assert float((weight.sum(1) - lit).abs().median()) < 0.5


def test_the_surface_so_far_decides_what_no_photo_lights(ball):
    picture, pixels, normals, _ = ball
    dark = normals[:, 1] > 0.3
    unseen = replace(pixels, usable=pixels.usable & ~dark[:, None])
    alone, _ = fit_normals(unseen)
    start = torch.where(dark[:, None], torch.tensor([0.0, 0.0, -0.5]), alone)
    guided, _ = fit_together(picture, unseen, normals, start)
    assert degrees(guided, normals)[dark].mean() < 5


def of_few_photos(ball, value, colour=None):
    """Normals and albedos of all pixels together from such values, begun from each pixel's own."""
    picture, pixels, normals, _ = ball
    pixels = replace(pixels, value=value)
    alone, _ = fit_normals(pixels, Prior(torch.full((len(normals),), 0.5), None))
    found, _ = fit_together(picture if colour is None else replace(picture, colour=colour), pixels, None, alone)
    return degrees(found, normals), found.norm(dim=-1)


def test_edges_of_colour_are_edges_between_materials(ball):
    picture, pixels, normals, _ = ball
    row, column = picture.places.unbind(1)
    is_red = (row // 4 + column // 4) % 2 == 1
    albedo = torch.where(is_red, DARK, PALE)
    noise = 0.002 * torch.randn(pixels.value.shape, generator=torch.Generator().manual_seed(1))
    value = albedo[:, None] * (normals @ pixels.towards[0].T).clamp(min=0) + noise
    colour = torch.where(is_red[:, None], torch.tensor([0.6, 0.2, 0.2]), torch.full((3,), 1 / 3))
    off, found = of_few_photos(ball, value, colour)
    assert off.mean() < 6.5
    assert float((found / albedo).log().abs().mean()) < 0.15  # 0.4 if neighbours of any colour were of one material
