"""Scenes with known lights, as given and with faults put in, over some seeds: median and range of each measure.

    python benchmarks/run_scenes.py SCENE... [--cases CASE...] [--seeds 3] [--table FILE]

A case is made by options of `shadowgraph run` and a fault in a copy of the scene: `lights 3 %` moves every light by a
normal error of that share of its distance (root mean square; a direction turns by as much) and says so to the solver,
`flips 2 %` turns that share of the pixels of every shadow picture. CPU seconds are those of the whole process.
"""

import json
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from one_run import run
from sheet import Sheet, flat, parser_of

MEASURES = {
    "depth": "depth_l1_raw",
    "normals, deg": "normal_mae_deg",
    "IoU": "mask_iou",
    "F at 1 %": "fscore",
    "hidden": "hidden_recall",
    "CPU s": "cpu_seconds",
}


@dataclass(frozen=True)
class Case:
    """What is asked of the solver, and what is wrong with its input."""

    options: tuple[str, ...] = ()
    light_error: float = 0.0  # of the light's distance
    flips: float = 0.0  # share of the pixels


CASES = {
    "rgb": Case(),
    "rgb, no mask": Case(("--mask", "none")),
    "shadow": Case(("--input", "shadow")),
    "both": Case(("--input", "both")),
    "shadow, no mask": Case(("--input", "shadow", "--mask", "none")),
    "rgb, 5 photos": Case(("--split", "train5")),
    "rgb, lights 3 %": Case(("--light-error", "0.03"), light_error=0.03),
    "rgb, lights 3 %, not refined": Case((), light_error=0.03),
    "shadow, no mask, flips 2 %": Case(("--input", "shadow", "--mask", "none"), flips=0.02),
    "shadow, no mask, lights 3 %": Case(
        ("--input", "shadow", "--mask", "none", "--light-error", "0.03"), light_error=0.03
    ),
    "shadow, lights 3 %": Case(("--input", "shadow", "--light-error", "0.03"), light_error=0.03),
    "shadow, flips 2 %": Case(("--input", "shadow"), flips=0.02),
}


def faulty(scene: Path, folder: Path, case: Case, seed: int) -> Path:
    """A copy of the scene, without its gt/, with the case's faults."""
    copy = folder / scene.name
    shutil.copytree(scene, copy, ignore=shutil.ignore_patterns("gt"))
    generator = np.random.default_rng(seed)
    if case.flips:
        for path in sorted((copy / "train").glob("*_white_.png")):
            shadow = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            assert shadow is not None
            turned = generator.random(shadow.shape[:2]) < case.flips
            cv2.imwrite(str(path), np.where(turned, 255 - shadow, shadow))
    if case.light_error:
        for path in sorted(copy.glob("transforms_train*.json")):
            path.write_text(json.dumps(moved(json.loads(path.read_text()), case, generator)))
    return copy


def moved(transforms: dict, case: Case, generator: np.random.Generator) -> dict:
    """The lights of a transforms file with an error; every light shines along its -z from its place."""
    for frame in transforms["frames"]:
        pose = np.array(frame["transform_matrix_sun"])
        place = pose[:3, 3]
        place = place + generator.normal(0, case.light_error / np.sqrt(3), 3) * np.linalg.norm(place)
        z = place / np.linalg.norm(place)
        x = np.cross([0.0, 1.0, 0.0] if abs(z[2]) > 0.9 else [0.0, 0.0, 1.0], z)
        x /= np.linalg.norm(x)
        pose[:3] = np.c_[x, np.cross(z, x), z, place]
        frame["transform_matrix_sun"] = pose.tolist()
    return transforms


def measured(scene: Path, case: Case, seed: int) -> dict[str, float]:
    """One run and its score."""
    with tempfile.TemporaryDirectory() as folder:
        has_fault = case.flips or case.light_error
        source = faulty(scene, Path(folder) / "scene", case, seed) if has_fault else scene
        row = flat(run(str(source), Path(folder) / "run", [*case.options, "--seed", str(seed)], reference=scene))
        return {name: float(row.get(key) or np.nan) for name, key in MEASURES.items()}


def row(scene: Path, name: str, seeds: int) -> dict[str, str]:
    """A row of the table: median (least to most)."""
    found = [measured(scene, CASES[name], seed) for seed in range(seeds)]
    cells = {"": f"{scene.name}: {name}"}
    for measure in MEASURES:
        values = np.array([one[measure] for one in found])
        text = f"{np.median(values):.4g}"
        cells[measure] = text if seeds == 1 else f"{text} ({values.min():.4g} to {values.max():.4g})"
    return cells


def main() -> None:
    """Parse, run, write after every row."""
    parser = parser_of(__doc__)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--seeds", type=int, default=3)
    arguments = parser.parse_args()
    seeds = "seed 0" if arguments.seeds == 1 else f"seeds 0 to {arguments.seeds - 1}: median (least to most)"
    rows = (row(scene, name, arguments.seeds) for scene in arguments.scenes for name in arguments.cases)
    Sheet("Scenes with known lights", arguments.table, seeds).fill(rows, "")


if __name__ == "__main__":
    main()
