"""Blocks of samples in memory of their own, as a card replays them: the same samples to the bit as ray by ray."""

import pytest
import torch
from torch import Tensor

from reconstruct.torch_sdf import march
from reconstruct.torch_sdf.march import RecordedBlock, State, Stride, marched
from reconstruct.torch_sdf.volume import Volume

NODES, RAYS = 24, 700
DEVICES = [
    "cpu",
    pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no CUDA device")),
]
SURFACES, EXTREMA = (1.0, 0.02), (2.5, None)


def setting(device: str, numbers: tuple[float, float | None], seed: int, count: int) -> tuple[Volume, State, Stride]:
    """A ball whose centre the seed moves, rays through it that end where they like, and their stride."""
    random = torch.Generator().manual_seed(seed)
    axis = torch.arange(NODES, dtype=torch.float32)
    nodes = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    phi = (nodes - 10 - torch.rand(3, generator=random)).norm(dim=-1) - 6
    starts, aims = (torch.rand(count, 3, generator=random) * (NODES - 1) for _ in range(2))
    directions = torch.nn.functional.normalize(aims - starts, dim=1)
    end, factor = (aims - starts).norm(dim=1), 0.5 + 0.5 * torch.rand(count, generator=random)
    volume = Volume.of(phi.to(device))
    first = volume.sample(starts.to(device))
    rays = State(*(x.to(device) for x in (starts, directions, end, torch.zeros(count))), first, factor.to(device))
    return volume, rays, Stride(*(None if x is None else torch.tensor(x, device=device) for x in numbers))


def joined(rows: list[tuple[Tensor, Tensor]]) -> tuple[Tensor, ...]:
    return tuple(torch.cat(part) for part in zip(*rows, strict=True))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("numbers", [SURFACES, EXTREMA])
def test_a_block_used_again_gives_what_its_operations_give_one_by_one(device, numbers):
    block = RecordedBlock(*setting(device, numbers, 0, RAYS)[::2], 1024)
    if device == "cuda":
        block.record()
    for seed, count in ((1, RAYS), (2, 1024), (3, 5)):  # another volume, and other rays, more and fewer
        volume, rays, stride = setting(device, numbers, seed, count)
        found, expected = joined(block.march(volume, rays, stride)), joined(march._one_by_one(volume, rays, stride))
        assert len(expected[0]) > march.BLOCK and not expected[0].isnan().any()
        for mine, theirs in zip(found, expected, strict=True):
            assert len(mine) >= len(theirs)
            assert torch.equal(mine, torch.cat([theirs, theirs[-1:].expand(len(mine) - len(theirs), -1)]))


def test_the_cpu_records_nothing():
    volume, rays, stride = setting("cpu", SURFACES, 0, RAYS)
    marched(volume, rays, stride)
    assert not march._blocks


@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no CUDA device")
def test_a_card_that_records_nothing_marches_all_the_same(monkeypatch):
    def refuse(self):
        raise RuntimeError("no graphs here")

    volume, rays, stride = setting("cuda", SURFACES, 0, RAYS)
    march.forget_blocks()
    recorded = marched(volume, rays, stride)
    march.forget_blocks()
    monkeypatch.setattr(RecordedBlock, "record", refuse)
    for mine, theirs in zip(marched(volume, rays, stride), recorded, strict=True):
        assert torch.equal(mine, theirs[: len(mine)])
    assert list(march._blocks.values()) == [None]
    march.forget_blocks()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no CUDA device")
def test_few_recorded_blocks_are_kept():
    march.forget_blocks()
    for power in range(march.KEPT + 3):
        volume, rays, stride = setting("cuda", EXTREMA if power % 2 else SURFACES, 0, march.FEWEST << power // 2)
        marched(volume, rays, stride)
    assert len(march._blocks) == march.KEPT
    march.forget_blocks()
