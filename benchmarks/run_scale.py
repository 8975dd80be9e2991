"""How the solver's cost grows with the grid, the rays, the photos and the cores: CPU seconds and peak memory.

    PYTHONPATH=. python benchmarks/run_scale.py SCENE [--nodes 80 160 320 512] [--rays 40000 80000 160000]
        [--photos 10 20 40] [--threads 1 2] [--iterations 10] [--table FILE]

SCENE has known camera, lights and shadow pictures. A short, coarse solve finds a surface to start from; then each row
is one level of the real solver on it, in a process of its own. One number is varied at a time, the others are the
first of --rays, the last of --photos, the first of --threads and the second of --nodes.
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
from run_captures import machine, publish, table
from run_fields import load

from capture.cost import PeakMemory
from reconstruct.course import Course, watch
from reconstruct.fit_config import FitConfig, Level
from reconstruct.grid import SdfGrid
from reconstruct.light_refine import MovingLights, no_shift
from reconstruct.observer import Observer
from reconstruct.scene import Scene
from reconstruct.solver import fit, fit_level
from reconstruct.start import choose_start
from reconstruct.supervision import supervise
from reconstruct.surface import resampled

COARSE = (Level(48, 40, (0.5, 0.4), 4, 2.5e-4), Level(96, 40, (0.4, 0.15), 3, 2.5e-4))
RATE = (0.25, 0.08)  # voxels, of the finest level of the standard preset
GIB = 2**30


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--nodes", type=int, nargs="+", default=[80, 160, 320, 512])
    parser.add_argument("--rays", type=int, nargs="+", default=[40_000, 80_000, 160_000])
    parser.add_argument("--photos", type=int, nargs="+", default=[10, 20, 40])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--iterations", type=int, default=10)
    parser.add_argument("--table", type=Path, help="write the tables here as well")
    parser.add_argument("--start", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--one", type=json.loads, help=argparse.SUPPRESS)
    return parser.parse_args()


def first_photos(scene: Scene, count: int) -> Scene:
    """The scene with its first photos only."""
    assert scene.shadow is not None
    names = ("shadow", "usable", "lights", "power", "axis", "light_sigma")
    return replace(scene, **{name: getattr(scene, name)[:count] for name in names})


def coarse_surface(folder: Path, file: Path) -> None:
    """A short solve's surface, in a file."""
    grid = fit(load(folder, "shadow", 10_000), FitConfig(levels=COARSE), lambda **_: None).grid
    np.savez(file, values=grid.values.numpy(), origin=grid.origin.numpy(), spacing=grid.spacing)


def measure(folder: Path, start: Path, nodes: int, rays: int, photos: int, iterations: int) -> dict[str, float]:
    """One level on so many nodes, rays per iteration and photos: what it costs once its kernels are compiled."""
    scene = first_photos(load(folder, "shadow", 10_000), photos)
    given = np.load(start)
    coarse = SdfGrid(torch.from_numpy(given["values"]), torch.from_numpy(given["origin"]), float(given["spacing"]))
    config = FitConfig(rays=rays, rays_per_pixel=1e9)
    labels = choose_start(scene, Observer(scene), config).labels(coarse, scene)
    supervision, watched = watch(supervise(scene, labels), scene.camera.width, config.seed)
    level = Level(nodes, iterations, RATE, 1)
    row: dict[str, float] = {}
    for size in (COARSE[0].nodes, nodes):  # the first one compiles
        with PeakMemory() as memory:
            before = time.process_time()
            surface = resampled(coarse, size)
            moved = time.process_time()
            lights = MovingLights(scene, no_shift(scene))
            for _ in fit_level(surface, scene, supervision, level, config, 0, 0, lights, watched, Course()):
                pass
            done = time.process_time()
        row = {
            "blocks": len(surface.field.pool),
            "share stored": surface.field.pool.size / np.prod(surface.field.nodes),
        }
        row |= {"resampling, CPU s": moved - before, "iteration, CPU s": (done - moved) / iterations}
        row |= {"peak memory, GiB": memory.peak / GIB}
    return row


def run_alone(options: argparse.Namespace, start: Path, nodes: int, rays: int, photos: int, threads: int) -> dict:
    """`measure` in a process of its own on so many cores."""
    one = {"nodes": nodes, "rays": rays, "photos": photos, "iterations": options.iterations}
    command = [sys.executable, __file__, str(options.scene), "--start", str(start), "--one", json.dumps(one)]
    cores = sorted(os.sched_getaffinity(0))[:threads]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        command, capture_output=True, text=True, check=True, env=environment, preexec_fn=lambda: pin(cores)
    )
    row = json.loads(done.stdout.splitlines()[-1])
    return {"capture": f"{nodes} nodes", "rays": rays, "photos": photos, "cores": threads} | row


def pin(cores: list[int]) -> None:
    os.sched_setaffinity(0, cores)


def slope(rows: list[dict], along: str, measure: str) -> float:
    """The exponent b of measure ~ along^b, by least squares of the logarithms."""
    x, y = (np.log([float(str(row[name]).split()[0]) for row in rows]) for name in (along, measure))
    return float(np.polyfit(x, y, 1)[0])


def section(title: str, rows: list[dict], along: str) -> list[str]:
    """A table and its slopes."""
    slopes = {name: slope(rows, along, name) for name in ("iteration, CPU s", "peak memory, GiB")} if rows[1:] else {}
    stated = "; ".join(f"{name.split(',')[0]} ~ {along}^{value:.2f}" for name, value in slopes.items())
    lines = ["", title, "", *table(rows)]
    return [*lines, "", f"Slopes: {stated.replace('capture', 'nodes')}."] if stated else lines


def main() -> None:
    """Parse, measure, write."""
    options = arguments()
    if options.one:
        print(json.dumps(measure(options.scene, options.start, **options.one)))
        return
    usual = (options.nodes[min(1, len(options.nodes) - 1)], options.rays[0], options.photos[-1], options.threads[0])
    lines = [f"`benchmarks/run_scale.py {options.scene.name}`", "", *machine()]
    varied = (
        ("capture", options.nodes),
        ("rays", options.rays),
        ("photos", options.photos),
        ("cores", options.threads),
    )
    with tempfile.TemporaryDirectory() as folder:
        start = Path(folder) / "start.npz"
        coarse_surface(options.scene, start)
        for place, (name, values) in enumerate(varied):
            settings = [(*usual[:place], value, *usual[place + 1 :]) for value in values]
            rows = [run_alone(options, start, *setting) for setting in settings]
            lines += section(f"{'Nodes' if name == 'capture' else name.capitalize()}:", rows, name)
            if name == "capture" and len(rows) > 1:
                lines[-1] += f" An iteration ~ blocks^{slope(rows, 'blocks', 'iteration, CPU s'):.2f}."
    publish("\n".join(lines) + "\n", options.table)


if __name__ == "__main__":
    main()
