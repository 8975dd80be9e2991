"""How the solver's cost grows with the grid, the rays, the photos and the cores: CPU seconds and peak memory.

    python benchmarks/run_scale.py [SUBJECT] [--nodes 80 160 320 512] [--rays 40000 80000 160000] [--photos 10 20 40]
        [--pixels 100 200 400 800] [--threads 1 2] [--iterations 10] [--table FILE]

SUBJECT is a scene with known camera, lights and shadow pictures, or `synthetic` (see benchmarks/solves.py), which it
is unless given. A short, coarse solve finds a surface to start from; then each row is one level of the real solver on
it, in a process of its own. One number is varied at a time, the others are the first of --rays, the last of --photos,
the first of --threads and the second of --nodes. --pixels: the synthetic scene rendered with pictures so wide, and
read: labels and shadow hull, once, whose cost grows with the pixels, and not with the rays. Slopes are exponents:
cost ~ number^slope.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from sheet import Sheet, down, parser_of, slope
from solves import LOOK, SYNTHETIC, open_subject, scene_of
from synthetic import HEAP, render  # pyright: ignore[reportMissingImports]  # of the tests

from reconstruct.config import FitConfig, Level
from reconstruct.initialization.choose_start import choose_start
from reconstruct.labels.held_out import draw_blocks, hold_out
from reconstruct.labels.observer import Observer
from reconstruct.labels.supervision import supervise
from reconstruct.run_folder.cost import PeakMemory
from reconstruct.scene import Scene
from reconstruct.sdf.grid import SdfGrid
from reconstruct.sdf.level_set import resampled
from reconstruct.solve.level import LevelFit
from reconstruct.solve.light_refine import MovingLights, no_shift
from reconstruct.solve.solver import fit

COARSE = (Level(48, 40, (0.5, 0.4), 4, 2.5e-4), Level(96, 40, (0.4, 0.15), 3, 2.5e-4))
RATE = (0.25, 0.08)  # voxels, of the finest level of the standard preset
GIB = 2**30


def arguments() -> argparse.Namespace:
    parser = parser_of(__doc__)
    parser.add_argument("subject", nargs="?", default=SYNTHETIC)
    parser.add_argument("--nodes", type=int, nargs="+", default=[80, 160, 320, 512])
    parser.add_argument("--rays", type=int, nargs="+", default=[40_000, 80_000, 160_000])
    parser.add_argument("--photos", type=int, nargs="+", default=[10, 20, 40])
    parser.add_argument("--pixels", type=int, nargs="*", default=[100, 200, 400, 800])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--iterations", type=int, default=10)
    parser.add_argument("--start", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--one", type=json.loads, help=argparse.SUPPRESS)
    return parser.parse_args()


def first_photos(scene: Scene, count: int) -> Scene:
    """The scene with its first photos only."""
    assert scene.shadow is not None
    names = ("shadow", "usable", "lights", "power", "axis", "light_sigma")
    return replace(scene, **{name: getattr(scene, name)[:count] for name in names})


def load(named: str) -> Scene:
    """The subject's shadow pictures at full size."""
    subject = open_subject(named, "shadow")
    return scene_of(subject, subject.calibration, 10_000)


def coarse_surface(named: str, file: Path) -> None:
    """A short solve's surface, in a file."""
    grid = fit(load(named), FitConfig(levels=COARSE), lambda **_: None).grid
    np.savez(file, values=grid.values.numpy(), origin=grid.origin.numpy(), spacing=grid.spacing)


