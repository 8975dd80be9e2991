"""Measure this machine's speed with a short loop of shadow rays, and predict from it how long a run takes."""

import importlib.util
import os
import platform
import shutil
import time
from dataclasses import replace
from pathlib import Path

import psutil
import torch

from capture.decode.sandbox import confinement
from reconstruct.run.presets import preset, shortened
from reconstruct.run_folder.cost import memory_room
from reconstruct.sdf import kernels
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.rays import thread_count, visibility
from reconstruct.solve.backend import backend_name, solver_device
from reconstruct.solve.solver import FitConfig
from reconstruct.source.memory import predicted_memory

LOOP_S = 1.0  # of measuring: the rate then repeats within some 10 % on an idle machine
LOOP_NODES, LOOP_RAYS = 64, 20_000  # a ball in a grid like the solver's second one
SHARPNESS = 10.0  # NeuS s per voxel, the middle of the solver's range
# What one iteration costs, in rays of this loop: per ray, and per squared number of nodes, for only those near the
# surface are kept. Levels of 96, 160 and 320 nodes took 0.09, 0.15 and 0.41 CPU s, a ray of the loop 0.63 microseconds.
COST_PER_RAY, COST_PER_NODE = 2.0, 5.5
OTHER_SHARE = 1.5  # of the iterations' time: labels, photos, lights, mesh and report of some 36 photos, by the same run
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
OPTIONAL = {"playwright": "browser tests"}
GIB = 2**30
FEWEST_SHARE = 0.25


def rays_per_second() -> float:
    """Measure shadow rays per second through a ball on a small grid, on all cores, after a warm-up of the kernel."""
    axis = torch.linspace(-1.5, 1.5, LOOP_NODES)
    nodes = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    spacing = float(axis[1] - axis[0])
    grid = SdfGrid(torch.linalg.vector_norm(nodes, dim=-1) - 1, torch.full((3,), -1.5), spacing)
    turn = torch.linspace(0, 6.28, LOOP_RAYS)
    points = torch.stack([1.3 * turn.cos(), 1.3 * turn.sin(), -0.9 + 0.2 * turn], -1)
    lights = torch.tensor([3.0, 1.0, 4.0, 1.0]).expand(LOOP_RAYS, 4).contiguous()
    visibility(grid, points[:100], lights[:100], SHARPNESS / spacing)
    start, done = time.perf_counter(), 0
    while time.perf_counter() - start < LOOP_S:
        visibility(grid, points, lights, SHARPNESS / spacing)
        done += LOOP_RAYS
    return done / (time.perf_counter() - start)


def solve_seconds(config: FitConfig, rate: float) -> float:
    """Estimate the wall-clock time (s) of a schedule's iterations at `rate` rays per second."""
    work = [level.iterations * (COST_PER_RAY * config.rays + COST_PER_NODE * level.nodes**2) for level in config.levels]
    return sum(work) / rate


def within_budget(config: FitConfig, seconds: float) -> FitConfig:
    """Return the schedule, shortened where needed to fit into about so many seconds on this machine.

    With less than a quarter of its iterations a level brings nothing, so the finest level is dropped first.
    """
    rate = rays_per_second()
    while True:
        share = seconds / (OTHER_SHARE * solve_seconds(config, rate))
        if share >= FEWEST_SHARE or len(config.levels) == 1:
            return config if share >= 1 else shortened(config, share)
        config = replace(config, levels=config.levels[:-1])


def predicted_runs(photos: int, width: int, height: int) -> list[dict[str, str | float | bool]]:
    """Return for each preset of the default solver its `seconds` and `bytes` on this machine, and whether these `fit`.

    Args:
        photos: their number, of width x height px.
    """
    rate, room = rays_per_second(), memory_room()
    found: list[dict[str, str | float | bool]] = []
    for name in ("draft", "standard", "fine"):
        needed = predicted_memory(photos, width, height, name)
        seconds = OTHER_SHARE * solve_seconds(preset(name, 0)[1], rate)
        found.append({"name": name, "seconds": seconds, "bytes": float(needed), "fits": needed <= room})
    return found


def describe_machine() -> list[str]:
    """Return the lines of the report of `shadowgraph doctor`."""
    memory = psutil.virtual_memory()
    lines = [
        f"Python {platform.python_version()} on {platform.platform()}",
        f"cores: {os.cpu_count()}, used: {thread_count()}",
        f"memory: {memory.total / GIB:.1f} GiB, free {memory.available / GIB:.1f} GiB",
        f"memory of a run of 36 photos of 12 megapixels: {_memory_of_presets()}",
        f"photos are decoded: {confinement()}",
        f"torch {torch.__version__}: {_accelerator()}",
        f"the surface is fitted by: {backend_name(solver_device('auto'))}",
        f"numba kernels: {_cache_state()}",
        f"browser for the tests: {next(filter(shutil.which, BROWSERS), 'none found; those tests are skipped')}",
    ]
    for module, use in OPTIONAL.items():
        has = importlib.util.find_spec(module) is not None
        lines.append(f"{module} ({use}): {'installed' if has else 'not installed, optional'}")
    rate = rays_per_second()
    lines.append(f"speed: {rate / 1e6:.2f} million shadow rays per second")
    seconds = {name: OTHER_SHARE * solve_seconds(preset(name, 0)[1], rate) for name in ("draft", "standard", "fine")}
    times = ", ".join(f"{name} {value:.0f} s" for name, value in seconds.items())
    lines.append(f"a run of 36 photos will take about: {times} (if nothing else runs)")
    return lines


def _memory_of_presets() -> str:
    needs = {name: predicted_memory(36, 4032, 3024, name) / GIB for name in ("draft", "standard", "fine")}
    return ", ".join(f"{name} {value:.1f} GiB" for name, value in needs.items())


def _accelerator() -> str:
    if torch.cuda.is_available():
        return f"{torch.cuda.get_device_name()} found"
    return "no GPU found, none needed"


def kernels_are_compiled() -> bool:
    """Return True if an earlier run left compiled kernels; otherwise the next one spends a while compiling them."""
    folder = _cache_folder()
    return folder.is_dir() and any(folder.rglob("*.nbi"))


def _cache_folder() -> Path:
    return Path(os.environ.get("NUMBA_CACHE_DIR") or Path(kernels.__file__).parent / "__pycache__")


def _cache_state() -> str:
    if kernels_are_compiled():
        return f"compiled and kept in {_cache_folder()}"
    return f"not compiled yet; the first run compiles them ({_cache_folder()})"
