"""What each field costs and reaches: the paper's network, hash features, a trainable grid, and the default solver.

    python benchmarks/run_fields.py [SUBJECT] [--input shadow] [--seconds 60] [--steps 2] [--table FILE]

SUBJECT is a scene with known camera and lights, and a gt/ that only scores, or `synthetic` (see
benchmarks/solves.py), which it is unless given. Tables: CPU seconds of one iteration at the paper's batch and sizes;
what each field reaches in the same CPU seconds in miniature; the normal error on the way there; when the default
solver is within 10 degrees, and how many times as long the paper's iterations would take here. `--seconds 0` leaves
all but the first one out.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from itertools import islice

import paper
import torch
from sheet import Sheet, across, down, parser_of
from solves import SYNTHETIC, Subject, open_subject, scene_of, score, seen, shown

from reconstruct.config import FitConfig
from reconstruct.evaluate.metrics import load_scene_reference
from reconstruct.evaluate.score import Reference
from reconstruct.evaluate.surface_distance import angle_deg
from reconstruct.fields import Fields
from reconstruct.labels.observer import Observer
from reconstruct.run.machine import measure_speed
from reconstruct.scene import Scene
from reconstruct.sdf.grid import SdfGrid
from reconstruct.shadowneus.config import ShadowSamples, TrainConfig, Weights, shortened_training
from reconstruct.shadowneus.hash_field import HashLevels
from reconstruct.shadowneus.mlp_field import Network
from reconstruct.shadowneus.model import Model
from reconstruct.shadowneus.trainer import finished, iterations
from reconstruct.shadowneus.unit_frame import UnitFrame, object_frame, read_onto_grid, unit_height
from reconstruct.solve.solver import fit

FIELDS = ("neural", "hash", "grid")
MINIATURE_PIXELS = 100  # of the picture's longer side
TARGET_DEG = 10.0
MARKS = (0.1, 0.25, 0.5, 0.75, 1.0)  # of the iterations, after which the normal error is taken
GROWTH = 1.25  # of the CPU seconds between two surfaces of the default solver that are looked at
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


def truth_of(subject: Subject) -> Reference:
    """What its camera should see."""
    if subject.truth is not None:
        return subject.truth
    assert subject.folder is not None
    return load_scene_reference(subject.folder)


def normal_error(truth: Reference, fields: Fields) -> float:
    """Mean angle between normals over the true object, degrees; what is missed shows the ground."""
    return float(angle_deg(seen(fields, truth).normals[truth.mask], truth.normals[truth.mask]).mean())


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


def trained(
    scene: Scene, config: TrainConfig, seconds: float, look: Callable[[float, SdfGrid], None] = lambda *_: None
) -> tuple[Fields, float, int]:
    """A field after so many CPU seconds, its schedule fitted to them; the seconds it took, and its iterations.

    Args:
        look: gets the CPU seconds so far and the surface, after each of MARKS; looking does not count.
    """
    model, optimiser, frame = start(scene, config)
    running = iterations(model, optimiser, scene, frame, config, 0)
    list(islice(running, WARM))
    before = time.process_time()
    list(islice(running, WARM))
    config = shortened_training(config, max(10, int(seconds * WARM / (time.process_time() - before))))
    model, optimiser, frame = start(scene, config)
    marks = {round(share * config.iterations) for share in MARKS}
    spent, before = 0.0, time.process_time()
    for i, _ in iterations(model, optimiser, scene, frame, config, 0):
        if i + 1 in marks:
            spent += time.process_time() - before
            cpu = torch.device("cpu")
            look(spent, read_onto_grid(model.field, frame, config.mesh_nodes, scene.ground_height, config.bound, cpu))
            before = time.process_time()
    return finished(model, scene, frame, config), spent, config.iterations


def equal_time(subject: Subject, scene: Scene, field: str, seconds: float, seed: int) -> tuple[dict, list[dict]]:
    """What a field reaches in so many CPU seconds, and its normal error on the way."""
    truth, way = truth_of(subject), []

    def look(spent: float, grid: SdfGrid) -> None:
        if bool((grid.values < 0).any()):  # at first there may be no object
            way.append({"field": field, "CPU s": spent, "normals, deg": normal_error(truth, bare(grid, scene))})

    config = replace(MINIATURE, seed=seed, field=field, learning_rate=RATES[field])
    solved, spent, count = trained(scene, config, seconds, look)
    return {"capture": field, "CPU s": spent, "iterations": count, **shown(score(solved, subject))}, way


def bare(grid: SdfGrid, scene: Scene) -> Fields:
    """A surface without colours."""
    albedo = torch.zeros(scene.camera.height, scene.camera.width, 3)
    return Fields(grid, albedo, scene.camera, scene.world_from_camera, scene.ground_height, scene.unit)


def default_solver(subject: Subject, scene: Scene, seed: int) -> tuple[dict, list[dict]]:
    """The default solver's end, and its normal error on the way."""
    surfaces: list[tuple[float, SdfGrid]] = []
    before = time.process_time()

    def report(*, surface: SdfGrid | None, **_: object) -> None:
        spent = time.process_time() - before
        if surface is not None and (not surfaces or spent > GROWTH * surfaces[-1][0]):
            surfaces.append((spent, surface))

    fields = fit(scene, FitConfig(seed=seed), report)
    spent = time.process_time() - before
    truth = truth_of(subject)
    way = [(at, normal_error(truth, bare(grid, scene))) for at, grid in surfaces]
    way.append((spent, normal_error(truth, fields)))
    rows = [{"field": "default solver", "CPU s": at, "normals, deg": error} for at, error in way]
    return {"capture": "default solver", "CPU s": spent, **shown(score(fields, subject))}, rows


