"""Marching and scattering by plain torch against the compiled kernels, and whole solves by either."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from synthetic import BALL, Look, render
from torch import Tensor

from capture.errors import ReconstructionError
from reconstruct.config import FitConfig, Level
from reconstruct.labels.labels import assemble_labels
from reconstruct.labels.supervision import Supervision, supervise
from reconstruct.scene import Scene
from reconstruct.sdf import kernels
from reconstruct.sdf.blocks import overlapping, pack
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.level_set import BAND, LevelSet
from reconstruct.solve import solver
from reconstruct.solve.backend import solver_device
from reconstruct.solve.operators import RayPasses
from reconstruct.solve.ray_operators import RayOperators
from reconstruct.solve.solver import fit
from reconstruct.torch_sdf import rays as torch_march
from reconstruct.torch_sdf.ray_field import ray_field
from reconstruct.torch_sdf.rays import MISSED, extrema, first_surface, towards
from reconstruct.torch_sdf.volume import Volume

NODES = 40
EYE = np.array([18.0, -40.0, 60.0])
SMALL = FitConfig(levels=(Level(20, 3, (0.5, 0.4), 3, 5e-4), Level(32, 11, (0.4, 0.1), 2)))
pytestmark = pytest.mark.usefixtures("one_thread", "hull_start")
DEVICES = [
    "cpu",
    pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no CUDA device")),
]


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


@pytest.fixture(scope="module")
def setting() -> tuple[LevelSet, Scene, Callable[[], Supervision]]:
    """A ball that is not where its shadows say, its scene, and fresh labels with every kind of ray."""
    scene, truth = render((BALL,), Look(width=60, height=45, n_lights=8, with_shadow=True, with_mask=True))
    scene = replace(scene, rgb=None)
    labels = assemble_labels(scene, None, None)
    on_object = torch.from_numpy(truth.mask).float()
    normals = torch.from_numpy(truth.normals).float()
    labels = replace(labels, normals=normals, normal_confidence=on_object)
    spacing, origin = 2.5, np.array([-48.0, -48.0, -6.0])
    axis = np.arange(NODES) * spacing
    nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1) + origin
    phi = (np.linalg.norm(nodes - np.array([5.0, -3.0, 42.0]), axis=-1) - 0.95 * BALL.radius) / spacing
    return LevelSet(phi.astype(np.float32), origin, spacing), scene, lambda: supervise(scene, labels)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("width", [0.0, 0.05])
def test_first_surfaces_and_silhouettes_are_the_kernels(device, width):
    phi, (_, ends) = two_balls(), random_ends(4000)
    views = (ends - EYE) / np.linalg.norm(ends - EYE, axis=1, keepdims=True)
    far = np.where(np.arange(4000) % 2, 1e9, 75.0)
    expected = [np.empty(4000) for _ in range(3)]
    kernels.camera_pass(overlapping(pack(phi)), EYE, views, far, width, *expected, 0, 4000)
    volume = Volume.of(torch.from_numpy(phi).double().to(device))
    eye, rays, stop = (torch.from_numpy(x).to(device) for x in (EYE, views, far))
    found = first_surface(volume, eye.expand_as(rays), rays, stop, width)
    assert 0.05 < (expected[0] < MISSED).mean() < 0.5
    for mine, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(mine.cpu().numpy(), theirs, atol=1e-6)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("real", "tolerance"), [(torch.float64, 1e-9), (torch.float32, 1e-4)])
def test_transmittance_is_the_kernels(device, real, tolerance):
    phi, (starts, ends) = two_balls(), random_ends(4000)
    lights = np.concatenate([ends, np.ones((4000, 1))], 1)
    lights[::3, 3] = 0
    for sharpness in (4.0, 25.0):
        expected = np.empty(4000)
        kernels.transmittances(overlapping(pack(phi)), starts, lights, sharpness, expected, 0, 4000)
        points, targets = (torch.from_numpy(x).to(device, real) for x in (starts, lights))
        found = extrema(Volume.of(torch.from_numpy(phi).to(device, real)), points, *towards(points, targets), sharpness)
        np.testing.assert_allclose(found.log_transmittance.exp().cpu().numpy(), expected, atol=tolerance)


def cosine(found: np.ndarray, expected: np.ndarray) -> float:
    """Between two arrays as vectors."""
    return float((found * expected).sum() / np.linalg.norm(found) / np.linalg.norm(expected))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("sharpness", [4.0, 25.0])
def test_marching_and_scattering_are_the_kernels(device, sharpness):
    starts, ends = random_ends(4000)
    rng, sums, found = np.random.default_rng(1), [], []
    jitter, upstream = rng.uniform(0.5, 1, 4000), rng.normal(0, 1, 4000)
    ends[::3] /= np.linalg.norm(ends[::3], axis=1, keepdims=True)  # directions
    lights = np.concatenate([ends, (np.arange(4000) % 3 > 0)[:, None], np.zeros((4000, 1))], 1)
    for where in (None, torch.device(device)):
        surface = LevelSet(two_balls(), np.zeros(3), 1.0, device=where)
        rays, there = ray_field(surface), surface.values.device
        given = [torch.from_numpy(x).to(there) for x in (starts, lights, jitter, upstream)]
        points, towards = (x.to(rays.real).requires_grad_() for x in given[:2])
        seen, least = rays.march(points, towards, sharpness, given[2].to(rays.real))
        least = torch.where(least < BAND - 1e-3, least, 0.0)  # at the band, rounding decides
        loss = torch.where(seen > -20, seen, 0.0) + least + rays.sample(points.detach())
        (loss @ given[3].to(rays.real)).backward()
        assert points.grad is not None and towards.grad is not None
        found.append([x.detach().cpu().numpy() for x in (seen.exp(), least, points.grad, towards.grad)])
        sums.append(surface.sums())
    assert 0.05 < (found[0][0] < 0.5).mean() < 0.9 and np.abs(found[0][1]).max() > 0.1
    for mine, theirs in zip((*found[1], *sums[1]), (*found[0], *sums[0]), strict=True):
        apart = np.abs(mine - theirs)
        assert np.abs(theirs).max() > 0.1
        assert np.quantile(apart, 0.99) < 1e-3 * np.abs(theirs).max()
        assert cosine(mine, theirs) > 0.999


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("sharpness", [4.0, 25.0])
def test_an_iteration_has_the_kernels_errors_and_gradients(setting, device, sharpness):
    # A ray along a ridge or a valley of the SDF has its extremum anywhere on it, and where the SDF falls by next to
    # nothing, 1 / (1 - T) is large: float32 knows neither well. That is a ray or two, on some tens of nodes.
    state, scene, labels = setting
    every = [state.on(torch.device(device)), state.on(None)]
    by_torch, by_kernels = (RayPasses(surface, scene, labels(), SMALL) for surface in every)
    tolerance = 1e-5 if device == "cpu" else 5e-3
    for passes, surface in zip((by_torch, by_kernels), every, strict=True):
        surface.forget()
        passes.look(surface.grid(), scene, 0, sharpness, 1.0)
    for iteration in range(2):
        found, expected = by_torch(iteration, sharpness), by_kernels(iteration, sharpness)
        assert found == pytest.approx(expected, rel=1e-4)
        assert min(expected.values()) > 1e-3
    np.testing.assert_allclose(by_torch.shadow_rays.misses, by_kernels.shadow_rays.misses, atol=tolerance)
    np.testing.assert_array_equal(by_torch.shadow_rays.places, by_kernels.shadow_rays.places)
    assert (by_torch.rays.wrong != by_kernels.rays.wrong).mean() < 1e-3
    for mine, theirs in zip(*(surface.sums() for surface in every), strict=True):
        apart = np.abs(mine - theirs)
        assert cosine(mine.astype(np.float64), theirs.astype(np.float64)) > 0.9999
        assert np.quantile(apart[theirs != 0], 0.98) < 1e-4 * np.abs(theirs).max()
    mine, theirs = (x.operators.light_gradient() for x in (by_torch, by_kernels))
    assert cosine(mine, theirs) > 0.99
    np.testing.assert_allclose(mine, theirs, atol=10 * tolerance * np.abs(theirs).max())
    before = [surface.phi for surface in every]
    for surface in every:
        surface.step(3, 0.4, 5e-4, 0.25, 4, 0.1)
        surface.redistance()
    assert np.abs(every[1].phi - before[1]).max() > 0.1
    assert np.abs(every[0].phi - every[1].phi).mean() < 1e-4


@pytest.fixture(scope="module")
def shadows() -> Scene:
    """The shadow pictures of a ball."""
    scene, _ = render((BALL,), Look(width=60, height=45, with_shadow=True, with_mask=True, n_lights=8))
    return replace(scene, rgb=None)


@pytest.fixture(scope="module")
def by_kernels(shadows) -> SdfGrid:
    """The surface of a solve by the kernels."""
    return fit(shadows, SMALL, lambda **_: None).grid


@pytest.fixture(scope="module")
def by_torch(shadows) -> Callable[[str], SdfGrid]:
    """The surface of a solve by torch on a device."""

    @cache
    def solved(device: str) -> SdfGrid:
        return fit(shadows, SMALL, lambda **_: None, device=torch.device(device)).grid

    return solved


@pytest.mark.parametrize("device", DEVICES)
def test_a_solve_by_torch_ends_where_the_kernels_end_also_after_a_stop(
    device, shadows, by_torch, by_kernels, tmp_path, monkeypatch
):
    monkeypatch.setattr(solver, "SAVE_EVERY_S", 0.0)
    where, file = torch.device(device), tmp_path / "checkpoint.safetensors"

    def stopping(*, stage: str, done: int, **_: object) -> None:
        if stage == "solve" and done == 14:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(shadows, SMALL, stopping, file, where)
    resumed = fit(shadows, SMALL, lambda **_: None, file, where)
    assert torch.equal(resumed.grid.values, by_torch(device).values)
    apart = (resumed.grid.values - by_kernels.values).abs() / by_kernels.spacing
    assert apart.mean() < 0.01 and apart.max() < 0.5


@pytest.mark.parametrize("ways", [(None, torch.device("cpu")), (torch.device("cpu"), None)])
def test_a_stopped_solve_is_continued_by_the_other_backend(ways, shadows, by_kernels, tmp_path, monkeypatch):
    monkeypatch.setattr(solver, "SAVE_EVERY_S", 0.0)
    file, steps = tmp_path / "checkpoint.safetensors", []

    def stopping(*, stage: str, done: int, **_: object) -> None:
        if stage == "solve":
            steps.append(done)
        if steps[-1:] == [14] and len(steps) == 14:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(shadows, SMALL, stopping, file, ways[0])
    found = fit(shadows, SMALL, stopping, file, ways[1])
    assert steps[14] == 14  # from the last rest on, not from the beginning
    apart = (found.grid.values - by_kernels.values).abs() / by_kernels.spacing
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
    straight, said = by_torch("cpu"), []
    had = without_memory(monkeypatch, range(6, 8))
    found = fit(shadows, SMALL, lambda *, message, **_: said.append(message), device=torch.device("cpu"))
    assert torch.equal(found.grid.values, straight.values)
    assert had[0] == torch_march.MOST_RAYS and had[-1] == torch_march.MOST_RAYS // 4
    assert [text for text in said if "memory" in text] == [
        "no memory for 131072 rays at once: back to the last checkpoint, with 65536",
        "no memory for 65536 rays at once: back to the last checkpoint, with 32768",
    ]


def test_a_device_without_memory_for_the_fewest_rays_is_refused_with_what_to_do(shadows, monkeypatch):
    had = without_memory(monkeypatch, range(100))
    with pytest.raises(ReconstructionError, match=r"no memory for 2048 rays at once.*--preset draft or --device cpu"):
        fit(shadows, SMALL, lambda **_: None, device=torch.device("cpu"))
    assert had == [2**power for power in range(17, 10, -1)]


def test_the_device_is_chosen_by_name():
    assert solver_device("cpu") is None
    assert solver_device("torch-cpu") == torch.device("cpu")
    assert solver_device("auto") is None  # also beside a card, until one has passed benchmarks/run_gpu.py
    level_set = LevelSet(two_balls(), np.zeros(3), 1.0)
    assert level_set.on(None) is level_set
    assert level_set.on(torch.device("cpu")).device == torch.device("cpu")


@pytest.mark.skipif(not torch.backends.mps.is_available(), reason="torch sees no MPS device")
def test_sampling_on_mps_needs_no_float64():
    phi = torch.from_numpy(two_balls())
    points = torch.rand(100, 3) * NODES
    found: Tensor = Volume.of(phi.to("mps")).sample(points.to("mps"))
    torch.testing.assert_close(found.cpu(), Volume.of(phi).sample(points), atol=1e-4, rtol=1e-4)
