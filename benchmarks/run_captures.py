"""Whole runs of captures and scenes from nothing: accuracy against their gt/, time and memory.

    python benchmarks/run_captures.py [CAPTURE...] [--presets draft standard fine] [--out DIR] [--table FILE]
        [-- OPTIONS OF shadowgraph run]

CAPTURE@BOARD names the board of a capture that does not say it, as in bunny@checkerboard:9x6:24.25; examples/spot
unless given. Each runs in its own process, without a page; `shadowgraph evaluate` scores it.
"""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path

from one_run import SPOT, own_and_passed_on, run
from sheet import Sheet, parser_of

MEASURES = {  # what a table shows, by the names that `evaluate` has for it
    "lights, %": "light_median_pct",
    "depth": "depth_mae",
    "normals, deg": "normal_mae_deg",
    "IoU": "mask_iou",
    "F": "fscore",
    "hidden": "hidden_recall",
    "bad photos used": "bad_photos_used",
}
STAGES = ("capture", "calibrate", "solve", "mesh", "detail")


def rows(parsed: argparse.Namespace, options: list[str]) -> Iterator[dict]:
    """One run for each capture and preset."""
    for capture in parsed.captures:
        for preset in parsed.presets:
            found = run(capture, parsed.out / preset, ["--preset", preset, *options])
            row = {"capture": found["capture"], "preset": preset} | ({"exit": found["exit"]} if found["exit"] else {})
            row |= {name: found.get(key) for name, key in MEASURES.items()}
            if not found["exit"]:
                report = json.loads((parsed.out / preset / found["capture"] / "report.json").read_text())["stages"]
                row |= {f"{name}, CPU s": report[name]["cpu_seconds"] for name in STAGES if name in report}
            yield row | {"CPU s": found["cpu_seconds"], "s": found["seconds"], "GiB": found.get("peak_memory_gib")}


def main() -> None:
    """Parse, run, write after every run."""
    arguments, options = own_and_passed_on()
    parser = parser_of(__doc__)
    parser.add_argument("captures", nargs="*", default=[str(SPOT)])
    parser.add_argument("--presets", nargs="+", default=["standard"], choices=["draft", "standard", "fine"])
    parser.add_argument("--out", type=Path, default=Path("runs/benchmark"))
    parsed = parser.parse_args(arguments)
    Sheet(parsed.table, "seed 0 unless the options say another").fill(rows(parsed, options))


if __name__ == "__main__":
    main()
