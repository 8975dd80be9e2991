"""What each field costs and reaches: the paper's network, hash features, a trainable grid, and the default solver.

    python benchmarks/run_fields.py SCENE [--input shadow] [--seconds 60] [--steps 2] [--table FILE]

SCENE has known camera and lights, and a gt/ that only scores. Three tables: CPU seconds of one iteration at the paper's
batch and sizes; what each field reaches in the same CPU seconds in miniature; when the default solver is within
10 degrees, and how many times as long the paper's iterations would take here.
"""

import argparse
import time
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from run_captures import machine, publish, table

from calibration.source import RunOptions, calibrate_source, open_source, read_pictures
from reconstruct.compare import angle_deg
from reconstruct.fit_config import FitConfig
from reconstruct.grid import SdfGrid
from reconstruct.hash_field import HashLevels
from reconstruct.machine import rays_per_second
from reconstruct.metrics import load_scene_reference
from reconstruct.neural import Network
from reconstruct.observer import Observer
from reconstruct.scene import Scene, build_scene
from reconstruct.score import Prediction, Reference, compare_views
from reconstruct.solver import fit
from reconstruct.train_config import ShadowSamples, TrainConfig, Weights, shortened_training
from reconstruct.train_frame import UnitFrame, object_frame, read_onto_grid, unit_height
from reconstruct.train_model import Model
from reconstruct.trainer import iterations
from reconstruct.view import surface_maps

FIELDS = ("neural", "hash", "grid")
MINIATURE_PIXELS = 100  # of the picture's longer side
TARGET_DEG = 10.0
WARM = 3  # iterations before the miniature's own cost is measured
RATES = {"neural": 2e-3, "hash": 5e-3, "grid": 2e-2}  # a grid node moves alone, so it must move further
MINIATURE = TrainConfig(
    pixels=96,
    lights=4,
    camera_steps=64,
    samples=ShadowSamples(24, 4, 12, 2),
    weights=Weights(eikonal=0.03, bound=1.0, contain=0.2),
    network=Network(width=64, depth=4, skip=2, frequencies=4, features=16, material_width=32, material_depth=2),
    hash_levels=HashLevels(coarsest=8, finest=64, levels=4, rows=2**14, width=32, features=7),
    grid_nodes=64,
    start_steps=150,
    cosine_anneal=1,
    foreground_anneal=0,
    mesh_nodes=96,
    resolutions=((0, 1),),
)


def load(folder: Path, kind: str, long_side: int) -> Scene:
    """The scene on a grid of at most long_side pixels."""
    options = RunOptions(input=kind)
    source = open_source(folder, options)
    pictures = read_pictures(source, options)
    calibration = calibrate_source(source, pictures, options)
    return build_scene(pictures.stack, calibration, long_side, pictures.shadow, pictures.mask)


def score(truth: Reference, grid: SdfGrid) -> dict[str, float]:
    """Depth (scene units), normals and mask as `shadowgraph evaluate` measures them on a result's maps."""
    maps = surface_maps(grid, truth.ground_height, truth.camera, truth.world_from_camera)
    mask = maps.mask.numpy().reshape(-1)
    depth = np.where(mask, maps.depth.numpy().reshape(-1), np.inf)
    normals = np.where(mask[:, None], maps.normals.numpy().reshape(-1, 3), [0.0, 0.0, 1.0])
    numbers = compare_views(truth, Prediction(depth, normals, mask), None)
    return {name: float(str(numbers[name])) for name in ("depth_l1_raw", "normal_mae_deg", "mask_iou")}


def normal_error(truth: Reference, grid: SdfGrid) -> float:
    """Mean angle between normals over the true object, degrees; what is missed shows the ground."""
    maps = surface_maps(grid, truth.ground_height, truth.camera, truth.world_from_camera)
    normals = np.where(maps.mask.numpy()[..., None], maps.normals.numpy(), [0.0, 0.0, 1.0]).reshape(-1, 3)
    return float(angle_deg(normals[truth.mask], truth.normals[truth.mask]).mean())


def start(scene: Scene, config: TrainConfig) -> tuple[Model, torch.optim.Optimizer, UnitFrame]:
    """An untrained model in the scene's frame."""
    frame = object_frame(scene, Observer(scene).ground_labels(), config.bound)
    model = Model(config, unit_height(scene.ground_height, frame))
    return model, torch.optim.Adam(model.parameters(), lr=config.learning_rate), frame


