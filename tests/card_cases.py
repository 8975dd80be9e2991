"""What --device cuda does, on a graphics card or on the pretended one.

test_pretend_card.py runs this in a process of its own, which names the card: CARD is "cuda", else it is pretended.
"""

import os
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace

import pytest
import torch
from synthetic import BALL, Look, render
from test_render import SHARPNESS, ball, grey_rays
from test_trainer import TINY

from reconstruct.config import FitConfig, Level
from reconstruct.fields import SolvedScene
from reconstruct.scene import Scene
from reconstruct.sdf.grid import SdfGrid
from reconstruct.shadowneus.trainer import train
from reconstruct.solve.solver import fit
from reconstruct.torch_sdf.autograd import transmittance

COARSE = FitConfig(levels=(Level(16, 2, (0.5, 0.4), 3, 5e-4), Level(24, 2, (0.4, 0.1), 2)), votes=1)
COLOUR = Look(width=24, height=18, n_lights=14)  # so many that each pixel has its own normal: fewer take minutes here
SHADOW = replace(COLOUR, with_shadow=True, with_mask=True)
CPU = torch.device("cpu")
if os.environ.get("CARD") == "cuda":
    CARD, there = torch.device("cuda"), nullcontext
else:
    from pretend_card import CARD
    from pretend_card import pretended_card as there
pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(autouse=True)
def card():
    with there():
        yield


def seen(look: Look) -> Scene:
    """A ball in colour photos, or in shadow pictures where the look has them."""
    scene, _ = render((BALL,), look)
    return replace(scene, rgb=None) if look.with_shadow else scene


def end_alike(found: SolvedScene, expected: SolvedScene) -> None:
    """Two surfaces but for rounding."""
    apart = (found.grid.values - expected.grid.values).abs() / expected.grid.spacing
    assert apart.mean() < 0.01 and apart.max() < 0.5  # voxels


@pytest.mark.parametrize(
    "act",
    [
        lambda x: x + torch.ones(3),
        lambda x: torch.ones(3).add_(x),
        lambda x: torch.rand(3, generator=torch.Generator(), device=x.device),
        lambda x: x.numpy(),
    ],
)
def test_it_refuses_what_a_card_refuses(act: Callable[[torch.Tensor], object]):
    with pytest.raises((RuntimeError, TypeError)):
        act(torch.ones(3, device=CARD))


@pytest.mark.parametrize("look", [replace(SHADOW, kind="directional"), COLOUR])
def test_a_solve_ends_as_on_the_cpu(look):
    scene = seen(look)
    end_alike(*(fit(scene, COARSE, lambda **_: None, device=place) for place in (CARD, CPU)))


@pytest.mark.parametrize(("field", "look"), [("neural", COLOUR), ("hash", SHADOW), ("grid", SHADOW)])
def test_a_training_ends_as_on_the_cpu(field, look):
    scene, config = seen(look), replace(TINY, field=field, start_steps=2, iterations=3)
    end_alike(*(train(scene, config, lambda **_: None, None, place) for place in (CARD, CPU)))


def test_visibility_has_the_same_gradients():
    starts, lights = grey_rays(40, "point")
    found = []
    for place in (CPU, CARD):
        values, origin = (x.to(place) for x in (ball().values, ball().origin))
        grid = SdfGrid(values.requires_grad_(), origin, ball().spacing)
        transmittance(grid, starts.to(place), lights.to(place), SHARPNESS).sum().backward()
        assert values.grad is not None and values.grad.device.type == place.type
        found.append(values.grad.cpu())
    torch.testing.assert_close(found[1], found[0])
