"""Run captures and scenes from nothing and write what came out as a Markdown table.

    python benchmarks/run_captures.py [CAPTURE...] [--presets draft standard fine] [--out DIR] [--table FILE]
        [-- OPTIONS OF shadowgraph run]

CAPTURE@BOARD names the board of a capture that does not say it, as in bunny@checkerboard:9x6:24.25; examples/spot
unless given. Each runs in its own process, without a page. Where a folder has a gt/, `shadowgraph evaluate` scores
the result.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

from one_run import SPOT, own_and_passed_on, run
from sheet import Sheet, across, parser_of


def rows(parsed: argparse.Namespace, options: list[str]) -> Iterator[dict]:
    """One run for each capture and preset."""
    for capture in parsed.captures:
        for preset in parsed.presets:
            row = run(capture, parsed.out / preset, ["--preset", preset, *options])
            yield row | {"capture": f"{row['capture']}, {preset}"} if len(parsed.presets) > 1 else row


def main() -> None:
    """Parse, run, write after every run."""
    arguments, options = own_and_passed_on()
    parser = parser_of(__doc__)
    parser.add_argument("captures", nargs="*", default=[str(SPOT)])
    parser.add_argument("--presets", nargs="+", default=["standard"], choices=["draft", "standard", "fine"])
    parser.add_argument("--out", type=Path, default=Path("runs/benchmark"))
    parsed = parser.parse_args(arguments)
    sheet = Sheet("Captures and scenes, whole runs", parsed.table, "seed 0 unless the options say another")
    sheet.fill(rows(parsed, options), "capture", across)


if __name__ == "__main__":
    main()
