"""A thousand damaged pictures and five hundred damaged scene files: is each read, or refused by name?

    python benchmarks/soak/fuzz_files.py [--pictures 1000] [--scenes 500] [--seed 0] [--table FILE]

Pictures are those of tests/fuzz_images.py. Scene files are those of a scene with known lights, of files of lights, of
settings and of results, one of which is cut, changed in some bytes or, where it is JSON, in one value. Each batch is
read in a process of its own under a limit of memory and time. Exit code 1 for any traceback,
crash, hang or flood, and for a refusal that does not name its file.
"""

import argparse
import json
import random
import resource
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from sheet import ROOT, Sheet, parser_of

# isort: split
from confined import limited  # pyright: ignore[reportMissingImports]
from dataset_folders import write_shadowneus  # pyright: ignore[reportMissingImports]
from fuzz_images import DAMAGES, fuzzed  # pyright: ignore[reportMissingImports]
from synthetic import BALL, Look, render  # pyright: ignore[reportMissingImports]

from calibration.calibration import load_calibration, save_calibration
from calibration.lights.files import read_lights
from capture.errors import UserError
from capture.photos.photo import read_photo
from capture.session.session import load_settings
from reconstruct.fields import load_fields, save_fields
from reconstruct.solve.checkpoint import load_state
from reconstruct.source.calibrate_source import calibrate_source
from reconstruct.source.photos import read_photos
from reconstruct.source.source import RunOptions, open_source

BATCH = 250
ROOM = 1_500_000_000  # bytes beyond what the process has after its imports: below 2 GB together
VALUES = (None, True, -1, 0, 1e308, float("nan"), "x" * 300, "../../etc/passwd", [], {}, [[1]], 2**70)


def corrupted_json(draw: random.Random, text: str) -> str:
    """One value somewhere is exchanged or goes."""
    document = json.loads(text)
    here = document
    while True:
        keys = list(here) if isinstance(here, dict) else list(range(len(here)))
        if not keys:
            return json.dumps(document)
        key = draw.choice(keys)
        if isinstance(here[key], dict | list) and here[key] and draw.random() < 0.7:
            here = here[key]
            continue
        if draw.random() < 0.3:
            del here[key]
        else:
            here[key] = draw.choice(VALUES)
        return json.dumps(document)


def make_scene(folder: Path) -> list[Path]:
    """A scene, a calibration, settings and solved fields; the files that may be damaged."""
    from fake_run import fields_of, make_truth  # pyright: ignore[reportMissingImports]

    truth = render((BALL,), Look(width=24, height=18, n_lights=4))[1]
    write_shadowneus(folder, truth)
    own = folder.with_name("own")
    save_calibration(truth.calibration, own / "calibration.json")
    save_fields(fields_of(make_truth(width=32, n_lights=4)), own / "fields.safetensors")
    (own / "session.toml").write_text('board = "checkerboard:9x6:24"\nled_offset_mm = [1, 2, 3]\n')
    (own / "lights.lp").write_text("4\n" + "".join(f"r_{i:03d}.png 0.{i} 0.1 0.9\n" for i in range(4)))
    np.savez(own / "params.npz", light_pose=np.tile(np.eye(4), (4, 1, 1)), camera_pose=np.eye(4), floor_height=-1.0)
    names = ("calibration.json", "session.toml", "fields.safetensors", "lights.lp", "params.npz")
    scene = ("transforms_train.json", "transforms_floor.json", "train/r_001.png")
    return [*(folder / name for name in scene), *(own / name for name in names)]


def read_scene(folder: Path, file: Path) -> None:
    """Whatever the product reads such a file for."""
    if file.name == "calibration.json":
        load_calibration(file)
    elif file.name == "session.toml":
        load_settings(file.parent)
    elif file.name == "fields.safetensors":
        load_fields(file)
        load_state(file, "any")
    elif file.suffix in (".lp", ".npz"):
        known = load_calibration(file.with_name("calibration.json"))
        read_lights(file, [f"r_{i:03d}.png" for i in range(4)], known.posed_camera)
    else:
        options = RunOptions()
        source = open_source(folder, options)
        calibrate_source(source, read_photos(source, options), options)


