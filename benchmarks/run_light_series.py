"""What joint refinement of the lights does to captures and scenes whose lights are more and more wrong.

    python benchmarks/run_light_series.py FOLDER... [--errors 0 0.01 0.03 0.05 0.1] [--preset draft] [--out DIR]

FOLDER@BOARD names the board of a capture that does not say it. Each folder is calibrated once. Then every light is
moved from its calibrated place by `error` times its distance in a random direction of its own (a direction is turned by
as many radians), its stated sigma grows to match, and the surface is solved twice, with the settings of a preset: with
the lights held, and with joint refinement. Both are scored as `shadowgraph evaluate` does.
"""

import argparse
import dataclasses
import json
import sys
import time
from pathlib import Path

import numpy as np
import torch
from run_captures import ROOT, machine, publish

sys.path[:0] = [str(ROOT)]
from calibration.light import Light  # noqa: E402
from calibration.result import Calibration, load_calibration, save_calibration  # noqa: E402
from calibration.source import Pictures, RunOptions, calibrate_source, open_source, read_pictures  # noqa: E402
from reconstruct.fields import Fields  # noqa: E402
from reconstruct.mesh import extract_mesh  # noqa: E402
from reconstruct.metrics import evaluate  # noqa: E402
from reconstruct.presets import preset  # noqa: E402
from reconstruct.scene import build_scene  # noqa: E402
from reconstruct.solver import fit  # noqa: E402
from reconstruct.view import surface_maps  # noqa: E402

SAMPLES = 20_000  # points on each surface: the F-score repeats to 0.003
COLUMNS = {  # of the table: a capture's measure, a scene's
    "depth": ("depth_mae_mm", "depth_l1_raw"),
    "normals, deg": ("normal_mae_deg", "normal_mae_deg"),
    "F": ("fscore_2pct", "fscore"),
}


def silent(*, stage, done, total, message, numbers, surface):
    """A Report that says nothing."""


def moved(calibration: Calibration, middle: np.ndarray, error: float, stated: float, seed: int) -> Calibration:
    """The calibration with every light off by `error` of its distance from `middle`, and said to be off by `stated`."""
    rng = np.random.default_rng(seed)
    lights = []
    for light in calibration.lights:
        by = rng.standard_normal(3)
        if light.direction is not None:
            by -= (by @ light.direction) * light.direction
        distance = 1.0 if light.position is None else float(np.linalg.norm(light.position - middle))
        by *= error * distance / np.linalg.norm(by)
        sigma = np.sqrt(light.sigma**2 + (stated * distance) ** 2 / 3)
        lights.append(_displaced(light, by, sigma))
    return dataclasses.replace(calibration, lights=tuple(lights))


def _displaced(light: Light, by: np.ndarray, sigma: np.ndarray) -> Light:
    if light.position is not None:
        return dataclasses.replace(light, position=light.position + by, sigma=sigma)
    assert light.direction is not None
    turned = light.direction + by
    return dataclasses.replace(light, direction=turned / np.linalg.norm(turned), sigma=sigma)


def looked_at(calibration: Calibration) -> np.ndarray:
    """Where the optical axis meets the ground, world."""
    eye, forward = calibration.world_from_camera.translation, calibration.world_from_camera.rotation[:, 2]
    return eye + forward * (calibration.ground_height - eye[2]) / forward[2]


def with_lights(calibration: Calibration, solved: Fields) -> Calibration:
    """The calibration with its used lights where the solve left them."""
    assert solved.lights is not None
    places = iter(solved.lights.double().numpy())
    lights = []
    for light in calibration.lights:
        if light.used:
            place = next(places)[:3]
            key = "direction" if light.position is None else "position"
            light = dataclasses.replace(light, **{key: place})
        lights.append(light)
    return dataclasses.replace(calibration, lights=tuple(lights))


def solve(pictures: Pictures, calibration: Calibration, named: str, refine: bool, seed: int) -> tuple[Fields, float]:
    """One solve, and its CPU seconds."""
    start = time.process_time()
    long_side, config = preset(named, seed)
    scene = build_scene(pictures.stack, calibration, long_side, pictures.shadow, pictures.mask)
    solved = fit(scene, dataclasses.replace(config, refine_lights=refine), silent)
    return solved, time.process_time() - start


