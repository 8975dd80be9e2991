"""How well flashlights are found: simulated tables with one fault each, and captures scored against their gt/.

    python benchmarks/run_lights.py [--photos 30] [--seeds 1] [--cases CASE...] [--captures CAPTURE@BOARD...]

Errors are in per cent of the light's distance from the object; "inside" is the share of coordinates within 1.96 stated
sigmas. The photos of the simulated cases are those of tests/flashlight_photos.py.
"""

import argparse
import json
import resource
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
from sheet import Sheet, table

# isort: split
from flashlight_photos import CAMERA, WORLD_FROM_CAMERA, Recipe, photograph  # pyright: ignore
from one_run import COMMAND

from calibration.pose import Pose
from calibration.result import load_calibration
from calibration.shading import locate_lights

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


def row(name: str, errors: np.ndarray, inside: np.ndarray, dropped: int, seconds: float) -> list[object]:
    """One line of the table."""
    measures = (np.median(errors), np.percentile(errors, 90), errors.max(), inside.mean())
    return [name, *(float(measure) for measure in measures), dropped, seconds]


def simulated(name: str, photos: int, seeds: int) -> list[object]:
    """One case over some seeds."""
    errors, inside, dropped, start = [], [], 0, time.process_time()
    for seed in range(seeds):
        truth = photograph(Recipe(n_photos=photos, **FAULTS[name]), seed)  # pyright: ignore[reportArgumentType]
        found = locate_lights(truth.stack, CAMERA, WORLD_FROM_CAMERA, np.ones(photos, bool)).lights
        used = np.array([light.used for light in found])
        errors.append(100 * truth.errors(found)[used])
        inside.append((np.abs(truth.off(found)) < 1.96 * np.array([light.sigma for light in found]))[used])
        dropped += int((~used).sum())
    return row(name, np.concatenate(errors), np.concatenate(inside), dropped, time.process_time() - start)


def capture(named: str, way: str) -> list[object]:
    """One capture, calibrated from its photos; compared in the frame of its fixed camera."""
    place, _, board = named.partition("@")
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with tempfile.TemporaryDirectory() as out:
        options = ["--force", "--lights", way, *(["--board", board] if board else [])]
        subprocess.run([*COMMAND, "calibrate", place, "--out", out, *options], check=True, capture_output=True)
        calibration = load_calibration(Path(out) / "calibration.json")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    gt = Path(place) / "gt"
    given = json.loads((gt / "camera.json").read_text())
    camera_from_truth = Pose.from_matrix(np.array(given["stored"]["T_cam_from_board"]))
    true_lights = {Path(x["file"]).name: x for x in json.loads((gt / "lights.json").read_text())["photos"]}
    maps = np.load(gt / "maps.npz", allow_pickle=False)
    distance = float(np.median(maps["depth_mm"][maps["mask"]]))
    centre = calibration.world_from_camera.apply(np.array([0.0, 0.0, distance]))  # roughly the object
    errors, inside, dropped = [], [], 0
    for light in calibration.lights:
        truth = true_lights[light.photo]
        if not light.used or not truth["usable"]:
            dropped += truth["usable"] and not light.used
            continue
        expected = calibration.world_from_camera.apply(camera_from_truth.apply(np.array(truth["position_mm"])))
        off = np.array(light.position) - expected
        errors.append(100 * np.linalg.norm(off) / np.linalg.norm(expected - centre))
        inside.append(np.abs(off) < 1.96 * light.sigma)
    return row(f"{Path(place).name}, {way}", np.array(errors), np.array(inside), int(dropped), spent)


def main() -> None:
    """Measure and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=int, default=30)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--cases", nargs="*", default=list(FAULTS), choices=list(FAULTS))
    parser.add_argument("--captures", nargs="*", default=[])
    parser.add_argument("--ways", nargs="*", default=["shading"], choices=["shading", "phone"])
    parser.add_argument("--table", type=Path, help="write the table here as well")
    options = parser.parse_args()
    note = "Errors in per cent of the light's distance; inside: share of coordinates within 1.96 stated sigmas."
    sheet = Sheet("Flashlights", options.table, f"{options.seeds} seeds from 0", note)
    rows = [simulated(name, options.photos, options.seeds) for name in options.cases]
    rows += [capture(named, way) for named in options.captures for way in options.ways]
    sheet.write(table(["", "median, %", "p90, %", "worst, %", "inside", "dropped", "CPU s"], rows))


if __name__ == "__main__":
    main()
