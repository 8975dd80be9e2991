"""Coverage of outline pixels, from photos whose mixture is known."""

import numpy as np
import torch

from reconstruct.labels.matting import coverage_at_edges

N_PHOTOS = 12


def mixed(covered: torch.Tensor, inside: torch.Tensor, outside: torch.Tensor) -> torch.Tensor:
    return inside[:, None, None] * covered + outside[:, None, None] * (1 - covered)


def square() -> tuple[torch.Tensor, torch.Tensor]:
    """Coverage of a square whose right column is covered by 0.3, and N_PHOTOS photos of it."""
    rng = np.random.default_rng(1)
    covered = torch.zeros(30, 30)
    covered[8:22, 8:21] = 1
    covered[8:22, 21] = 0.3
    values = torch.tensor(rng.random((2, N_PHOTOS)), dtype=torch.float32)
    return covered, mixed(covered, *values)


def test_edge_pixels_are_unmixed_to_their_coverage():
    covered, photos = square()
    mask = coverage_at_edges(photos[..., None], covered > 0.5)
    assert torch.allclose(mask[12:18], covered[12:18], atol=1e-4)


def test_an_outline_drawn_a_pixel_too_wide_moves_back():
    covered, photos = square()
    wide = torch.nn.functional.max_pool2d((covered > 0.5).float()[None], 3, 1, 1)[0] > 0
    mask = coverage_at_edges(photos[..., None], wide)
    assert torch.equal(mask[12:18] > 0.5, covered[12:18] > 0.5)
