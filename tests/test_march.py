"""Blocks of samples in memory of their own, as a card replays them: the same samples to the bit as ray by ray."""

import pytest
import torch
from torch import Tensor

from reconstruct.torch_sdf import march
from reconstruct.torch_sdf.march import RecordedBlock, State, Volume

NODES, RAYS = 24, 700


def setting(margin: float, seed: int, count: int) -> tuple[Volume, State, Tensor]:
    """A ball whose centre the seed moves, rays through it that end where they like, and their margin."""
    random = torch.Generator().manual_seed(seed)
    axis = torch.arange(NODES, dtype=torch.float32)
    nodes = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    phi = (nodes - 10 - torch.rand(3, generator=random)).norm(dim=-1) - 6
    starts, aims = (torch.rand(count, 3, generator=random) * (NODES - 1) for _ in range(2))
    directions = torch.nn.functional.normalize(aims - starts, dim=1)
    end, factor = (aims - starts).norm(dim=1), 0.5 + 0.5 * torch.rand(count, generator=random)
    volume = Volume.of(phi)
    rays = State(starts, directions, end, torch.zeros(count), volume.sample(starts), factor)
    return volume, rays, torch.tensor(margin)


def joined(rows: list[tuple[Tensor, Tensor]]) -> tuple[Tensor, ...]:
    return tuple(torch.cat(part) for part in zip(*rows, strict=True))


@pytest.mark.parametrize("margin", [1.2, 2.5])
def test_a_block_used_again_gives_what_its_operations_give_one_by_one(margin):
    block = RecordedBlock(*setting(margin, 0, RAYS)[::2], 1024)
    for seed, count in ((1, RAYS), (2, 1024), (3, 5)):  # another volume, and other rays, more and fewer
        volume, rays, reach = setting(margin, seed, count)
        found, expected = joined(block.march(volume, rays, reach)), joined(march._one_by_one(volume, rays, reach))
        assert len(expected[0]) > march.BLOCK and not expected[0].isnan().any()
        for mine, theirs in zip(found, expected, strict=True):
            assert len(mine) >= len(theirs)
            assert torch.equal(mine, torch.cat([theirs, theirs[-1:].expand(len(mine) - len(theirs), -1)]))
