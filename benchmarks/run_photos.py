"""How good a surface becomes with fewer and fewer photos, chosen so that their lights are well spread.

    python benchmarks/run_photos.py [SUBJECT...] [--counts 3 5 10 20 40] [--preset draft] [--input auto] [--table FILE]

A SUBJECT is a folder, FOLDER@BOARD or `synthetic` (see benchmarks/solves.py); what ships, unless given. Lights are
those of the calibration with all photos. Photos are chosen as a run chooses them that has not memory for all: their
lights far from one another (reconstruct.source.memory.keep_spread).
"""

import argparse
from collections.abc import Iterator

import paper
from sheet import Sheet
from solves import INPUTS, SHIPPED, open_subject, outcome, parsed, solve_parser, with_truth

from reconstruct.run.presets import preset
from reconstruct.source.memory import keep_spread


def rows(options: argparse.Namespace) -> Iterator[dict]:
    """One solve for each subject and number of photos."""
    settings = preset(options.preset, options.seed)
    for named in options.subjects:
        subject = with_truth(open_subject(named, options.input, options.preset), options.preset, options.seed)
        most = sum(light.used for light in subject.calibration.lights)
        for count in sorted({min(count, most) for count in options.counts}):
            depth, normals = paper.PHOTOS.get(count, (None, None))
            printed = {"paper's Chair: depth": depth, "paper's Chair: normals, deg": normals}
            solved = outcome(subject, keep_spread(subject.calibration, count), *settings)
            yield {"subject": subject.name, "photos": count} | solved | printed


def main() -> None:
    """Parse, solve, write after every row."""
    parser = solve_parser(__doc__, SHIPPED)
    parser.add_argument("--counts", nargs="+", type=int, default=[3, 5, 10, 20, 40])
    parser.add_argument("--input", default="auto", choices=INPUTS)
    options = parsed(parser)
    note = f"Preset {options.preset}, input {options.input}, lights well spread, one solve each."
    title = "Number of photos" + (", shadow pictures" if options.input == "shadow" else "")
    Sheet(title, options.table, f"seed {options.seed}", note).fill(rows(options), "subject")


if __name__ == "__main__":
    main()
