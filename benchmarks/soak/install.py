"""A clean install of the wheel and the first result, for every Python that is supported and on this machine.

    python benchmarks/soak/install.py [--python PROGRAM...] [--table FILE]

The wheel is built from the last commit. Each Python gets a virtual environment of its own, into which pip installs the
wheel with what it needs, from wherever pip is told to look; then the README's run of examples/spot, its kernels not
compiled yet. Exit code 1 where an install takes more than 5 minutes, a first result more than
10, or one fails.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from sheet import ROOT, Sheet, cpu_seconds, parser_of

SUPPORTED = ("python3.11", "python3.12", "python3.13")
INSTALL_S, RESULT_S = 300.0, 600.0
MESH = "mesh.glb"


def main() -> int:
    """Build, install, run, write after every Python."""
    parser = parser_of(__doc__)
    parser.add_argument("--python", nargs="+", default=list(SUPPORTED), help="programs to make environments with")
    options = parser.parse_args()
    note = "Seconds of wall time and of CPU; the bars are 5 minutes to install, 10 to the first result."
    sheet, rows = Sheet(options.table, "no seed", note), []
    work = Path(tempfile.mkdtemp(prefix="install_"))
    try:
        wheel = build(work)
        for program in options.python:
            if subprocess.run([program, "--version"], capture_output=True, check=False).returncode == 0:
                rows.append(installed(program, wheel, work))
                sheet.write(rows)
    except FileNotFoundError as error:
        print(f"{error.filename} is not on this machine; name the programs with --python.", file=sys.stderr)
        return 1
    finally:
        shutil.rmtree(work)
    return int(not rows or any(not good(row) for row in rows))


def good(row: dict) -> bool:
    """Whether one Python meets the bars."""
    return row["mesh"] == "there" and row["install s"] <= INSTALL_S and row["first result s"] <= RESULT_S


def build(work: Path) -> Path:
    """The wheel of the last commit."""
    source = work / "source"
    source.mkdir()
    packed = subprocess.run(["git", "archive", "HEAD"], cwd=ROOT, check=True, capture_output=True).stdout
    subprocess.run(["tar", "-x", "-C", str(source)], input=packed, check=True)
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(work), str(source)]
    subprocess.run(pip, check=True)
    return next(work.glob("*.whl"))


def installed(program: str, wheel: Path, work: Path) -> dict:
    """One environment: what installing and the first run cost."""
    place = Path(tempfile.mkdtemp(dir=work))
    environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "VIRTUAL_ENV")}
    environment["NUMBA_CACHE_DIR"] = str(place / "kernels")

    def timed(*words: str) -> tuple[int, float, float]:
        start, cpu = time.monotonic(), cpu_seconds()
        code = subprocess.run(words, cwd=place, env=environment, check=False).returncode
        return code, round(time.monotonic() - start), round(cpu_seconds() - cpu)

    version = subprocess.run([program, "--version"], capture_output=True, text=True, check=True).stdout.split()[-1]
    first, *made = timed(program, "-m", "venv", str(place / "venv"))
    bin_folder = place / "venv" / "bin"
    second, *installing = timed(str(bin_folder / "pip"), "install", "--quiet", str(wheel))
    spot = ROOT / "examples" / "spot"
    command = [str(bin_folder / "shadowgraph"), "run", str(spot), "--out", str(place / "run"), "--viewer", "off"]
    third, *running = timed(*command)
    report = place / "run" / "report.json"
    peaks = [cost["peak_memory_bytes"] for cost in _stages(report)]
    row = {
        "Python": version,
        "exit codes": f"{first} {second} {third}",
        "install s": made[0] + installing[0],
        "install CPU s": made[1] + installing[1],
        "environment GB": _size(place / "venv") / 1e9,
        "first result s": running[0],
        "first result CPU s": running[1],
        "memory GB": max(peaks, default=0) / 1e9,
        "mesh": "there" if (place / "run" / MESH).is_file() else "missing",
    }
    shutil.rmtree(place)
    return row


def _stages(report: Path) -> list[dict]:
    return list(json.loads(report.read_text())["stages"].values()) if report.is_file() else []


def _size(folder: Path) -> int:
    return sum(path.lstat().st_size for path in folder.rglob("*") if path.is_file())


if __name__ == "__main__":
    sys.exit(main())
