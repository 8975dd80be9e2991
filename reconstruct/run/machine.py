"""Measure this machine's speed with a short loop of shadow rays, and plan from it how long each part of a run takes."""

import math
import os
import platform
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import psutil
import torch

from capture.decode.formats import read_size
from capture.decode.sandbox import confinement
from capture.errors import UserError
from reconstruct.run.presets import preset, shortened
from reconstruct.run_folder.forecast import duration_text, memory_room
from reconstruct.sdf import kernels
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.rays import thread_count, visibility
from reconstruct.solve.backend import backend_name, solver_device
from reconstruct.solve.solver import FitConfig
from reconstruct.source.photos import predicted_memory
from reconstruct.source.source import LONG_SIDES, RunOptions, Source

LOOP_S = 0.5  # of measuring: the rate then repeats within some 10 % on an idle machine
LOOP_NODES, LOOP_RAYS = 64, 20_000  # a ball in a grid like the solver's second one
SHARPNESS = 10.0  # NeuS s per voxel, the middle of the solver's range
# What one iteration costs, in rays of this loop: per ray, and per squared number of nodes, for only those near the
# surface are kept. Levels of 96, 160 and 320 nodes took 0.09, 0.15 and 0.41 CPU s, a ray of the loop 0.63 microseconds.
COST_PER_RAY, COST_PER_NODE = 2.0, 5.5
# What the other stages cost, in CPU seconds where a ray of the loop takes USUAL_RAY_S: examples/spot, 36 photos of 0.8
# megapixels, draft and standard. A photo of 12 megapixels takes .12 s more to decode.
USUAL_RAY_S = 0.63e-6
READING_S, DECODING_S, LIGHT_S, JUDGING_S = 0.09, 0.01, 0.15, 0.02  # a photo; decoding: and a megapixel
HULL_S, LABELS_S = 3.5, 0.5e-6  # of a run; a pixel of the solver's pictures, and a photo
MESH_S, DETAIL_S, REPORT_S = 4e-5, 0.03, 1.5  # a squared node; a photo and a megapixel; of a run
COMPILING_S = 18.0  # of the first run on a machine
GIB = 2**30
FEWEST_SHARE = 0.25
SIDES_RATIO = 0.75  # of a photo's sides
CLIP_MEGAPIXELS = 2.0  # of a frame, 1920 x 1080


class Speed(NamedTuple):
    """What this machine takes for one shadow ray on all its cores: CPU seconds, and seconds of the clock."""

    cpu_s: float
    clock_s: float

    def seconds(self, cpu_s: float, is_shared: bool) -> float:
        """Return the seconds of the clock that work takes here.

        Args:
            cpu_s: what it takes where a ray takes USUAL_RAY_S.
            is_shared: it runs on all cores; else on one, which other programs slow down as they do here.
        """
        at_a_time = self.clock_s / self.cpu_s
        return cpu_s * self.cpu_s / USUAL_RAY_S * (at_a_time if is_shared else max(at_a_time, 1.0))


def measure_speed() -> Speed:
    """Measure shadow rays through a ball on a small grid, on all cores, after a warm-up of the kernel."""
    axis = torch.linspace(-1.5, 1.5, LOOP_NODES)
    nodes = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    spacing = float(axis[1] - axis[0])
    grid = SdfGrid(torch.linalg.vector_norm(nodes, dim=-1) - 1, torch.full((3,), -1.5), spacing)
    turn = torch.linspace(0, 6.28, LOOP_RAYS)
    points = torch.stack([1.3 * turn.cos(), 1.3 * turn.sin(), -0.9 + 0.2 * turn], -1)
    lights = torch.tensor([3.0, 1.0, 4.0, 1.0]).expand(LOOP_RAYS, 4).contiguous()
    visibility(grid, points[:100], lights[:100], SHARPNESS / spacing)
    start, cpu_start, done = time.perf_counter(), time.process_time(), 0
    while time.perf_counter() - start < LOOP_S:
        visibility(grid, points, lights, SHARPNESS / spacing)
        done += LOOP_RAYS
    clock = (time.perf_counter() - start) / done
    return Speed(max(time.process_time() - cpu_start, 1e-3) / done, clock)


class Work(NamedTuple):
    """What a run has to look at: photos of so many megapixels, and their longer side (px) as the solver sees them."""

    photos: int
    megapixels: float
    long_side: int
    has_detail: bool = False


def work_of(source: Source, options: RunOptions, has_detail: bool = False) -> Work:
    """Return what a run has to look at."""
    photos, megapixels = source.photos(), CLIP_MEGAPIXELS
    with suppress(UserError, OSError):  # a clip's frames have no header
        megapixels = math.prod(read_size(photos[0])) / 1e6
    return Work(len(photos), megapixels, LONG_SIDES[options.preset], has_detail)


