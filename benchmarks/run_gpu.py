"""The torch backend against the CPU kernels on one scene that it makes itself: equal, how fast, how much memory.

    python benchmarks/run_gpu.py                                    on a machine with CUDA: 800 px, 100 lights, fine
    python benchmarks/run_gpu.py --device torch-cpu --width 120 --lights 12 --preset draft     anywhere, in a minute

The scene, two balls and a box on a table, is rendered exactly: tests/synthetic.py.
Tables: each grid's gradient, step and seconds by either; whole solves by either against the truth; and how far apart
the two surfaces are, seen by the camera.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import psutil
import torch
from sheet import Sheet, parser_of, table
from solves import LOOK, Subject, as_truth, scene_of, score, seen, shown, synthetic

from reconstruct.config import FitConfig
from reconstruct.evaluate.score import compare_views
from reconstruct.fields import SolvedScene
from reconstruct.initialization.choose_start import choose_start
from reconstruct.labels.observer import Observer
from reconstruct.labels.supervision import supervise
from reconstruct.run.presets import preset
from reconstruct.scene import Scene
from reconstruct.sdf.level_set import LevelSet, resampled
from reconstruct.solve.backend import backend_name, solver_device
from reconstruct.solve.operators import RayPasses
from reconstruct.solve.solver import fit

TIMED = 10  # iterations per level, after two to warm up
SHARPNESS = 12.0  # per voxel, the middle of the solver's range
MIB = 2**20


def arguments() -> argparse.Namespace:
    parser = parser_of(__doc__)
    parser.add_argument("--device", default="cuda", choices=["cuda", "torch-cpu"])
    parser.add_argument("--width", type=int, default=800, help="pixels; the height is three quarters of it")
    parser.add_argument("--lights", type=int, default=100)
    parser.add_argument("--preset", default="fine", choices=["draft", "standard", "fine"])
    parser.add_argument("--input", default="rgb", choices=["rgb", "shadow"], help="photos, or shadow pictures and mask")
    parser.add_argument("--nodes", type=int, nargs="*", default=[], help="grids to time; else those of the preset")
    parser.add_argument("--no-cpu-solve", action="store_true", help="leave out the whole solve by the kernels")
    parser.add_argument("--no-solve", action="store_true", help="leave out all whole solves")
    return parser.parse_args()


def wait_for(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize()


def seconds_each(work: Callable[[int], object], device: torch.device, count: int) -> float:
    """Mean wall time of work(2), ... after work(0) and work(1)."""
    for i in range(2):
        work(i)
    wait_for(device)
    start = time.perf_counter()
    for i in range(2, count + 2):
        work(i)
    wait_for(device)
    return (time.perf_counter() - start) / count


def compare_level(scene: Scene, device: torch.device, config: FitConfig, nodes: int) -> dict:
    """One grid: gradients and steps of both backends on the same rays, then seconds per iteration and memory."""
    observer = Observer(scene)
    begin = choose_start(scene, observer, config)
    start = begin.surface()
    [labels] = begin.labels(start, (scene,))
    kernel, rays = resampled(start, nodes), supervise(scene, labels)
    moving = resampled(start, nodes).on(device)
    by_kernels = RayPasses(kernel, scene, rays, config)
    by_torch = RayPasses(moving, scene, supervise(scene, labels), config)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats()
    for surface, shoot in ((kernel, by_kernels), (moving, by_torch)):
        shoot.look(surface.grid(), 0, SHARPNESS, 0.5)
        shoot(0, SHARPNESS)
    expected = kernel.sums()[0]
    apart = np.linalg.norm(moving.sums()[0] - expected) / np.linalg.norm(expected)
    before = kernel.phi.copy()
    for surface in (kernel, moving):
        surface.step(2, 0.4, 0.0, 0.0, 4, 0.1)
        surface.redistance()
    moved, step = np.abs(kernel.phi - before).mean(), np.abs(kernel.phi - moving.phi).mean()

    def iterate(surface: LevelSet, shoot: RayPasses) -> Callable[[int], object]:
        def work(i: int) -> None:
            shoot(1 + i, SHARPNESS)
            surface.step(2, 0.1, 0.0, 0.0, 4, 0.1)
            if i % 10 == 9:
                surface.redistance()

        return work

    cpu = seconds_each(iterate(kernel, by_kernels), device, TIMED)
    gpu = seconds_each(iterate(moving, by_torch), device, TIMED)
    memory = torch.cuda.max_memory_allocated() / MIB if device.type == "cuda" else "not measured"
    row = {"nodes": nodes, "pixels": len(rays.pixels), "gradient, relative difference": float(apart)}
    row |= {"step, relative difference": float(step / moved), "kernels, s": cpu, "torch, s": gpu, "ratio": cpu / gpu}
    return row | {"GPU memory, MiB": memory}


def solve(subject: Subject, scene: Scene, config: FitConfig, device: torch.device | None) -> tuple[dict, SolvedScene]:
    """A whole solve: wall seconds, of which iterations; its score; memory."""
    stamps: list[tuple[str, float]] = [("", time.perf_counter())]
    report = lambda *, message, **_: stamps.append((message, time.perf_counter()))  # noqa: E731
    if device is not None and device.type == "cuda":
        torch.cuda.reset_peak_memory_stats()
    fields = fit(scene, config, report, device=device)
    total = time.perf_counter() - stamps[0][1]
    iterating = sum(now - then for (a, then), (b, now) in pairwise(stamps) if a == b)
    cuda = device is not None and device.type == "cuda"
    memory = torch.cuda.max_memory_allocated() if cuda else psutil.Process().memory_info().rss
    row = {"whole solve": backend_name(device), "s": total, "of which iterations, s": iterating}
    return row | shown(score(fields, subject)) | {"memory, MiB": memory / MIB}, fields


def main() -> None:
    """Make the scene, compare, write the table."""
    options = arguments()
    device = solver_device(options.device)
    assert device is not None
    height = 3 * options.width // 4
    look = replace(LOOK, width=options.width, height=height, n_lights=options.lights)
    subject = synthetic(options.input, look=look)
    scene = scene_of(subject, subject.calibration, options.width)
    _, config = preset(options.preset, 0)
    grids = options.nodes or [level.nodes for level in config.levels]
    what = f"{options.width} x {height} px, {options.lights} lights, {options.input}"
    against = f"{backend_name(device)} against {backend_name(None)}"
    note = f"{against}. Scene: {what}; preset {options.preset}."
    sheet = Sheet(options.table, "seed 0", note)
    size, parts = {"scene": f"{what}, {options.preset}"}, []
    levels = [size | compare_level(scene, device, config, nodes) for nodes in grids]
    sheet.write(levels)
    if options.no_solve:
        return
    solves = [solve(subject, scene, config, device)]
    solves += [] if options.no_cpu_solve else [solve(subject, scene, config, None)]
    again = solve(subject, scene, config, device)[1]
    parts.append(table([row for row, _ in solves]))
    if len(solves) > 1:
        reference = as_truth(solves[1][1], subject.calibration)
        apart = shown(compare_views(reference, seen(solves[0][1], reference)))
        parts.append(["How far apart the two solves are:", "", *table([{"": against} | apart])])
    same = torch.equal(again.grid.values, solves[0][1].grid.values)
    sheet.write(levels, *parts, [f"A second solve by torch ends in {'the same' if same else 'other'} bits."])


if __name__ == "__main__":
    main()
