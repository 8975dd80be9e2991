"""Marching and scattering by plain torch against the compiled kernels, and whole solves by either."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from synthetic import BALL, Look, render
from torch import Tensor

from capture.errors import ReconstructionError
from reconstruct.config import FitConfig, Level
from reconstruct.scene import Scene
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.level_set import BAND, LevelSet
from reconstruct.solve import solver
from reconstruct.solve.backend import solver_device
from reconstruct.solve.ray_operators import RayOperators
from reconstruct.solve.solver import fit
from reconstruct.torch_sdf import march
from reconstruct.torch_sdf import rays as torch_march
from reconstruct.torch_sdf.march import RecordedBlock, State, Volume
from reconstruct.torch_sdf.ray_field import ray_field

NODES = 40
TORCH = torch.device("cpu")
SMALL = FitConfig(levels=(Level(20, 3, (0.5, 0.4), 3, 5e-4), Level(32, 11, (0.4, 0.1), 2)))
pytestmark = pytest.mark.usefixtures("one_thread", "hull_start")


def two_balls() -> np.ndarray:
    """SDF of two balls that almost touch, voxels, cut off as a level set is."""
    axis = np.arange(NODES)
    nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    far = np.linalg.norm(nodes - [13.0, 18, 17], axis=-1) - 8
    near = np.linalg.norm(nodes - [28.0, 23, 24], axis=-1) - 7.3
    return np.clip(np.minimum(far, near), -6, 6).astype(np.float32)


def random_ends(count: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return rng.uniform(-5, NODES + 5, (count, 3)), rng.uniform(-5, NODES + 5, (count, 3))


def cosine(found: np.ndarray, expected: np.ndarray) -> float:
    return float((found * expected).sum() / np.linalg.norm(found) / np.linalg.norm(expected))


@pytest.mark.parametrize("sharpness", [4.0, 25.0])
def test_marching_and_scattering_are_the_kernels(sharpness):
    starts, ends = random_ends(4000)
    rng, sums, found = np.random.default_rng(1), [], []
    jitter, upstream = rng.uniform(0.5, 1, 4000), rng.normal(0, 1, 4000)
    ends[::3] /= np.linalg.norm(ends[::3], axis=1, keepdims=True)  # directions
    lights = np.concatenate([ends, (np.arange(4000) % 3 > 0)[:, None]], 1)
    for device in (None, TORCH):
        surface = LevelSet(two_balls(), np.zeros(3), 1.0, device=device)
        rays, given = ray_field(surface), [torch.from_numpy(x) for x in (starts, lights, jitter, upstream)]
        points = given[0].requires_grad_()
        seen, least = rays.march(points, given[1], sharpness, given[2])
        least = torch.where(least < BAND - 1e-3, least, 0.0)  # at the band, rounding decides
        loss = torch.where(seen > -20, seen, 0.0) + least + rays.sample(points.detach())
        (loss @ given[3]).backward()
        assert points.grad is not None
        found.append([x.detach().numpy() for x in (seen.exp(), least, points.grad)])
        sums.append(surface.sums())
    assert 0.05 < (found[0][0] < 0.5).mean() < 0.9 and np.abs(found[0][1]).max() > 0.1
    for mine, theirs in zip((*found[1], *sums[1]), (*found[0], *sums[0]), strict=True):
        apart = np.abs(mine - theirs)
        assert np.abs(theirs).max() > 0.1
        assert np.quantile(apart, 0.99) < 1e-3 * np.abs(theirs).max()
        assert cosine(mine, theirs) > 0.999


@pytest.fixture(scope="module")
def shadows() -> Scene:
    scene, _ = render((BALL,), Look(width=60, height=45, with_shadow=True, with_mask=True, n_lights=8))
    return replace(scene, rgb=None)


@pytest.fixture(scope="module")
def by_kernels(shadows) -> SdfGrid:
    return fit(shadows, SMALL, lambda **_: None).grid


@pytest.fixture(scope="module")
def by_torch(shadows) -> SdfGrid:
    return fit(shadows, SMALL, lambda **_: None, device=TORCH).grid


@pytest.mark.parametrize("ways", [(TORCH, TORCH), (None, TORCH)])
def test_a_stopped_solve_is_continued_by_either_and_ends_where_the_kernels_end(
    ways, shadows, by_kernels, by_torch, tmp_path, monkeypatch
):
    monkeypatch.setattr(solver, "SAVE_EVERY_S", 0.0)
    file, steps = tmp_path / "checkpoint.safetensors", []

    def stopping(*, stage: str, done: int, **_: object) -> None:
        if stage == "solve":
            steps.append(done)
        if steps[-1:] == [14] and len(steps) == 14:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(shadows, SMALL, stopping, file, ways[0])
    found = fit(shadows, SMALL, stopping, file, ways[1]).grid
    assert steps[14] == 14  # from the last rest on, not from the beginning
    assert ways != (TORCH, TORCH) or torch.equal(found.values, by_torch.values)
    apart = (found.values - by_kernels.values).abs() / by_kernels.spacing
    assert apart.mean() < 0.01 and apart.max() < 0.5


def without_memory(monkeypatch, calls: range) -> list[int]:
    """Those calls of the shadow pass find no memory; the rays at once of every call are listed."""
    had, whole = [], RayOperators._shadow_batch
    monkeypatch.setattr(torch_march.BATCHES, "rays", torch_march.MOST_RAYS)

    def short(self, *args):
        had.append(torch_march.BATCHES.rays)
        if len(had) - 1 in calls:
            whole(self, *args)  # what it has left by then must not count
            raise torch.OutOfMemoryError
        return whole(self, *args)

    monkeypatch.setattr(RayOperators, "_shadow_batch", short)
    return had


def test_where_memory_is_short_fewer_rays_go_at_once_and_the_result_is_the_same(shadows, by_torch, monkeypatch):
    said = []
    had = without_memory(monkeypatch, range(6, 8))
    found = fit(shadows, SMALL, lambda *, message, **_: said.append(message), device=TORCH)
    assert torch.equal(found.grid.values, by_torch.values)
    assert had[0] == torch_march.MOST_RAYS and had[-1] == torch_march.MOST_RAYS // 4
    assert [text for text in said if "memory" in text] == [
        "no memory for 131072 rays at once: back to the last checkpoint, with 65536",
        "no memory for 65536 rays at once: back to the last checkpoint, with 32768",
    ]


def test_a_device_without_memory_for_the_fewest_rays_is_refused_with_what_to_do(shadows, monkeypatch):
    had = without_memory(monkeypatch, range(100))
    with pytest.raises(ReconstructionError, match=r"no memory for 2048 rays at once.*on the CPU, or choose a coarser"):
        fit(shadows, SMALL, lambda **_: None, device=TORCH)
    assert had == [2**power for power in range(17, 10, -1)]


def test_the_device_is_chosen_by_name():
    assert solver_device("cpu") is None
    assert solver_device("torch-cpu") == TORCH
    assert solver_device("auto") is None  # also beside a card, until one has passed benchmarks/run_gpu.py
    level_set = LevelSet(two_balls(), np.zeros(3), 1.0)
    assert level_set.on(None) is level_set
    assert level_set.on(TORCH).device == TORCH


# --- blocks of samples in memory of their own ------------------------------------------------------------------------


SIDE, RAYS = 24, 700


def setting(margin: float, seed: int, count: int) -> tuple[Volume, State, Tensor]:
    """A ball whose centre the seed moves, rays through it that end where they like, and their margin."""
    random = torch.Generator().manual_seed(seed)
    axis = torch.arange(SIDE, dtype=torch.float32)
    nodes = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    phi = (nodes - 10 - torch.rand(3, generator=random)).norm(dim=-1) - 6
    starts, aims = (torch.rand(count, 3, generator=random) * (SIDE - 1) for _ in range(2))
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
