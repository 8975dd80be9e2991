"""A page of measurements in Markdown that says how it was made: command, machine, versions, commit, seeds, cost.

Importing it makes the program's modules and the tests' scenes importable from wherever a benchmark is started.
"""

import argparse
import os
import platform
import re
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from importlib import metadata
from pathlib import Path

import numpy as np
import psutil

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

MODULES = ("numpy", "torch", "numba", "cv2")  # whose packages are named with their versions
NUMBER = re.compile(r"-?\d[\d.e+-]*$")
KIB_PER_GIB = 2**20  # the kernel counts a process's peak in KiB


def machine() -> list[str]:
    """What numbers are measured on and with, as a list in Markdown."""
    commit = subprocess.run(["git", "describe", "--always", "--dirty"], cwd=ROOT, capture_output=True, text=True)
    packages = metadata.packages_distributions()
    versions = ", ".join(f"{packages[name][0]} {metadata.version(packages[name][0])}" for name in MODULES)
    memory = psutil.virtual_memory().total / 2**30
    return [
        f"- {platform.machine()}, {os.cpu_count()} cores, {memory:.0f} GiB, {platform.system()}; "
        f"load average before {os.getloadavg()[0]:.1f}",
        f"- Python {platform.python_version()}, {versions}",
        f"- commit {commit.stdout.strip() or 'unknown'}",
    ]


def cpu_of(who: int) -> float:
    """CPU seconds of this process (resource.RUSAGE_SELF), or of its children that have ended (RUSAGE_CHILDREN)."""
    usage = resource.getrusage(who)
    return usage.ru_utime + usage.ru_stime


def cpu_seconds() -> float:
    """CPU seconds of this process and of all its children that have ended."""
    return cpu_of(resource.RUSAGE_SELF) + cpu_of(resource.RUSAGE_CHILDREN)


def peak_gib() -> float:
    """Largest memory of this process or of any child that has ended, GiB."""
    peaks = [resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return max(peaks) / KIB_PER_GIB


def cell(value: object) -> str:
    """A value as it stands in a table: four digits of a float, words of a list, nothing for None."""
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return ", ".join(map(str, value)) or "none"
    return "" if value is None else str(value)


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    """A Markdown table, line by line; columns of numbers are set to the right."""
    texts = [[cell(value) for value in row] for row in rows]
    columns = [[row[i] for row in texts if row[i]] for i in range(len(head))]
    marks = ["---:" if column and all(map(NUMBER.match, column)) else "---" for column in columns]
    return ["| " + " | ".join(line) + " |" for line in (list(head), marks, *texts)]


def down(rows: Sequence[dict], name: str) -> list[str]:
    """Dicts as a table with one row for each; `name` is the key of the first column. What no row has is left out."""
    keys = list(dict.fromkeys(key for row in rows for key, value in row.items() if value is not None and key != name))
    return table([name, *keys], ([row.get(key) for key in (name, *keys)] for row in rows))


def across(rows: Sequence[dict], name: str = "capture") -> list[str]:
    """Dicts as a table with one column for each; groups of measures become single ones."""
    rows = [flat(row) for row in rows]
    keys = list(dict.fromkeys(key for row in rows for key, value in row.items() if value is not None and key != name))
    return table(["", *(str(row[name]) for row in rows)], ([key, *(row.get(key) for row in rows)] for key in keys))


def flat(row: dict) -> dict:
    """Groups of measures as single ones: {"maps": {"nmze": 0.1}} becomes {"maps.nmze": 0.1}; lists become text."""
    out = {}
    for key, value in row.items():
        if isinstance(value, dict):
            out |= {f"{key}.{inner}": measure for inner, measure in flat(value).items()}
        else:
            out[key] = cell(value) if isinstance(value, list) else value
    return out


def slope(x: Sequence[float], y: Sequence[float]) -> float:
    """The exponent b of y ~ x^b, by least squares of the logarithms."""
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def parser_of(text: str | None) -> argparse.ArgumentParser:
    """What the commands here have in common: --help tells the text of their module, and --table writes a file."""
    made = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--table", type=Path, help="write the page here as well")
    return made


def command() -> str:
    """The command line that runs, as another reader would type it: of paths given to it only the last part."""
    words = [Path(word).name if os.sep in word else word for word in sys.argv[1:]]
    quoted = (f'"{word}"' if " " in word else word for word in words)
    _, folder, below = str(Path(sys.argv[0]).resolve()).rpartition(f"benchmarks{os.sep}")
    return " ".join(["python", Path(folder, below).as_posix(), *quoted])


class Sheet:
    """One page of measurements. What it cost is counted from its making to its last writing."""

    def __init__(self, title: str, file: Path | None, seeds: str, note: str = ""):
        """
        Args:
            file: written besides being printed, if one is named.
            seeds: of everything random, in words.
            note: what the numbers are, below the header.
        """
        self._head = [f"# {title}", "", f"    {command()}", "", *machine(), f"- {seeds}"]
        self._note, self._file = [note, ""] if note else [], file
        self._start, self._cpu = time.monotonic(), cpu_seconds()

    def write(self, *parts: Sequence[str]) -> None:
        """Print the page with these parts, and write it to its file; again after every row that is worth keeping."""
        spent, wall = cpu_seconds() - self._cpu, time.monotonic() - self._start
        cost = f"- {spent:.0f} CPU seconds in {wall:.0f} seconds, at most {peak_gib():.2f} GiB in one process"
        body = [line for part in parts for line in (*part, "")]
        text = "\n".join([*self._head, cost, "", *self._note, *body]).rstrip() + "\n"
        print(text, flush=True)
        if self._file:
            self._file.parent.mkdir(parents=True, exist_ok=True)
            self._file.write_text(text, encoding="utf-8")

    def fill(self, rows: Iterable[dict], name: str, laid: Callable[[Sequence[dict], str], list[str]] = down) -> None:
        """One table, `down` or `across`, written again with every row; `name` is the key of the rows' names."""
        so_far: list[dict] = []
        for row in rows:
            so_far.append(row)
            self.write(laid(so_far, name))