def verdict(read, path: Path, folder: Path) -> str:
    """What became of one file."""
    start = time.monotonic()
    try:
        with limited(folder, ROOM) as watch:
            read()
        found = "read"
    except UserError as error:
        found = "refused" if path.name in str(error) else f"refused without its name: {error}"
        found = found if "\n" not in str(error) else f"several lines: {error}"
    except MemoryError:
        found = "flood of memory"
    except TimeoutError:
        found = "hang"
    except Exception as error:  # noqa: BLE001  whatever else is raised is what this script looks for
        found = f"traceback: {error!r:.200}"
    if watch_is_bad := [*watch.ran, *watch.written]:
        found = f"reached out: {watch_is_bad[:2]}"
    return f"{found}\t{time.monotonic() - start:.2f}\t{path.name}"


def batch(kind: str, first: int, count: int, seed: int) -> None:
    """Read some files and print what became of each."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if kind == "pictures":
            for path in fuzzed(folder, count, f"{seed} {first}"):
                print(verdict(lambda path=path: read_photo(path), path, folder), flush=True)
            return
        files = make_scene(folder / "scene")
        for number in range(first, first + count):
            draw = random.Random(f"{seed} {number}")
            file = draw.choice(files)
            before = file.read_bytes()
            if file.suffix == ".json" and draw.random() < 0.7:
                file.write_text(corrupted_json(draw, before.decode()))
            else:
                file.write_bytes(draw.choice(DAMAGES)(draw, before))
            print(verdict(lambda file=file: read_scene(folder / "scene", file), file, folder), flush=True)
            file.write_bytes(before)
    print(f"peak\t{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss}\t", flush=True)


def run_batches(kind: str, total: int, seed: int) -> tuple[Counter[str], float, int]:
    """Counts by verdict, the longest time in seconds, and the largest process in bytes."""
    counts, slowest, largest = Counter[str](), 0.0, 0
    for first in range(0, total, BATCH):
        count = min(BATCH, total - first)
        words = [sys.executable, __file__, "--batch", kind, str(first), str(count), "--seed", str(seed)]
        done = subprocess.run(words, capture_output=True, text=True, cwd=ROOT)
        rows = [line.split("\t") for line in done.stdout.splitlines() if line.count("\t") == 2]
        for found, seconds, name in rows:
            if found == "peak":
                largest = max(largest, 1024 * int(seconds))
                continue
            counts[found] += 1
            slowest = max(slowest, float(seconds))
            if found not in ("read", "refused"):
                print(f"{kind}: {name}: {found}", flush=True)
        if done.returncode:
            counts[f"crash, code {done.returncode}"] += 1
            print(f"{kind} {first}: {done.stderr[-500:]}", flush=True)
    return counts, slowest, largest


def main() -> int:
    """Print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("--pictures", type=int, default=1000)
    parser.add_argument("--scenes", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--batch", nargs=3, metavar=("KIND", "FIRST", "COUNT"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.batch:
        batch(options.batch[0], int(options.batch[1]), int(options.batch[2]), options.seed)
        return 0
    sheet, rows, is_well = Sheet(options.table, f"seed {options.seed}"), [], True
    for kind in ("pictures", "scenes"):
        counts, slowest, _ = run_batches(kind, getattr(options, kind), options.seed)
        others = sum(counts.values()) - counts["read"] - counts["refused"]
        is_well &= others == 0
        row = {"files": kind, "read": counts["read"], "refused by name": counts["refused"]}
        rows.append(row | {"anything else": others, "slowest s": slowest})
        sheet.write(rows)
    return int(not is_well)


if __name__ == "__main__":
    sys.exit(main())
