"""Every number in README.md: measured on the examples that ship, compared with the program, or known as no measurement.

    python benchmarks/readme_numbers.py [--table FILE]

Runs examples/spot into a fresh folder twice, with kernels not compiled yet and compiled, then examples/cow, and prints
a table; exit code 1 where README is off by more than the tolerance, has a number that is not known here, or lacks one
that is. Wall time is judged only where the machine was idle before.
"""

import os
import re
import sys
import tempfile
import tomllib
from dataclasses import dataclass
from pathlib import Path

from one_run import COW, SPOT, run
from sheet import ROOT, Sheet, parser_of

# isort: split
from capture.session.session import ADVISED_LIT

NUMBER = re.compile(r"\d+(?:[.,]\d+)*")
IDLE = 0.3  # load average


@dataclass(frozen=True)
class Measured:
    """A number that a run gives: where README states it, under which name, and by which share it may be off."""

    text: str
    stated: float
    name: str
    tolerance: float


MEASURED = (
    Measured("70 CPU seconds", 70, "CPU seconds", 0.25),
    Measured("1.8 GB of memory", 1.8, "memory, GB", 0.15),
    Measured("about 18 CPU seconds more", 18, "CPU seconds to compile", 0.5),
    Measured("130 CPU seconds, 2.1 GB", 130, "CPU seconds, whole object", 0.25),
    Measured("2.1 GB of memory", 2.1, "memory, GB, whole object", 0.15),
    Measured("the example takes about a minute", 60, "seconds", 0.5),
)
OF_THE_PROGRAM = {  # where README repeats a setting: what the program says
    "12 are a minimum for a good shape": ADVISED_LIT,
    "fewer than about 12 photos": ADVISED_LIT,
}
NO_MEASUREMENT = (  # advice, names and examples
    "Python 3.11 to 3.13",
    "python3",
    "at 30 to 60 degrees",
    "30 to 40 are better",
    "charuco:5x7:30:22:DICT_4X4_50",
    "3MF",
    "1. Put the phone",
    "2. Lay a printed board",
    "3. Make the room dark",
    "CVPR 2023",
)


def unknown(readme: str) -> list[str]:
    """Numbers of README that stand in no known place, and known places that README no longer has."""
    covered: set[int] = set()
    missing = []
    for text in (*(one.text for one in MEASURED), *OF_THE_PROGRAM, *NO_MEASUREMENT):
        starts = [match.start() for match in re.finditer(re.escape(text), readme)]
        missing += [] if starts else [f"README no longer says {text!r}"]
        covered.update(place for start in starts for place in range(start, start + len(text)))
    new = [match for match in NUMBER.finditer(readme) if match.start() not in covered]
    return missing + [f"{readme[max(one.start() - 30, 0) : one.end() + 20]!r} is not known" for one in new]


def contradicted(readme: str) -> list[str]:
    """Where README repeats a setting of the program, and the program has another."""
    wrong = [text for text, value in OF_THE_PROGRAM.items() if str(value) not in NUMBER.findall(text)]
    asked = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["requires-python"]
    if asked != ">=3.11,<3.14" or "Python 3.11 to 3.13" not in readme:
        wrong.append(f"Python 3.11 to 3.13, against {asked}")
    return [f"{text}: the program has another value" for text in wrong]


def measure() -> dict[str, float]:
    """What README states of the example, measured, by the names of MEASURED."""
    is_idle = os.getloadavg()[0] < IDLE
    with tempfile.TemporaryDirectory() as folder:
        os.environ["NUMBA_CACHE_DIR"] = str(Path(folder) / "kernels")
        places = {"first": SPOT, "second": SPOT, "whole": COW}
        first, second, whole = (run(str(capture), Path(folder) / name, []) for name, capture in places.items())
    found = {
        "CPU seconds": second["cpu_seconds"],
        "memory, GB": second["peak_memory_gib"] * 2**30 / 1e9,
        "CPU seconds, whole object": whole["cpu_seconds"],
        "memory, GB, whole object": whole["peak_memory_gib"] * 2**30 / 1e9,
        "CPU seconds to compile": first["cpu_seconds"] - second["cpu_seconds"],
    }
    return found | ({"seconds": second["seconds"]} if is_idle else {})


def main() -> int:
    """Look, measure, compare."""
    parser = parser_of(__doc__)
    options = parser.parse_args()
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    wrong = unknown(readme) + contradicted(readme)
    sheet = Sheet(options.table, "seed 0")
    found, rows = measure(), []
    for one in MEASURED:
        value = found.get(one.name)
        holds = value is None or abs(value - one.stated) <= one.tolerance * one.stated
        verdict = "not judged: the machine was busy" if value is None else "holds" if holds else "is off"
        told = {"number": one.name, "README": one.stated, "measured": value}
        rows.append(told | {"may be off by": f"{one.tolerance:.0%}", "verdict": verdict})
        wrong += [] if holds else [f"{one.name}: {one.stated:g} stated, {value:.3g} measured"]
    sheet.write(rows, [f"- {line}" for line in wrong])
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
