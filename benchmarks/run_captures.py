"""Run captures and scenes from nothing and write what came out as a Markdown table.

    python benchmarks/run_captures.py CAPTURE... [--out DIR] [--table FILE] [-- OPTIONS OF shadowgraph run]

CAPTURE@BOARD names the board of a capture that does not say it, as in bunny@checkerboard:9x6:24.25. Each runs in its
own process, without a page. Where a folder has a gt/, `shadowgraph evaluate` scores the result.
"""

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import time
from importlib import metadata
from pathlib import Path

import psutil

ROOT = Path(__file__).parent.parent
COMMAND = [sys.executable, str(ROOT / "shadowgraph.py")]
VERSIONS = ("numpy", "torch", "numba", "opencv-contrib-python-headless")


def machine() -> list[str]:
    """What the numbers were measured on and with."""
    commit = subprocess.run(["git", "describe", "--always", "--dirty"], cwd=ROOT, capture_output=True, text=True)
    versions = ", ".join(f"{name} {metadata.version(name)}" for name in VERSIONS)
    memory = psutil.virtual_memory().total / 2**30
    return [
        f"- {platform.machine()}, {os.cpu_count()} cores, {memory:.0f} GiB, {platform.system()}",
        f"- Python {platform.python_version()}, {versions}",
        f"- commit {commit.stdout.strip() or 'unknown'}",
        f"- load average before: {os.getloadavg()[0]:.1f}",
    ]


def publish(text: str, file: Path | None) -> None:
    """Print a table, and write it to a file if one is named."""
    print(text)
    if file:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")


def run(named: str, folder: Path, options: list[str], reference: Path | None = None) -> dict:
    """One run and its score: exit code, seconds, CPU seconds of the whole process, peak memory, measures.

    Args:
        reference: holds the gt/ to compare with; the capture itself unless given.
    """
    place, _, board = named.partition("@")
    capture, options = Path(place), [*options, *(["--board", board] if board else [])]
    out = folder / capture.name
    arguments = ["run", str(capture), "--out", str(out), "--viewer", "off", "--force", *options]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    start = time.monotonic()
    code = subprocess.run(COMMAND + arguments, check=False).returncode
    seconds = time.monotonic() - start
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    row = {"capture": capture.name, "exit": code, "seconds": seconds, "cpu_seconds": cpu}
    if code == 0:
        costs = json.loads((out / "report.json").read_text())["stages"].values()
        row["peak_memory_gib"] = max(cost["peak_memory_bytes"] for cost in costs) / 2**30
        row["first_mesh_cpu_s"] = first_mesh(out)
    reference = reference or capture
    if code == 0 and (reference / "gt").is_dir():
        score = [*COMMAND, "evaluate", str(out), "--reference", str(reference)]
        scored = subprocess.run(score, capture_output=True, text=True)
        row |= json.loads(scored.stdout) if scored.returncode == 0 else {"not scored": scored.stderr.strip()}
    return row


def first_mesh(out: Path) -> float | None:
    """CPU seconds until the first surface was on disk."""
    lines = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    return next((line["cpu_s"] for line in lines if line["stage"] == "hull" and line["done"] == 1), None)


def flat(row: dict) -> dict:
    """Groups of measures as single ones: {"maps": {"nmze": 0.1}} becomes {"maps.nmze": 0.1}; lists become text."""
    out = {}
    for key, value in row.items():
        if isinstance(value, dict):
            out |= {f"{key}.{inner}": measure for inner, measure in flat(value).items()}
        else:
            out[key] = (", ".join(map(str, value)) or "none") if isinstance(value, list) else value
    return out


def table(rows: list[dict]) -> list[str]:
    """Rows as Markdown, one column per capture."""
    rows = [flat(row) for row in rows]
    keys = list(dict.fromkeys(key for row in rows for key in row if key != "capture"))
    lines = ["| | " + " | ".join(row["capture"] for row in rows) + " |", "|---|" + "---|" * len(rows)]
    for key in keys:
        cells = [row.get(key) for row in rows]
        text = [f"{cell:.4g}" if isinstance(cell, float) else "" if cell is None else str(cell) for cell in cells]
        lines.append(f"| {key} | " + " | ".join(text) + " |")
    return lines


def own_and_passed_on() -> tuple[list[str], list[str]]:
    """The command line's arguments before and after "--": the benchmark's own, and those of `shadowgraph run`."""
    arguments = sys.argv[1:]
    cut = arguments.index("--") if "--" in arguments else len(arguments)
    return arguments[:cut], arguments[cut + 1 :]


def main() -> None:
    """Parse, run, write."""
    arguments, options = own_and_passed_on()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+")
    parser.add_argument("--out", type=Path, default=Path("runs/benchmark"))
    parser.add_argument("--table", type=Path, help="write the table here as well")
    arguments = parser.parse_args(arguments)
    header = [f"`shadowgraph run ... {' '.join(options)}`", "", *machine(), ""]
    rows = [run(capture, arguments.out, options) for capture in arguments.captures]
    text = "\n".join([*header, *table(rows)]) + "\n"
    publish(text, arguments.table)


if __name__ == "__main__":
    main()
