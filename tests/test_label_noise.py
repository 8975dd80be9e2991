"""Shadow pictures with wrong pixels: the solve forgives a few."""

from dataclasses import replace

import pytest
import torch
from synthetic import BALL, Look, render
from test_solver import SMALL, Listener, depth_error

from reconstruct.scene import Scene
from reconstruct.solve.solver import fit

PIXEL = 2.1  # mm at the ball


def noisy(clean: Scene) -> Scene:
    flipped = torch.rand(clean.shadow.shape, generator=torch.Generator().manual_seed(1)) < 0.02
    return replace(clean, shadow=torch.where(flipped, 1 - clean.shadow, clean.shadow))


@pytest.mark.slow  # 9 s: two solves; the hull is tested above
def test_two_per_cent_of_flipped_labels_double_the_depth_error_or_cost_less_than_half_a_pixel():
    scene, truth = render((BALL,), Look(with_shadow=True, with_mask=True, n_lights=24))
    clean = replace(scene, rgb=None)
    errors = [depth_error(fit(each, SMALL, Listener()), scene, truth) for each in (clean, noisy(clean))]
    assert errors[1] < max(2 * errors[0], 0.5 * PIXEL)
