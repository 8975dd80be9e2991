"""kill -9 at random moments of a run: does the same command finish it, what work was lost, is the result the same?

    python benchmarks/soak/kill_run.py [CAPTURE] [--times 200] [--preset draft] [--cores 1] [--table FILE]

CAPTURE is a folder that `shadowgraph run` takes; without one, a small scene is rendered. One uninterrupted run tells
how long a run takes and what it gives (after one more where kernels have to be compiled). Each further one is killed
at a moment drawn evenly over that time, and the same command is given again, which is killed like that, too, until one
reaches its end first: that result is compared. Lost work is the CPU time of all of them beyond that of the
uninterrupted run, so it counts starting the program again; no single kill lost more than that sum. Writes a Markdown
table, a line for each run that was finished; exit code 1 where a bar is missed.
"""

import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
import trimesh

sys.path.insert(0, str(Path(__file__).parents[1]))

from sheet import ROOT, Sheet, parser_of

# isort: split
from dataset_folders import write_shadowneus  # pyright: ignore[reportMissingImports]
from synthetic import HEAP, Look, render  # pyright: ignore[reportMissingImports]

from reconstruct.run.machine import kernels_are_compiled

MOST_LOST_S, MOST_LOST_SHARE = 30.0, 0.02  # CPU seconds, or of the whole run: the larger one counts
MOST_CHANGE = 0.01  # of the mesh's volume and of the median depth
POLL_S = 0.01
MOST_IN_A_ROW = 8  # kills of one run, then it is left alone: else a run that is killed early each time never ends


@dataclass(frozen=True)
class Outcome:
    """One run that was killed, given again, and so on until it was finished."""

    killed_in: tuple[str, ...]  # the last line of the log at each kill
    lost: float  # CPU s, by all kills together
    is_same: bool  # depth.npy, bit for bit
    change: float  # relative, of the mesh's volume

    def row(self) -> dict:
        """A row of the table."""
        lost = {"killed in": list(self.killed_in), "lost CPU s": self.lost}
        return lost | {"same depth, bit for bit": self.is_same, "volume changed by": f"{self.change:.2%}"}

    def is_well(self, whole: float) -> bool:
        """Within the bars, for a run that takes `whole` CPU seconds."""
        most = max(MOST_LOST_S, MOST_LOST_SHARE * whole)
        return self.lost <= most * max(1, len(self.killed_in)) and self.change <= MOST_CHANGE


@dataclass(frozen=True)
class Whole:
    """The uninterrupted run."""

    cpu_s: float
    depth: np.ndarray
    volume: float


def command(capture: Path, out: Path, preset: str) -> list[str]:
    """The command, as a user gives it."""
    words = [sys.executable, str(ROOT / "shadowgraph"), "run", str(capture), "--out", str(out)]
    return [*words, "--preset", preset, "--viewer", "off"]


def run_until(words: list[str], cores: int, cpu_s: float | None) -> tuple[float, int | None]:
    """CPU seconds used and exit code of the command, killed (None) once it has used so many; None: never."""
    affinity = sorted(os.sched_getaffinity(0))[-cores:]
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, cwd=ROOT)
    watched, used = psutil.Process(process.pid), 0.0
    watched.cpu_affinity(affinity)
    while process.poll() is None:
        try:
            times = watched.cpu_times()
        except psutil.Error:
            break
        used = max(used, times.user + times.system)
        if cpu_s is not None and used >= cpu_s:
            process.kill()
            process.wait()
            return used, None
        time.sleep(POLL_S)
    _, error = process.communicate()
    if process.returncode:
        sys.stderr.write(error.decode())
    return used, process.returncode


def stage_of(out: Path) -> str:
    """Where the log of a killed run ends."""
    log = out / "log.jsonl"
    lines = log.read_text().splitlines() if log.exists() else []
    for line in reversed(lines):
        try:
            entry = json.loads(line)
        except json.JSONDecodeError:
            continue
        return f"{entry['stage']} {entry['done']:g}/{entry['total']:g}"
    return "before the log"


def result(out: Path) -> tuple[np.ndarray, float]:
    """depth.npy and the volume of the mesh."""
    return np.load(out / "depth.npy", allow_pickle=False), float(trimesh.load_mesh(out / "mesh.ply").volume)


def killed_until_done(words: list[str], out: Path, whole: Whole, draw: random.Random, cores: int, most: int):
    """An Outcome of at most so many kills; None where a run that was given again failed."""
    shutil.rmtree(out, ignore_errors=True)
    total, places = 0.0, []
    while True:
        moment = draw.uniform(0, whole.cpu_s) if len(places) < most else None
        used, code = run_until(words, cores, moment)
        total += used
        if code is not None:
            break
        places.append(stage_of(out))
    if code != 0:
        return None
    depth, volume = result(out)
    is_same = bool(np.array_equal(depth, whole.depth))
    return Outcome(tuple(places), max(0.0, total - whole.cpu_s), is_same, abs(volume / whole.volume - 1))


def small_scene(folder: Path) -> Path:
    """A ball, another and a box on a table under 10 lights, in the ShadowNeuS layout."""
    return write_shadowneus(folder, render(HEAP, Look(width=96, height=72, n_lights=10, texture=0.1))[1])


def main() -> int:
    """Print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("capture", type=Path, nargs="?")
    parser.add_argument("--times", type=int, default=200)
    parser.add_argument("--preset", default="draft")
    parser.add_argument("--cores", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    sheet = Sheet(options.table, f"seed {options.seed}")
    work = Path(tempfile.mkdtemp(prefix="kill_run_"))
    capture = (options.capture or small_scene(work / "scene")).resolve()
    if not kernels_are_compiled():
        run_until(command(capture, work / "first", options.preset), options.cores, None)
    straight, code = run_until(command(capture, work / "straight", options.preset), options.cores, None)
    if code != 0:
        return 1
    whole, draw = Whole(straight, *result(work / "straight")), random.Random(options.seed)
    words, outcomes, n_kills = command(capture, work / "killed", options.preset), [], 0
    begin = [f"Uninterrupted: {straight:.1f} CPU s on {options.cores} core(s), preset {options.preset}."]
    while n_kills < options.times:
        outcome = killed_until_done(
            words, work / "killed", whole, draw, options.cores, min(MOST_IN_A_ROW, options.times - n_kills)
        )
        if outcome is None:
            print("the same command given again failed")
            return 1
        if not outcome.killed_in:  # it was finished before its moment
            continue
        outcomes.append(outcome)
        n_kills += len(outcome.killed_in)
        sheet.write([one.row() for one in outcomes], begin, [_summary(outcomes, n_kills)])
    shutil.rmtree(work)
    return int(not all(outcome.is_well(straight) for outcome in outcomes))


def _summary(outcomes: list[Outcome], n_kills: int) -> str:
    """What became of all kills, in one sentence."""
    each = [outcome.lost / len(outcome.killed_in) for outcome in outcomes]
    most = max(outcome.lost for outcome in outcomes)
    alone = [outcome.lost for outcome in outcomes if len(outcome.killed_in) == 1]
    same = sum(outcome.is_same for outcome in outcomes)
    return (
        f"{n_kills} kills of {len(outcomes)} runs, up to {MOST_IN_A_ROW} of one: all went on and were finished, {same} "
        f"the same bit for bit, volume changed by {max(o.change for o in outcomes):.2%} at most. Lost per kill: median "
        f"{np.median(each):.1f} CPU s; where it was the only one of its run, {max(alone, default=0.0):.1f} at most; "
        f"all kills of one run together {most:.1f} at most."
    )


if __name__ == "__main__":
    sys.exit(main())
