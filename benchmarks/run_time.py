"""Is more time ever worse than less? The same solve with half, once and twice the iterations of its preset.

    python benchmarks/run_time.py [SUBJECT...] [--factors 0.5 1 2] [--seeds 3] [--preset standard] [--input auto]
        [--table FILE]

A SUBJECT is a folder with a gt/, FOLDER@BOARD or `synthetic` (see benchmarks/solves.py), which it is unless given.
Levels still end early where held-out shadow rays gain no more (reconstruct/solve/early_stopping.py). Each figure is the
median over the seeds with its range; `worse by` compares a row's median with the best of the rows with less time.
"""

import argparse
from collections.abc import Iterator
from statistics import median

from sheet import Sheet
from solves import INPUTS, SYNTHETIC, Subject, open_subject, parsed, score, shown, solve, solve_parser

from reconstruct.run.presets import preset, shortened

ERRORS = ("depth", "normals, deg")  # smaller is better; of the others, larger


def worse_by(rows: list[dict], name: str) -> float | None:
    """By what share the last row is worse than the best before it; negative where it is better."""
    if len(rows) < 2 or rows[-1][name] is None:
        return None
    now, before = rows[-1][name], [row[name] for row in rows[:-1]]
    return now / min(before) - 1 if name in ERRORS else 1 - now / max(before)


def measured(subject: Subject, factor: float, seeds: range, named: str) -> dict[str, list[float]]:
    """Every measure of the solves from all seeds."""
    found: dict[str, list[float]] = {}
    for seed in seeds:
        long_side, config = preset(named, seed)
        solved, spent = solve(subject, subject.calibration, long_side, shortened(config, factor))
        for name, value in (shown(score(solved, subject)) | {"CPU s": spent}).items():
            if value is not None:
                found.setdefault(name, []).append(float(value))
    return found


def rows(options: argparse.Namespace, seeds: range) -> Iterator[dict]:
    """Every subject with more and more iterations."""
    for named in options.subjects:
        subject, medians = open_subject(named, options.input, options.preset), []
        for factor in sorted(options.factors):
            found = measured(subject, factor, seeds, options.preset)
            medians.append({name: median(values) for name, values in found.items()})
            ranges = {name: f"{median(v):.4g} ({min(v):.4g} to {max(v):.4g})" for name, v in found.items()}
            changes = {name: worse_by(medians, name) for name in medians[-1] if name != "CPU s"}
            worst = max((x for x in changes.values() if x is not None), default=None)
            said = "" if worst is None else f"{100 * worst:+.1f} %"
            yield {"subject": f"{subject.name}, x {factor:g}"} | ranges | {"worse by": said}


def main() -> None:
    """Parse, solve, write after every row."""
    parser = solve_parser(__doc__, [SYNTHETIC], "standard")
    parser.add_argument("--factors", nargs="+", type=float, default=[0.5, 1.0, 2.0])
    parser.add_argument("--seeds", type=int, default=3, help="how many, from --seed on")
    parser.add_argument("--input", default="auto", choices=INPUTS)
    options = parsed(parser)
    seeds = range(options.seed, options.seed + options.seeds)
    note = f"Preset {options.preset}, input {options.input}; median of {options.seeds} seeds (least to most)."
    sheet = Sheet("More time", options.table, f"seeds {seeds[0]} to {seeds[-1]}", note)
    sheet.fill(rows(options, seeds), "subject")


if __name__ == "__main__":
    main()
