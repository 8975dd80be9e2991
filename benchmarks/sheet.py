"""A table of measurements: printed, and kept as rows in JSON with how it was made, for benchmarks/collect.py.

Importing it makes the program's modules and the tests' scenes importable from wherever a benchmark is started.
"""

import argparse
import json
import os
import platform
import re
import resource
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path

import psutil

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

NUMBER = re.compile(r"-?\d[\d.e+-]*$")


def machine() -> str:
    """What numbers are measured on and with."""
    commit = subprocess.run(["git", "describe", "--always", "--dirty"], cwd=ROOT, capture_output=True, text=True)
    memory = psutil.virtual_memory().total / 2**30
    return (
        f"commit {commit.stdout.strip() or 'unknown'}, {datetime.now(UTC).date()}, {platform.machine()}, "
        f"{os.cpu_count()} cores, {memory:.0f} GiB, {platform.system()}, load {os.getloadavg()[0]:.0f}, "
        f"Python {platform.python_version()}, torch {metadata.version('torch')}"
    )


def cpu_of(who: int) -> float:
    """CPU seconds of this process (resource.RUSAGE_SELF), or of its children that have ended (RUSAGE_CHILDREN)."""
    usage = resource.getrusage(who)
    return usage.ru_utime + usage.ru_stime


def cpu_seconds() -> float:
    """CPU seconds of this process and of all its children that have ended."""
    return cpu_of(resource.RUSAGE_SELF) + cpu_of(resource.RUSAGE_CHILDREN)


def cell(value: object) -> str:
    """A value as it stands in a table: three digits of a float, words of a list, nothing for None."""
    if isinstance(value, float):
        return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    if isinstance(value, list):
        return ", ".join(map(str, value)) or "none"
    return "" if value is None else str(value)


def table(rows: Sequence[dict]) -> list[str]:
    """Rows as a Markdown table, line by line; columns that no row fills are left out, those of numbers set right."""
    keys = [
        key for key in dict.fromkeys(key for row in rows for key in row) if any(r.get(key) is not None for r in rows)
    ]
    texts = [[cell(row.get(key)) for key in keys] for row in rows]
    columns = [[row[i] for row in texts if row[i]] for i in range(len(keys))]
    marks = ["---:" if column and all(map(NUMBER.match, column)) else "---" for column in columns]
    return ["| " + " | ".join(line) + " |" for line in (keys, marks, *texts)]


def parser_of(text: str | None) -> argparse.ArgumentParser:
    """What the commands here have in common: --help tells the text of their module, and --table writes a file."""
    made = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--table", type=Path, help="keep the rows here, as benchmarks/results/NAME.json")
    return made


def command() -> str:
    """The command line that runs, as another reader would type it: of paths given to it only the last part."""
    words = [Path(word).name if os.sep in word else word for word in sys.argv[1:]]
    quoted = (f'"{word}"' if " " in word else word for word in words)
    _, folder, below = str(Path(sys.argv[0]).resolve()).rpartition(f"benchmarks{os.sep}")
    return " ".join(["python", Path(folder, below).as_posix(), *quoted])


class Sheet:
    """One table of measurements."""

    def __init__(self, file: Path | None, seeds: str, note: str = ""):
        """
        Args:
            file: gets the rows as JSON, besides their being printed, if one is named.
            seeds: of everything random, in words.
            note: what the numbers are.
        """
        self._made, self._note, self._file = f"{machine()}, {seeds}", note, file
        self._start, self._cpu = time.monotonic(), cpu_seconds()

    def write(self, rows: Sequence[dict], *printed: Sequence[str]) -> None:
        """Print the rows and what else is told, and keep the rows; again after every row that is worth keeping."""
        spent, wall = cpu_seconds() - self._cpu, time.monotonic() - self._start
        more = [line for part in printed for line in ("", *part)]
        print("\n".join([self._note, "", *table(rows), *more, "", self._made]), flush=True)
        print(f"{spent:.0f} CPU seconds in {wall:.0f} seconds", flush=True)
        if self._file:
            kept = {"command": command(), "made": self._made, "note": self._note, "rows": list(rows)}
            self._file.parent.mkdir(parents=True, exist_ok=True)
            self._file.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")

    def fill(self, rows: Iterable[dict]) -> None:
        """Write again with every row."""
        so_far: list[dict] = []
        for row in rows:
            so_far.append(row)
            self.write(so_far)
