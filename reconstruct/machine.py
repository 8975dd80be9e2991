"""What this machine can do, and how long a run takes on it: measured with a short loop of shadow rays."""

import importlib.util
import os
import platform
import shutil
import time
from pathlib import Path

import psutil
import torch

from reconstruct import kernels
from reconstruct.grid import SdfGrid
from reconstruct.march import thread_count, visibility
from reconstruct.presets import preset

LOOP_S = 1.0  # of measuring: the rate then repeats within some 10 % on an idle machine
LOOP_NODES, LOOP_RAYS = 64, 20_000  # a ball in a grid like the solver's second one
SHARPNESS = 10.0  # NeuS s per voxel, the middle of the solver's range
# Seconds a run spent per ray of its schedule, times the rate of this loop on the same machine; and what does not scale
# with rays (reading 36 photos, lights, mesh, report).
COST_PER_RAY, OTHER_S = 3.0, 25.0
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
OPTIONAL = {"OpenEXR": "OpenEXR depth of reference scenes", "playwright": "browser tests"}
GIB = 2**30


def rays_per_second() -> float:
    """Shadow rays per second through a ball on a small grid, all cores; the compiled kernel is warmed up before."""
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


def run_seconds(name: str, rate: float) -> float:
    """About how long a run of 36 photos with this preset takes at so many rays per second, by the clock."""
    config = preset(name, 0)[1]
    rays = config.rays * sum(level.iterations for level in config.levels)
    return OTHER_S + COST_PER_RAY * rays / rate


def describe_machine() -> list[str]:
    """The report of `shadowgraph doctor`, line by line."""
    memory = psutil.virtual_memory()
    lines = [
        f"Python {platform.python_version()} on {platform.platform()}",
        f"cores: {os.cpu_count()}, used: {thread_count()}",
        f"memory: {memory.total / GIB:.1f} GiB, free {memory.available / GIB:.1f} GiB (a standard run needs up to 4)",
        f"torch {torch.__version__}: {_accelerator()}",
        f"numba kernels: {_cache_state()}",
        f"browser for the tests: {next(filter(shutil.which, BROWSERS), 'none found; those tests are skipped')}",
    ]
    for module, use in OPTIONAL.items():
        has = importlib.util.find_spec(module) is not None
        lines.append(f"{module} ({use}): {'installed' if has else 'not installed, optional'}")
    rate = rays_per_second()
    lines.append(f"speed: {rate / 1e6:.2f} million shadow rays per second")
    times = ", ".join(f"{name} {run_seconds(name, rate):.0f} s" for name in ("draft", "standard", "fine"))
    lines.append(f"a run of 36 photos will take about: {times} (if nothing else runs)")
    return lines


def _accelerator() -> str:
    if torch.cuda.is_available():
        return f"{torch.cuda.get_device_name()} found; this version computes on the CPU"
    return "no GPU found, none needed"


def _cache_state() -> str:
    folder = Path(os.environ.get("NUMBA_CACHE_DIR") or Path(kernels.__file__).parent / "__pycache__")
    count = len(list(folder.rglob("*.nbi"))) if folder.is_dir() else 0
    if count:
        return f"compiled and kept in {folder}"
    return f"not compiled yet; the first run compiles them ({folder})"