def score(solved: Fields, calibration: Calibration, folder: Path, out: Path) -> dict:
    """What `shadowgraph evaluate` says of a solved scene, which is left in a folder."""
    out.mkdir(parents=True, exist_ok=True)
    save_calibration(calibration, out / "calibration.json")
    extract_mesh(solved).export(out / "mesh.ply")
    maps = surface_maps(solved.grid, solved.ground_height, calibration.camera, calibration.world_from_camera)
    mask = maps.mask.numpy()
    np.save(out / "depth.npy", np.where(mask, maps.depth.numpy(), np.inf).astype(np.float32))
    np.save(out / "normal.npy", np.where(mask[..., None], maps.normals.numpy(), 0).astype(np.float32))
    import cv2

    cv2.imwrite(str(out / "mask.png"), np.where(mask, 255, 0).astype(np.uint8))
    return evaluate(out, folder, SAMPLES)


def light_error(found: Calibration, true: Calibration, middle: np.ndarray) -> tuple[float, float]:
    """Median distance of the used lights from given ones: per cent of their distance from `middle`, and degrees."""
    off, turned = [], []
    for light, other in zip(found.lights, true.lights, strict=True):
        if light.used:
            a, b = (x.homogeneous()[:3] - x.homogeneous()[3] * middle for x in (light, other))
            off.append(100 * np.linalg.norm(a - b) / np.linalg.norm(b))
            cosine = a @ b / np.linalg.norm(a) / np.linalg.norm(b)
            turned.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    return float(np.median(off)), float(np.median(turned))


def series(named: str, options: argparse.Namespace) -> list[str]:
    """The rows of one folder."""
    place, _, board = named.partition("@")
    folder = Path(place)
    given = RunOptions(board=board or None, preset=options.preset)
    source = open_source(folder, given)
    pictures = read_pictures(source, given)
    kept = options.out / folder.name / "calibration.json"
    if not kept.exists():
        kept.parent.mkdir(parents=True, exist_ok=True)
        save_calibration(calibrate_source(source, pictures, given), kept)
    calibration = load_calibration(kept)
    middle, rows = looked_at(calibration), []
    for error in options.errors:
        stated = error if options.stated is None else options.stated
        wrong = moved(calibration, middle, error, stated, options.seed)
        for refine in (False, True) if options.only is None else (options.only == "refined",):
            solved, cpu_s = solve(pictures, wrong, options.preset, refine, options.seed)
            found = with_lights(wrong, solved)
            name = f"{100 * error:g}_{'refined' if refine else 'held'}"
            numbers = score(solved, found, folder, options.out / folder.name / name)
            lights = light_error(found, calibration, middle)
            if "light_median_pct" in numbers:  # a capture: against the true ones, not the calibrated ones
                lights = (numbers["light_median_pct"], numbers["light_direction_median_deg"])
            step = light_error(found, wrong, middle)[0]
            cells = [numbers.get(a, numbers.get(b)) for a, b in COLUMNS.values()]
            shown = [folder.name, f"{100 * error:g} %", "refined" if refine else "held"]
            shown += [f"{x:.4g}" for x in (*lights, step, *cells, cpu_s)]
            rows.append("| " + " | ".join(shown) + " |")
            if solved.light_trial is not None:
                print(solved.light_trial.sentence(), flush=True)
            print(rows[-1], json.dumps(numbers, default=str) if options.verbose else "", flush=True)
    return rows


def main() -> None:
    """Parse, solve, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+")
    parser.add_argument("--errors", nargs="+", type=float, default=[0, 0.01, 0.03, 0.05, 0.1])
    parser.add_argument("--preset", default="draft", choices=["draft", "standard", "fine"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--stated", type=float, help="the error that the lights' sigmas tell; as moved unless given")
    parser.add_argument("--only", choices=["held", "refined"])
    parser.add_argument("--verbose", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("runs/light_series"))
    parser.add_argument("--table", type=Path, help="write the table here as well")
    options = parser.parse_args()
    torch.set_num_threads(1)
    head = ["folder", "moved by", "lights", "off, %", "off, deg", "moved back, %", *COLUMNS, "CPU s"]
    lines = [*machine(), "", "| " + " | ".join(head) + " |", "|---|---|---|" + "---:|" * (len(head) - 3)]
    for named in options.folders:
        lines += series(named, options)
    publish("\n".join(lines) + "\n", options.table)


if __name__ == "__main__":
    main()
