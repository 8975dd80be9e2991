"""Generate captures such as people bring, run them from nothing, score them, and write a Markdown table.

    python benchmarks/run_generated.py OUT [--only NAME...] [--table FILE] [-- OPTIONS OF shadowgraph run]

Each capture goes to OUT/captures/NAME (kept, and used again if it is there), each run to OUT/runs/NAME. Needs the extra
`generator`; the captures and their truth come from examples/make_capture.py.
"""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from one_run import own_and_passed_on, run
from sheet import ROOT, Sheet, across, parser_of

CHARUCO, CHECKERBOARD = "charuco:5x7:30:22:DICT_4X4_50", "checkerboard:9x6:24.25"
COMMON = "--width 800 --photos 24 --samples 4"
CASES = {  # name: what is unusual about it, and the settings that make it so
    "table": ("thin legs, matt, wooden table", "--shape table"),
    "jug": (
        "hollow, a handle; a checkerboard stays beside it on cloth",
        f"--shape vase --board {CHECKERBOARD} --board-stays --table cloth --albedo 0.6 0.6 0.55 --gloss 0.2",
    ),
    "figurine": (
        "glossy paint in two colours, stone table",
        "--shape figurine --paint spots --gloss 0.5 --roughness 0.2 --albedo 0.6 0.25 0.2 --table stone",
    ),
    "dark": ("albedo 0.08 on a light plain table", "--shape vase --albedo 0.08 0.08 0.07 --table plain --turn 200"),
    "relief": (
        "low and wide, camera from above, low lights",
        "--shape relief --elevation 68 --height 10 45 --table cloth --albedo 0.55 0.5 0.4",
    ),
    "tower": (
        "0.7 times as high as the camera, which looks flat; checkerboard",
        f"--shape tower --elevation 28 --distance 720 --board {CHECKERBOARD} --paint two-tone",
    ),
    "chair": (
        "thin legs and slats, flashlight on one half only, some room light",
        "--shape chair --around -20 160 --ambient 0.08 --table stone --albedo 0.7 0.55 0.4",
    ),
    "boxes": (
        "flat faces, over-exposed, tripod pushed during photo 7",
        "--shape boxes --exposure 1.5 --moved 7 --table plain --albedo 0.7 0.7 0.68 --turn 35",
    ),
    "bowl": (
        "white, glossy and hollow: light goes from wall to wall",
        "--shape bowl --albedo 0.8 0.78 0.72 --gloss 0.6 --roughness 0.15 --table cloth --elevation 50 --seed 12",
    ),
    "disc": (
        "7 mm high, 60 px wide, of the colour of the wood under it, low lights",
        "--shape disc --albedo 0.6 0.5 0.3 --table wood --elevation 55 --height 12 50 --focal 60 --seed 15",
    ),
}
SHOWN = (
    "exit",
    "seconds",
    "cpu_seconds",
    "peak_memory_gib",
    "focal_error_pct",
    "ground_normal_deg",
    "ground_depth_pct",
    "photos_scored",
    "bad_photos_used",
    "good_photos_dropped",
    "light_median_pct",
    "light_p90_pct",
    "light_direction_median_deg",
    "mask_iou",
    "depth_mae_mm",
    "depth_median_mm",
    "normal_mae_deg",
    "precision",
    "recall",
    "hidden_recall",
    "fscore_2pct",
    "chamfer_mm",
    "not scored",
)


def generate(name: str, folder: Path) -> Path:
    """The capture of that name, rendered unless it is there."""
    capture = folder / name
    if not (capture / "gt" / "lights.json").exists():
        settings = [*COMMON.split(), *CASES[name][1].split()]
        command = [sys.executable, str(ROOT / "examples" / "make_capture.py"), str(capture), *settings]
        subprocess.run(command, check=True, env=os.environ | {"PYTHONPATH": str(ROOT)})
    return capture


def rows(parsed: argparse.Namespace, options: list[str]) -> Iterator[dict]:
    """One run for each capture."""
    for name in parsed.only:
        capture = generate(name, parsed.out / "captures")
        board = json.loads((capture / "gt" / "board.json").read_text())["spec"]  # what a user would name
        row = run(f"{capture}@{board}", parsed.out / "runs", options)
        yield {key: row[key] for key in ("capture", *SHOWN) if key in row}


def main() -> None:
    """Generate, run, score, write after every run."""
    arguments, options = own_and_passed_on()
    parser = parser_of(__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--only", nargs="+", choices=CASES, default=list(CASES), metavar="NAME")
    parsed = parser.parse_args(arguments)
    cases = [f"- {name}: {CASES[name][0]} (`{CASES[name][1]}`)" for name in parsed.only]
    note = "\n".join([f"Captures of `make_capture.py {COMMON}`.", "", *cases])
    sheet = Sheet("Captures such as people bring", parsed.table, "one capture and one run each, seed 0", note)
    sheet.fill(rows(parsed, options), "capture", across)


if __name__ == "__main__":
    main()
