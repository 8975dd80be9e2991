"""What each part of the method is worth: the default solver with one part left out, and a trained field likewise.

    python benchmarks/run_ablations.py [SUBJECT...] [--preset draft] [--input shadow] [--seconds 15] [--table FILE]

A SUBJECT is a folder, FOLDER@BOARD or `synthetic` (see benchmarks/solves.py); `synthetic` unless given. "no hull": the
solve starts from the whole box in which the hull lies, of which nothing has been carved. The paper's expected depth and
sampled visibility exist in trained fields alone: a trainable grid, in miniature (benchmarks/run_fields.py), gets
--seconds of CPU for each; 0 leaves these rows out.
"""

from dataclasses import replace

import paper
from run_fields import MINIATURE, MINIATURE_PIXELS, RATES, trained
from sheet import Sheet, down
from solves import (
    INPUTS,
    SYNTHETIC,
    Subject,
    open_subject,
    outcome,
    parsed,
    scene_of,
    score,
    shown,
    solve_parser,
    with_truth,
)

from reconstruct.config import FitConfig
from reconstruct.run.presets import preset, without
from reconstruct.shadowneus.config import ablated

SOLVER = ("full", "intersection", "boundary", "foreground-only", "background-only", "no hull")
TRAINED = ("full", "intersection", "boundary", "expected-depth", "telescoped", "foreground-only", "background-only")
NEVER = 10_000  # votes that must prove a node empty: more than there are lights
FIELD = "grid"


def settings(part: str, named: str, seed: int) -> tuple[int, FitConfig]:
    """The longer side, px, and the solver's settings without a part."""
    long_side, config = preset(named, seed)
    if part == "no hull":
        return long_side, replace(config, votes=NEVER)
    return long_side, without(config, None if part == "full" else part)


def printed(part: str) -> dict:
    """What the paper says of leaving out the same: mean over its scenes, and its Lego for the kinds of shadow."""
    table = paper.SUPERVISED if part.endswith("-only") else paper.ABLATIONS
    depth, normals = table.get(part, (None, None))
    return {"paper: depth": depth, "paper: normals, deg": normals}


def solver_row(subject: Subject, part: str, named: str, seed: int) -> dict:
    """The default solver without a part."""
    solved = outcome(subject, subject.calibration, *settings(part, named, seed))
    return {"": part, "subject": subject.name} | solved | printed(part)


def trained_row(subject: Subject, part: str, seconds: float, seed: int) -> dict:
    """A trainable grid without a part, in miniature."""
    scene = scene_of(subject, subject.calibration, MINIATURE_PIXELS)
    config = replace(MINIATURE, seed=seed, field=FIELD, learning_rate=RATES[FIELD])
    config = config if part == "full" else ablated(config, part)
    solved, spent, iterations = trained(scene, config, seconds)
    begin = {"": "full, sampled" if part == "full" else part, "subject": subject.name, "iterations": iterations}
    return begin | shown(score(solved, subject)) | {"CPU s": spent}


def main() -> None:
    """Parse, solve, write after every row."""
    parser = solve_parser(__doc__, [SYNTHETIC])
    parser.add_argument("--input", default="shadow", choices=INPUTS)
    parser.add_argument("--parts", nargs="*", default=SOLVER, choices=SOLVER)
    parser.add_argument("--seconds", type=float, default=15.0, help="CPU seconds of each trained field")
    options = parsed(parser)
    note = f"Preset {options.preset}, input {options.input}; each row leaves out what it names."
    sheet = Sheet("Ablations", options.table, f"seed {options.seed}", note)
    solver, small = [], []
    for named in options.subjects:
        subject = with_truth(open_subject(named, options.input, options.preset), options.preset, options.seed)
        for part in options.parts:
            solver.append(solver_row(subject, part, options.preset, options.seed))
            sheet.write(["The default solver:", "", *down(solver, "")])
        for part in TRAINED if options.seconds else ():
            small.append(trained_row(subject, part, options.seconds, options.seed))
            words = f"A trainable grid in miniature ({MINIATURE_PIXELS} px), {options.seconds:g} CPU seconds each:"
            sheet.write(["The default solver:", "", *down(solver, "")], [words, "", *down(small, "")])


if __name__ == "__main__":
    main()
