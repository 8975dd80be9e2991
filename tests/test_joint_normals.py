"""Normals of all pixels together, against a ball of two materials."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from reconstruct.shading.joint_normals import Picture, fit_together
from reconstruct.shading.noise import Noise
from reconstruct.shading.normal_fit import Pixels, Prior, fit_normals

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


def angles(found, true):
    return np.degrees(torch.arccos((normalize(found, dim=-1) * true).sum(-1).clamp(-1, 1)).numpy())


def test_neighbours_tell_the_normals_that_two_lit_photos_leave_open(ball):
    picture, pixels, normals, albedo = ball
    lit = (normals @ pixels.towards[0].T > 0).sum(1)
    assert float((lit < 4).float().mean()) > 0.5  # few photos light a pixel
    alone, _ = fit_normals(pixels, Prior(torch.full((len(normals),), 0.5), None))
    together, weight = fit_together(picture, pixels, None, alone)
    assert angles(together, normals).mean() < 0.6 * angles(alone, normals).mean()
    two = (lit == 2).numpy()
    assert angles(together, normals)[two].mean() < 12 < 30 < angles(alone, normals)[two].mean()
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
    assert angles(guided, normals)[dark.numpy()].mean() < 5


def of_few_photos(ball, value, colour=None):
    """Normals and albedos of all pixels together from such values, begun from each pixel's own."""
    picture, pixels, normals, _ = ball
    pixels = replace(pixels, value=value)
    alone, _ = fit_normals(pixels, Prior(torch.full((len(normals),), 0.5), None))
    found, _ = fit_together(picture if colour is None else replace(picture, colour=colour), pixels, None, alone)
    return angles(found, normals), found.norm(dim=-1)


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