def step_cost(scene: Scene, field: str, steps: int) -> float:
    """CPU seconds of one iteration with the paper's settings, at full resolution, after one that warms up."""
    config = replace(TrainConfig(field=field), resolutions=((0, 1),))
    model, optimiser, frame = start(scene, config)
    running = iterations(model, optimiser, scene, frame, config, 0)
    next(running)
    before = time.process_time()
    for _ in range(steps):
        next(running)
    return (time.process_time() - before) / steps


def equal_time(truth: Reference, scene: Scene, field: str, seconds: float) -> dict:
    """What a field reaches in so many CPU seconds, its schedule fitted to them."""
    config = replace(MINIATURE, field=field, learning_rate=RATES[field])
    model, optimiser, frame = start(scene, config)
    running = iterations(model, optimiser, scene, frame, config, 0)
    list(islice(running, WARM))
    before = time.process_time()
    list(islice(running, WARM))
    config = shortened_training(config, max(10, int(seconds * WARM / (time.process_time() - before))))
    model, optimiser, frame = start(scene, config)
    before = time.process_time()
    for _ in iterations(model, optimiser, scene, frame, config, 0):
        pass
    spent = time.process_time() - before
    grid = read_onto_grid(model.field, frame, config.mesh_nodes, scene.ground_height, config.bound, torch.device("cpu"))
    return {"capture": field, "CPU s": spent, "iterations": config.iterations, **score(truth, grid)}


def default_solver(truth: Reference, scene: Scene) -> tuple[dict, float | None]:
    """The default solver's end, and the CPU seconds after which it was first within TARGET_DEG."""
    shown: list[tuple[float, SdfGrid]] = []
    before = time.process_time()

    def report(*, surface: SdfGrid | None, **_: object) -> None:
        if surface is not None:
            shown.append((time.process_time() - before, surface))

    fields = fit(scene, FitConfig(), report)
    spent = time.process_time() - before
    shown.append((spent, fields.grid))
    reached = (at for at, grid in shown if normal_error(truth, grid) <= TARGET_DEG)
    return {"capture": "default solver", "CPU s": spent, **score(truth, fields.grid)}, next(reached, None)


def main() -> None:
    """Parse, measure, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--input", choices=("rgb", "shadow"), default="shadow")
    parser.add_argument("--seconds", type=float, default=60.0, help="CPU seconds for each field in miniature")
    parser.add_argument("--steps", type=int, default=2, help="iterations measured at the paper's batch")
    parser.add_argument("--table", type=Path, help="write the tables here as well")
    arguments = parser.parse_args()
    rays_per_second()  # compiles the kernels
    truth = load_scene_reference(arguments.scene)
    full = load(arguments.scene, arguments.input, 10_000)
    small = load(arguments.scene, arguments.input, MINIATURE_PIXELS)
    lines = [f"`benchmarks/run_fields.py {arguments.scene.name} --input {arguments.input}`", "", *machine()]
    costs = {field: step_cost(full, field, arguments.steps) for field in FIELDS}
    total = TrainConfig().iterations
    rows = [
        {"capture": field, "CPU s of one iteration": cost, f"CPU days of {total} iterations": cost * total / 86400}
        for field, cost in costs.items()
    ]
    batch = f"{TrainConfig().pixels} pixels x {TrainConfig().lights} lights"
    lines += ["", f"One iteration at the paper's batch ({batch}) and sizes:", "", *table(rows)]
    solver, reached = default_solver(truth, full)
    torch.set_num_threads(1)  # batches this small only make a second thread wait, which counts as CPU time
    rows = [equal_time(truth, small, field, arguments.seconds) for field in FIELDS]
    lines += ["", f"In miniature ({MINIATURE_PIXELS} px), and the default solver at full size:", ""]
    lines += table([*rows, solver])
    ratio = None if reached is None else costs["neural"] * total / reached
    lines += [
        "",
        f"CPU seconds of the default solver until normals are within {TARGET_DEG:g} degrees: "
        f"{'not reached' if reached is None else f'{reached:.1f}'}.",
        f"The paper's iterations on this CPU take {'-' if ratio is None else f'{ratio:.0f}'} times as long.",
    ]
    text = "\n".join(lines) + "\n"
    publish(text, arguments.table)


if __name__ == "__main__":
    main()
