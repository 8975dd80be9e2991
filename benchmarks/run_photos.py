"""How good a surface becomes with fewer and fewer photos, chosen so that their lights are well spread.

    python benchmarks/run_photos.py [SUBJECT...] [--counts 3 5 10 20 40] [--preset draft] [--input auto] [--table FILE]

A SUBJECT is a folder, FOLDER@BOARD or `synthetic` (see benchmarks/solves.py); what ships, unless given. Lights are
those of the calibration with all photos. Photos are chosen as a run chooses them that has not memory for all: their
lights far from one another (reconstruct.memory.keep_spread).
"""

import argparse
from dataclasses import replace
from pathlib import Path

import paper
import torch
from sheet import Sheet, down
from solves import SHIPPED, Subject, compared_with, open_subject, score, shown, solve

from capture.errors import ReconstructionError
from reconstruct.memory import keep_spread
from reconstruct.presets import preset


def row(subject: Subject, count: int, named: str, seed: int) -> dict:
    """One solve with so many photos."""
    long_side, config = preset(named, seed)
    begin = {"subject": subject.name, "photos": count}
    try:
        solved, spent = solve(subject, keep_spread(subject.calibration, count), long_side, config)
    except ReconstructionError as error:
        return begin | {"refused": str(error).split(";")[0]}
    return begin | shown(score(solved, subject)) | {"CPU s": spent}


def main() -> None:
    """Parse, solve, write after every row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("subjects", nargs="*", default=SHIPPED)
    parser.add_argument("--counts", nargs="+", type=int, default=[3, 5, 10, 20, 40])
    parser.add_argument("--preset", default="draft", choices=["draft", "standard", "fine"])
    parser.add_argument("--input", default="auto", choices=["auto", "rgb", "shadow"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--table", type=Path, help="write the table here as well")
    options = parser.parse_args()
    torch.set_num_threads(1)
    note = f"Preset {options.preset}, input {options.input}, lights well spread, one solve each."
    title = "Number of photos" + (", shadow pictures" if options.input == "shadow" else "")
    sheet, rows = Sheet(title, options.table, f"seed {options.seed}", note), []
    for named in options.subjects:
        subject = open_subject(named, options.input, options.preset)
        if not subject.has_truth():
            long_side, config = preset(options.preset, options.seed)
            subject = compared_with(subject, solve(subject, subject.calibration, long_side, config)[0])
            subject = replace(subject, name=f"{subject.name}, against all photos")
        most = sum(light.used for light in subject.calibration.lights)
        for count in sorted({min(count, most) for count in options.counts}):
            depth, normals = paper.PHOTOS.get(count, (None, None))
            printed = {"paper's Chair: depth": depth, "paper's Chair: normals, deg": normals}
            rows.append(row(subject, count, options.preset, options.seed) | printed)
            sheet.write(down(rows, "subject"))


if __name__ == "__main__":
    main()