def planned_seconds(config: FitConfig, speed: Speed, work: Work) -> dict[str, float | dict[int, float]]:
    """Return the seconds that each stage of a run will take here; of `solve`, up to the last step of each level."""
    solve, steps, rays = {}, 0, 0.0
    for level in config.levels:
        steps += level.iterations
        rays += level.iterations * (COST_PER_RAY * config.rays + COST_PER_NODE * level.nodes**2)
        solve[steps] = speed.seconds(rays * USUAL_RAY_S, True)
    compiling = 0.0 if kernels_are_compiled() else COMPILING_S
    hull = HULL_S + LABELS_S * work.photos * work.long_side**2 * SIDES_RATIO + compiling
    plan: dict[str, float | dict[int, float]] = {
        "capture": speed.seconds(work.photos * (READING_S + DECODING_S * work.megapixels), False),
        "calibrate": speed.seconds(work.photos * LIGHT_S, False),
        "check": speed.seconds(work.photos * JUDGING_S, False),
        "hull": speed.seconds(hull, True),
        "solve": solve,
        "mesh": speed.seconds(MESH_S * config.levels[-1].nodes ** 2, False),
        "report": speed.seconds(REPORT_S, False),
    }
    if work.has_detail:
        plan["detail"] = speed.seconds(work.photos * work.megapixels * DETAIL_S, False)
    return plan


def whole_seconds(plan: Mapping[str, float | Mapping[int, float]]) -> float:
    """Return the seconds of all stages together."""
    return sum(max(one.values()) if isinstance(one, Mapping) else one for one in plan.values())


def within_budget(config: FitConfig, seconds: float, work: Work) -> FitConfig:
    """Return the schedule, shortened where needed to fit into about so many seconds on this machine.

    With less than a quarter of its iterations a level brings nothing, so the finest level is dropped first.
    """
    speed = measure_speed()
    while True:
        plan = planned_seconds(config, speed, work)
        steps = plan["solve"]
        assert isinstance(steps, dict)
        solving = max(steps.values())
        share = (seconds - whole_seconds(plan) + solving) / solving
        if share >= 1:
            return config
        if share >= FEWEST_SHARE or len(config.levels) == 1:
            return shortened(config, max(share, 0.0))
        config = replace(config, levels=config.levels[:-1])


def predicted_runs(photos: int, width: int, height: int) -> list[dict[str, str | float | bool]]:
    """Return for each preset of the default solver its `seconds` and `bytes` on this machine, and whether these `fit`.

    Args:
        photos: their number, of width x height px.
    """
    speed, room = measure_speed(), memory_room()
    found: list[dict[str, str | float | bool]] = []
    for name in ("draft", "standard", "fine"):
        needed = predicted_memory(photos, width, height, name)
        side, config = preset(name, 0)
        plan = planned_seconds(config, speed, Work(photos, width * height / 1e6, side, name == "fine"))
        found.append({"name": name, "seconds": whole_seconds(plan), "bytes": float(needed), "fits": needed <= room})
    return found


def describe_machine() -> list[str]:
    """Return the lines of the report of `shadowgraph doctor`."""
    memory = psutil.virtual_memory()
    accelerator = f"{torch.cuda.get_device_name()} found" if torch.cuda.is_available() else "no GPU found, none needed"
    compiled = "kept" if kernels_are_compiled() else "none yet; the first run takes some 20 s longer"
    lines = [
        f"Python {platform.python_version()} on {platform.platform()}",
        f"cores: {os.cpu_count()}, used: {thread_count()}",
        f"memory: {memory.total / GIB:.1f} GiB, free {memory.available / GIB:.1f} GiB",
        f"photos are decoded: {confinement()}",
        f"torch {torch.__version__}: {accelerator}",
        f"the surface is fitted on: {backend_name(solver_device('auto'))}",
        f"compiled parts: {compiled} ({_cache_folder()})",
    ]
    for row in predicted_runs(36, 4032, 3024):
        seconds, memory = duration_text(float(row["seconds"])), f"{float(row['bytes']) / GIB:.1f} GiB of memory"
        lines.append(
            f"36 photos of 12 megapixels, --preset {row['name']}: about {seconds} as busy as it is now, {memory}"
        )
    return lines


def kernels_are_compiled() -> bool:
    """Return True if an earlier run left compiled kernels; otherwise the next one spends a while compiling them."""
    folder = _cache_folder()
    return folder.is_dir() and any(folder.rglob("*.nbi"))


def _cache_folder() -> Path:
    return Path(os.environ.get("NUMBA_CACHE_DIR") or Path(kernels.__file__).parent / "__pycache__")
