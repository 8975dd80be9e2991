"""Is more time ever worse than less? The same solve with half, once and twice the iterations of its preset.

    python benchmarks/run_time.py [SUBJECT...] [--factors 0.5 1 2] [--seeds 3] [--preset standard] [--input auto]
        [--table FILE]

A SUBJECT is a folder with a gt/, FOLDER@BOARD or `synthetic` (see benchmarks/solves.py), which it is unless given.
Levels still end early where held-out shadow rays gain no more (reconstruct/course.py). Each figure is the median over
the seeds with its range; `worse by` compares a row's median with the best of the rows with less time.
"""

import argparse
from pathlib import Path
from statistics import median

import torch
from sheet import Sheet, down
from solves import SYNTHETIC, open_subject, score, shown, solve

from reconstruct.presets import preset, shortened

ERRORS = ("depth", "normals, deg")  # smaller is better; of the others, larger


def worse_by(rows: list[dict], name: str) -> float | None:
    """By what share the last row is worse than the best before it; negative where it is better."""
    if len(rows) < 2 or rows[-1][name] is None:
        return None
    now, before = rows[-1][name], [row[name] for row in rows[:-1]]
    return now / min(before) - 1 if name in ERRORS else 1 - now / max(before)


def main() -> None:
    """Parse, solve, write after every row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("subjects", nargs="*", default=[SYNTHETIC])
    parser.add_argument("--factors", nargs="+", type=float, default=[0.5, 1.0, 2.0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--preset", default="standard", choices=["draft", "standard", "fine"])
    parser.add_argument("--input", default="auto", choices=["auto", "rgb", "shadow"])
    parser.add_argument("--table", type=Path, help="write the table here as well")
    options = parser.parse_args()
    torch.set_num_threads(1)
    note = f"Preset {options.preset}, input {options.input}; median of {options.seeds} seeds (least to most)."
    sheet, printed = Sheet("More time", options.table, f"seeds 0 to {options.seeds - 1}", note), []
    for named in options.subjects:
        subject, rows = open_subject(named, options.input, options.preset), []
        for factor in sorted(options.factors):
            found: dict[str, list[float]] = {}
            for seed in range(options.seeds):
                long_side, config = preset(options.preset, seed)
                solved, spent = solve(subject, subject.calibration, long_side, shortened(config, factor))
                for name, value in (shown(score(solved, subject)) | {"CPU s": spent}).items():
                    if value is not None:
                        found.setdefault(name, []).append(float(value))
            rows.append({name: median(values) for name, values in found.items()})
            ranges = {name: f"{median(v):.4g} ({min(v):.4g} to {max(v):.4g})" for name, v in found.items()}
            changes = {name: worse_by(rows, name) for name in rows[-1] if name != "CPU s"}
            worst = max((x for x in changes.values() if x is not None), default=None)
            said = "" if worst is None else f"{100 * worst:+.1f} %"
            printed.append({"subject": f"{subject.name}, x {factor:g}"} | ranges | {"worse by": said})
            sheet.write(down(printed, "subject"))


if __name__ == "__main__":
    main()