def read(pixels: int) -> dict[str, float]:
    """Labels and shadow hull of the synthetic scene with pictures `pixels` wide, once its kernels are compiled."""
    row: dict[str, float] = {}
    for width in (40, pixels):  # the first one compiles
        scene, _ = render(HEAP, replace(LOOK, width=width, height=3 * width // 4))
        scene = replace(scene, rgb=None)
        with PeakMemory() as memory:
            before = time.process_time()
            begin = choose_start(scene, Observer(scene), FitConfig())
            begin.labels(begin.surface(), (scene,))
            spent = time.process_time() - before
        row = {"labels and hull, CPU s": spent, "peak memory, GiB": memory.peak / GIB}
    return row


def measure(named: str, start: Path, nodes: int, rays: int, photos: int, iterations: int) -> dict[str, float]:
    """One level on so many nodes, rays per iteration and photos: what it costs once its kernels are compiled."""
    scene = first_photos(load(named), photos)
    given = np.load(start)
    coarse = SdfGrid(torch.from_numpy(given["values"]), torch.from_numpy(given["origin"]), float(given["spacing"]))
    config = FitConfig(rays=rays, rays_per_pixel=1e9)
    [labels] = choose_start(scene, Observer(scene), config).labels(coarse, (scene,))
    supervision = supervise(scene, labels)
    drawn = draw_blocks(supervision.pixels, scene.camera.width, len(scene.lights), config.seed)
    supervision, held_out = hold_out(supervision, drawn)
    level = Level(nodes, iterations, RATE, 1)
    row: dict[str, float] = {}
    for size in (COARSE[0].nodes, nodes):  # the first one compiles
        with PeakMemory() as memory:
            before = time.process_time()
            surface = resampled(coarse, size)
            moved, start_s = time.process_time(), time.perf_counter()
            lights = MovingLights(scene, no_shift(scene))
            for _ in LevelFit(scene, supervision, held_out, level, config).steps(surface, lights):
                pass
            done, wall_s = time.process_time(), time.perf_counter() - start_s
        row = {
            "blocks": len(surface.field.pool),
            "share stored": surface.field.pool.size / np.prod(surface.field.nodes),
        }
        row |= {"resampling, CPU s": moved - before, "iteration, CPU s": (done - moved) / iterations}
        row |= {"iteration, wall s": wall_s / iterations}
        row |= {"peak memory, GiB": memory.peak / GIB}
    return row


def alone(options: argparse.Namespace, start: Path, one: dict, threads: int) -> dict:
    """`measure` or `read` in a process of its own on so many cores."""
    command = [sys.executable, __file__, options.subject, "--start", str(start), "--one", json.dumps(one)]
    cores = sorted(os.sched_getaffinity(0))[:threads]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        command, capture_output=True, text=True, check=True, env=environment, preexec_fn=lambda: pin(cores)
    )
    return {"cores": threads} | one | json.loads(done.stdout.splitlines()[-1])


def pin(cores: list[int]) -> None:
    os.sched_setaffinity(0, cores)


def section(along: str, rows: list[dict], measures: tuple[str, ...]) -> list[str]:
    """A table along one number, and its slopes."""
    lines = [f"{along.capitalize()}:", "", *down(rows, along)]
    if len(rows) < 2:
        return lines
    slopes = (f"{name.split(',')[0]} {slope(*(column(rows, key) for key in (along, name))):.2f}" for name in measures)
    return [*lines, "", f"Slopes against {along}: {', '.join(slopes)}."]


def column(rows: list[dict], key: str) -> list[float]:
    """One measure of all rows."""
    return [float(row[key]) for row in rows]


def main() -> None:
    """Parse, measure, write after every part."""
    options = arguments()
    if options.one:
        one = options.one
        print(json.dumps(read(**one) if "pixels" in one else measure(options.subject, options.start, **one)))
        return
    usual = {"nodes": options.nodes[min(1, len(options.nodes) - 1)], "rays": options.rays[0]}
    usual |= {"photos": options.photos[-1], "iterations": options.iterations}
    note = f"{Path(options.subject).name}; {usual['nodes']} nodes, {usual['rays']} rays, {usual['photos']} photos, "
    note += f"{options.threads[0]} core unless a table says another."
    sheet, parts = Sheet("Cost against size", options.table, "seed 0", note), []
    levels, reading = ("iteration, CPU s", "peak memory, GiB"), ("labels and hull, CPU s", "peak memory, GiB")
    with tempfile.TemporaryDirectory() as folder:
        start = Path(folder) / "start.npz"
        coarse_surface(options.subject, start)
        for name in ("nodes", "rays", "photos"):
            values = getattr(options, name)
            rows = [alone(options, start, usual | {name: value}, options.threads[0]) for value in values]
            parts.append(section(name, rows, levels))
            sheet.write(*parts)
        parts.append(section("cores", [alone(options, start, usual, cores) for cores in options.threads], levels))
        rows = [alone(options, start, {"pixels": pixels}, options.threads[0]) for pixels in options.pixels]
        sheet.write(*parts, *([section("pixels", rows, reading)] if rows else []))


if __name__ == "__main__":
    main()
