"""What captures cost, from finished runs: CPU seconds by stage, memory, disk; and what a thousand of them would cost.

    python benchmarks/run_costs.py RUN... [--machines laptop=8,16 ...] [--captures 1000] [--table FILE]

A RUN is a folder that `shadowgraph run` left, whose report.json says what each stage took, or one that holds such
folders, as benchmarks/run_captures.py leaves. Per thousand: jobs of one core each run side by side, as many as a
machine has cores, or as its memory holds peaks if those are fewer; so hours = captures * CPU seconds of one /
(jobs * 3600). A machine is NAME=CORES,GIB.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

from sheet import Sheet, parser_of, table

STAGES = ("capture", "calibrate", "check", "solve", "mesh", "detail")
HOUR, GIB, MIB = 3600, 2**30, 2**20
MACHINES = ["laptop=8,16", "workstation=32,128", "ten servers=640,2560"]


@dataclass(frozen=True)
class Cost:
    """Of one finished run."""

    name: str
    preset: str
    photos: int
    cpu_s: tuple[float, ...]  # by STAGES
    peak: int  # bytes
    disk: int  # bytes, all of the folder
    checkpoints: int  # bytes of these that a finished run no longer needs

    def total(self) -> float:
        """CPU seconds of all stages."""
        return sum(self.cpu_s)


def read_cost(run: Path) -> Cost:
    """The cost of a run by its own account."""
    report = json.loads((run / "report.json").read_text(encoding="utf-8"))
    stages = report["stages"]
    sizes = {path: path.stat().st_size for path in run.rglob("*") if path.is_file()}
    return Cost(
        Path(report["capture"]).name,
        report["preset"],
        len(report["photos"]),
        tuple(stages[name]["cpu_seconds"] if name in stages else 0.0 for name in STAGES),
        max(stage["peak_memory_bytes"] for stage in stages.values()),
        sum(sizes.values()),
        sum(size for path, size in sizes.items() if path.name.startswith("checkpoint")),
    )


def runs_below(folders: list[Path]) -> list[Path]:
    """The finished runs that are these folders or lie in them, folder by folder in the order of their names."""
    return [report.parent for folder in folders for report in sorted(folder.rglob("report.json"))]


def per_capture(costs: list[Cost]) -> list[str]:
    """A row for each run."""
    head = ["capture", "preset", "photos", *(f"{name}, CPU s" for name in STAGES), "all, CPU s", "peak, GiB"]
    head += ["folder, MiB", "of which checkpoints"]
    return table(head, map(capture_row, costs))


def capture_row(cost: Cost) -> list[object]:
    """The cells of one run."""
    seconds = [f"{spent:.1f}" for spent in (*cost.cpu_s, cost.total())]
    sizes = [round(size / MIB) for size in (cost.disk, cost.checkpoints)]
    return [cost.name, cost.preset, cost.photos, *seconds, f"{cost.peak / GIB:.2f}", *sizes]


def of_many(costs: list[Cost], captures: int, machines: dict[str, tuple[int, float]]) -> list[str]:
    """A row for each preset: the mean of its runs, times `captures`."""
    head = ["preset", "CPU hours", "disk, GiB", "without checkpoints, GiB"]
    head += [f"{name} ({cores} cores, {gib:g} GiB), hours" for name, (cores, gib) in machines.items()]
    rows = []
    for preset in dict.fromkeys(cost.preset for cost in costs):
        mine = [cost for cost in costs if cost.preset == preset]
        cpu, peak = captures * fmean(c.total() for c in mine), max(c.peak for c in mine) / GIB
        disk, kept = (captures * fmean(d) / GIB for d in zip(*((c.disk, c.disk - c.checkpoints) for c in mine)))  # noqa: B905
        row: list[object] = [preset, f"{cpu / HOUR:.1f}", f"{disk:.0f}", f"{kept:.0f}"]
        rows.append(row + [f"{hours(cpu, peak, *machine):.1f}" for machine in machines.values()])
    return table(head, rows)


def hours(cpu_s: float, peak_gib: float, cores: int, gib: float) -> float:
    """How long so many CPU seconds take in jobs of one core each."""
    jobs = max(1, min(cores, int(gib / peak_gib)))
    return cpu_s / jobs / HOUR


def parsed(machine: str) -> tuple[str, tuple[int, float]]:
    """NAME=CORES,GIB."""
    name, _, size = machine.partition("=")
    cores, gib = size.split(",")
    return name, (int(cores), float(gib))


def main() -> None:
    """Read, add up, write."""
    parser = parser_of(__doc__)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--machines", nargs="+", default=MACHINES)
    parser.add_argument("--captures", type=int, default=1000)
    options = parser.parse_args()
    costs = [read_cost(run) for run in runs_below(options.runs)]
    sheet = Sheet("Costs", options.table, "finished runs; no randomness")
    many = of_many(costs, options.captures, dict(map(parsed, options.machines)))
    sheet.write(["One capture:", "", *per_capture(costs)], [f"{options.captures} captures:", "", *many])


if __name__ == "__main__":
    main()
