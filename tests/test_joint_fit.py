"""Normals and albedos of pixels whose lobes are known: noiseless samples give them back, shadows are outliers."""

import pytest
import torch
from torch.nn.functional import normalize

from reconstruct.appearance.brdf import LOBES, specular
from reconstruct.appearance.joint_fit import fit_normals
from reconstruct.appearance.lobe_fit import Samples

PIXELS, PHOTOS = 300, 24
LIT = 0.02  # of what the tilted start is off, without noise


def samples(is_glossy: bool) -> tuple[Samples, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Noiseless samples with tilted normals to begin from, and their lobes, true normals and albedos."""
    torch.manual_seed(0)
    up, sideways = torch.tensor([0.0, 0.0, 1.0]), torch.tensor([1.0, 1.0, 0.0])
    true = normalize(0.4 * sideways * torch.randn(PIXELS, 3) + up, dim=-1)
    eye = normalize(0.1 * torch.randn(PIXELS, 3) + up, dim=-1)
    lights = normalize(0.7 * sideways * torch.randn(PHOTOS, 3) + up, dim=-1)
    towards = normalize(lights + 0.02 * torch.randn(PIXELS, 1, 3), dim=-1)
    lobes = torch.zeros(LOBES, 3)
    if is_glossy:
        lobes[1], lobes[3] = torch.tensor([0.2, 0.15, 0.1]), 0.1
    strength, indirect = torch.ones(PIXELS, PHOTOS, 3), torch.full((PIXELS, PHOTOS, 3), 0.02)
    albedo = 0.2 + 0.5 * torch.rand(PIXELS)
    cosine = (towards * true[:, None]).sum(-1, keepdim=True).clamp(min=0)
    mirrored = specular(lobes, true[:, None], towards, eye[:, None])
    value = (albedo[:, None, None] + mirrored) * cosine * strength + albedo[:, None, None] * indirect
    start = normalize(true + 0.1 * torch.randn(PIXELS, 3), dim=-1)
    return Samples(value, torch.ones(PIXELS, PHOTOS), strength, indirect, towards, eye, start), lobes, true, albedo


def angles(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Radians between unit vectors."""
    return 2 * ((a - b).norm(dim=-1) / 2).clamp(max=1).asin()


@pytest.mark.parametrize("is_glossy", [False, True])
def test_noiseless_samples_give_back_normals_and_albedos(is_glossy):
    given, lobes, true, albedo = samples(is_glossy)
    normals, found, cost = fit_normals(given, lobes, torch.full((PIXELS, PHOTOS), 0.002))
    assert angles(normals, true).quantile(0.95) < LIT * angles(given.normals, true).median()
    assert ((found - albedo) / albedo).abs().median() < 0.001 and cost.median() < 1e-3
