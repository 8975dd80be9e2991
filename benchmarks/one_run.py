"""Whole runs in processes of their own: the command, what it cost, and its score."""

import json
import resource
import subprocess
import sys
import time
from pathlib import Path

from sheet import ROOT, cpu_of

COMMAND = [sys.executable, str(ROOT / "shadowgraph")]
SPOT, COW = ROOT / "examples" / "spot", ROOT / "examples" / "cow"


def run(named: str, folder: Path, options: list[str], reference: Path | None = None) -> dict:
    """One run and its score: exit code, seconds, CPU seconds of the whole process, peak memory, measures.

    Args:
        named: FOLDER, or FOLDER@BOARD for a capture that does not say its board.
        folder: gets a folder for the run.
        options: of `shadowgraph run`.
        reference: holds the gt/ to compare with; the capture itself unless given.
    """
    place, _, board = named.partition("@")
    capture, options = Path(place), [*options, *(["--board", board] if board else [])]
    out = folder / capture.name
    arguments = ["run", str(capture), "--out", str(out), "--viewer", "off", "--force", *options]
    before, start = cpu_of(resource.RUSAGE_CHILDREN), time.monotonic()
    code = subprocess.run(COMMAND + arguments, check=False).returncode
    seconds, cpu = time.monotonic() - start, cpu_of(resource.RUSAGE_CHILDREN) - before
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


def own_and_passed_on() -> tuple[list[str], list[str]]:
    """The command line's arguments before and after "--": the benchmark's own, and those of `shadowgraph run`."""
    arguments = sys.argv[1:]
    cut = arguments.index("--") if "--" in arguments else len(arguments)
    return arguments[:cut], arguments[cut + 1 :]