def main() -> None:
    """Parse, measure, write."""
    parser = parser_of(__doc__)
    parser.add_argument("subject", nargs="?", default=SYNTHETIC)
    parser.add_argument("--input", choices=("rgb", "shadow"), default="shadow")
    parser.add_argument("--seconds", type=float, default=60.0, help="CPU seconds for each field in miniature; 0: none")
    parser.add_argument("--steps", type=int, default=2, help="iterations measured at the paper's batch; 0: none")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    measure_speed()  # compiles the kernels
    torch.set_num_threads(1)  # small batches only make a second thread wait, which counts as CPU time
    subject = open_subject(options.subject, options.input)
    full, small = (scene_of(subject, subject.calibration, side) for side in (10_000, MINIATURE_PIXELS))
    note = f"{subject.name}, input {options.input}, one thread but for the default solver's rays."
    sheet, total, parts = Sheet("Trained fields", options.table, f"seed {options.seed}", note), paper.ITERATIONS, []
    costs = {field: step_cost(full, field, options.steps) for field in FIELDS if options.steps}
    if costs:
        batch = f"{TrainConfig().pixels} pixels x {TrainConfig().lights} lights"
        rows = [
            {"field": field, "CPU s of one iteration": cost, f"CPU days of {total}": cost * total / 86400}
            for field, cost in costs.items()
        ]
        parts = [[f"One iteration at the paper's batch ({batch}) and sizes:", "", *down(rows, "field")]]
    sheet.write(*parts)
    if not options.seconds:
        return
    ends, way = default_solver(subject, full, options.seed)
    ends = [ends]
    for field in FIELDS:
        end, more = equal_time(subject, small, field, options.seconds, options.seed)
        ends, way = [*ends, end], [*way, *more]
        words = f"In miniature ({MINIATURE_PIXELS} px), and the default solver at full size:"
        curves = ["Normal error on the way:", "", *down(way, "field")]
        sheet.write(*parts, [words, "", *across(ends)], curves, [within(way, costs.get("neural"))])


def within(way: list[dict], cost: float | None) -> str:
    """When the default solver is good, and how that compares with the paper's iterations."""
    good = (row["CPU s"] for row in way if row["field"] == "default solver" and row["normals, deg"] <= TARGET_DEG)
    reached = next(good, None)
    if reached is None:
        return f"The default solver does not get within {TARGET_DEG:g} degrees."
    text = f"The default solver's normals are within {TARGET_DEG:g} degrees after {reached:.1f} CPU seconds."
    if cost is None:
        return text
    ratio = cost * paper.ITERATIONS / reached
    return f"{text} The paper's {paper.ITERATIONS} iterations on this CPU would take {ratio:.0f} times as long."


if __name__ == "__main__":
    main()
