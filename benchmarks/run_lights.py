"""How well flashlights are found: simulated tables with one fault each, and captures scored against their gt/.

    python benchmarks/run_lights.py [--photos 30] [--seeds 1] [--cases CASE...] [--captures CAPTURE@BOARD...]
        [--ways shading phone] [--table FILE]

Errors are in per cent of the light's distance from the object; "inside" is the share of coordinates within 1.96 stated
sigmas. The photos of the simulated cases are those of tests/flashlight_photos.py. The way "phone" is taken where a
capture has photos of the phone that held the light.
"""

import argparse
import json
import resource
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from sheet import Sheet, cpu_of, parser_of

# isort: split
from flashlight_photos import POSED_CAMERA, Recipe, photograph  # pyright: ignore
from one_run import COMMAND

from calibration.calibration import load_calibration
from calibration.flashlight.light_estimate import locate_lights
from reconstruct.evaluate.metrics import load_capture_truth

FAULTS: dict[str, dict[str, float | bool]] = {
    "clean": {},
    "beam 2 % uneven": {"asymmetry": 0.02},
    "beam 4 % uneven": {"asymmetry": 0.04},
    "tone exponent 0.95": {"tone": 0.95},
    "gloss 30 %": {"gloss": 0.3},
    "power varies 3 %": {"power_jitter": 0.03},
    "object lights the ground": {"bounce": 0.3},
    "ambient 5 times": {"ambient": 0.06},
    "board left": {"board": True},
    "grain 5 %": {"noise": 0.05},
    "several": {"asymmetry": 0.02, "gloss": 0.05, "power_jitter": 0.02, "bounce": 0.3, "tone": 1.02},
}


def row(name: str, errors: np.ndarray, inside: np.ndarray, dropped: int, seconds: float) -> dict:
    """One line of the table."""
    measures = np.median(errors), np.percentile(errors, 90), errors.max(), inside.mean()
    named = zip(("median, %", "p90, %", "worst, %", "inside"), map(float, measures), strict=True)
    return {"photos": name, **dict(named), "dropped": dropped, "CPU s": seconds}


def simulated(name: str, photos: int, seeds: int) -> dict:
    """One case over some seeds."""
    errors, inside, dropped, start = [], [], 0, time.process_time()
    for seed in range(seeds):
        truth = photograph(Recipe(n_photos=photos, **FAULTS[name]), seed)  # pyright: ignore[reportArgumentType]
        found = locate_lights(truth.stack, POSED_CAMERA, np.ones(photos, bool)).lights
        used = np.array([light.used for light in found])
        errors.append(100 * truth.errors(found)[used])
        inside.append((np.abs(truth.off(found)) < 1.96 * np.array([light.sigma for light in found]))[used])
        dropped += int((~used).sum())
    return row(name, np.concatenate(errors), np.concatenate(inside), dropped, time.process_time() - start)


def capture(named: str, way: str) -> dict:
    """One capture, calibrated from its photos; compared in the frame of its fixed camera. A refusal has no figures."""
    place, _, board = named.partition("@")
    before = cpu_of(resource.RUSAGE_CHILDREN)
    with tempfile.TemporaryDirectory() as out:
        options = ["--force", "--lights", way, *(["--board", board] if board else [])]
        ended = subprocess.run([*COMMAND, "calibrate", place, "--out", out, *options], check=False, capture_output=True)
        if ended.returncode:
            return {"photos": f"{Path(place).name}, {way}: refused"}
        calibration = load_calibration(Path(out) / "calibration.json")
    spent = cpu_of(resource.RUSAGE_CHILDREN) - before
    truth = load_capture_truth(Path(place), calibration.camera.width, calibration.camera.height)
    given = json.loads((Path(place) / "gt" / "lights.json").read_text())["photos"]
    true_lights = {Path(light["file"]).name: light for light in given}
    world_from_board = calibration.world_from_camera @ truth.posed_camera.world_from_camera.inverse()
    centre = world_from_board.apply(truth.centre())
    errors, inside, turns, dropped, kept = [], [], [], 0, 0
    for light in calibration.lights:
        true = true_lights[light.photo]
        if not light.used or not true["usable"]:
            dropped += true["usable"] and not light.used
            kept += light.used and not true["usable"]
            continue
        expected = world_from_board.apply(np.array(true["position_mm"]))
        off = np.array(light.position) - expected
        errors.append(100 * np.linalg.norm(off) / np.linalg.norm(expected - centre))
        inside.append(np.abs(off) < 1.96 * light.sigma)
        seen, right = np.array(light.position) - centre, expected - centre
        turns.append(np.arctan2(np.linalg.norm(np.cross(seen, right)), seen @ right))
    found = row(f"{Path(place).name}, {way}", np.array(errors), np.array(inside), int(dropped), spent)
    return found | {"direction, degrees": float(np.degrees(np.median(turns))), "bad photos used": int(kept)}


def rows(options: argparse.Namespace) -> Iterator[dict]:
    """Every simulated case, then every capture in the ways it allows."""
    for name in options.cases:
        yield simulated(name, options.photos, options.seeds)
    for named in options.captures:
        for way in options.ways:
            if way != "phone" or (Path(named.partition("@")[0]) / "light").is_dir():
                yield capture(named, way)


def main() -> None:
    """Measure; write after every row."""
    parser = parser_of(__doc__)
    parser.add_argument("--photos", type=int, default=30)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--cases", nargs="*", default=list(FAULTS), choices=list(FAULTS))
    parser.add_argument("--captures", nargs="*", default=[])
    parser.add_argument("--ways", nargs="*", default=["shading"], choices=["shading", "phone"])
    options = parser.parse_args()
    seeds = f"seeds 0 to {options.seeds - 1}"
    Sheet(options.table, seeds).fill(rows(options))


if __name__ == "__main__":
    main()
