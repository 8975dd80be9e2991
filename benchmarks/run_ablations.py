"""What each part of the method is worth: the default solver with one part left out.

    python benchmarks/run_ablations.py [SUBJECT...] [--preset draft] [--input shadow] [--table FILE]

A SUBJECT is a folder, FOLDER@BOARD or `synthetic` (see benchmarks/solves.py); `synthetic` unless given. "no hull": the
solve starts from the whole box in which the hull lies, of which nothing has been carved.
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace

from sheet import Sheet
from solves import INPUTS, SYNTHETIC, open_subject, outcome, parsed, solve_parser, with_truth

from reconstruct.config import FitConfig
from reconstruct.run.presets import preset, without

PARTS = ("full", "intersection", "boundary", "foreground-only", "background-only", "no hull")
NEVER = 10_000  # votes that must prove a node empty: more than there are lights
PRINTED = {  # depth L1 and normal error, degrees, without the same [ShadowNeuS, tab:ablation_study, tab:fore_back]
    "full": (0.1341, 15.03),
    "intersection": (0.2569, 18.01),
    "boundary": (0.3552, 28.44),
    "background-only": (0.05827, 29.93),
    "foreground-only": (0.13569, 23.94),
}


def settings(part: str, named: str, seed: int) -> tuple[int, FitConfig]:
    """The longer side, px, and the solver's settings without a part."""
    long_side, config = preset(named, seed)
    if part == "no hull":
        return long_side, replace(config, votes=NEVER)
    return long_side, without(config, None if part == "full" else part)


def rows(options: argparse.Namespace) -> Iterator[dict]:
    """One solve for each subject and part."""
    for named in options.subjects:
        subject = with_truth(open_subject(named, options.input, options.preset), options.preset, options.seed)
        for part in options.parts:
            solved = outcome(subject, subject.calibration, *settings(part, options.preset, options.seed))
            depth, normals = PRINTED.get(part, (None, None))
            printed = {"paper: depth": depth, "paper: normals, deg": normals}
            yield {"without": "nothing" if part == "full" else part} | solved | printed


def main() -> None:
    """Parse, solve, write after every row."""
    parser = solve_parser(__doc__, [SYNTHETIC])
    parser.add_argument("--input", default="shadow", choices=INPUTS)
    parser.add_argument("--parts", nargs="*", default=PARTS, choices=PARTS)
    options = parsed(parser)
    Sheet(options.table, f"seed {options.seed}").fill(rows(options))


if __name__ == "__main__":
    main()
