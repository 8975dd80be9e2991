"""kill -9 at random moments of a run: does the same command finish it, what work was lost, is the result the same?

    python benchmarks/soak/kill_run.py [CAPTURE] [--times 200] [--preset draft] [--cores 1] [--table FILE]

CAPTURE is a folder that `shadowgraph run` takes; without one, a small scene is rendered. One uninterrupted run tells
how long a run takes and what it gives (after one more where kernels have to be compiled). Each further one is killed
at a moment drawn evenly over that time, and the same command is given again. Lost work is the CPU time of both beyond
that of the uninterrupted run: it includes starting the program and reading the photos again. Writes a Markdown table;
exit code 1 where a bar is missed.
"""

import argparse
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

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from synthetic import HEAP, Look, render  # noqa: E402  # pyright: ignore[reportMissingImports]
from test_end_to_end import write_scene  # noqa: E402  # pyright: ignore[reportMissingImports]

from reconstruct.machine import kernels_are_compiled  # noqa: E402

MOST_LOST_S, MOST_LOST_SHARE = 30.0, 0.02  # CPU seconds, or of the whole run: the larger one counts
MOST_CHANGE = 0.01  # of the mesh's volume and of the median depth
POLL_S = 0.01


@dataclass(frozen=True)
class Outcome:
    """One run that was killed and given again."""

    killed_after: float  # CPU s
    stage: str
    lost: float  # CPU s
    is_same: bool  # depth.npy, bit for bit
    change: float  # relative, of the mesh's volume

    def is_well(self, whole: float) -> bool:
        """Within the bars, for a run that takes `whole` CPU seconds."""
        return self.lost <= max(MOST_LOST_S, MOST_LOST_SHARE * whole) and self.change <= MOST_CHANGE


def command(capture: Path, out: Path, preset: str) -> list[str]:
    """The command, as a user gives it."""
    words = [sys.executable, str(ROOT / "shadowgraph.py"), "run", str(capture), "--out", str(out)]
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


def one_kill(capture: Path, work: Path, moment: float, whole: tuple[float, np.ndarray, float], cores: int, preset: str):
    """Kill once the run has used `moment` CPU seconds, run again, compare; None where the second run failed."""
    straight, depth, volume = whole
    out = work / "killed"
    shutil.rmtree(out, ignore_errors=True)
    words = command(capture, out, preset)
    used, code = run_until(words, cores, moment)
    stage = stage_of(out) if code is None else "finished before"
    more, code = run_until(words, cores, None)
    if code != 0:
        return None
    now_depth, now_volume = result(out)
    lost = max(0.0, used + more - straight)
    is_same = bool(np.array_equal(depth, now_depth))
    return Outcome(used, stage, lost, is_same, abs(now_volume / volume - 1))


def small_scene(folder: Path) -> Path:
    """A ball, another and a box on a table under 14 lights, in the ShadowNeuS layout."""
    return write_scene(folder, render(HEAP, Look(width=160, height=120, n_lights=14, texture=0.1))[1])


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path, nargs="?")
    parser.add_argument("--times", type=int, default=200)
    parser.add_argument("--preset", default="draft")
    parser.add_argument("--cores", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--table", type=Path)
    options = parser.parse_args()
    work = Path(tempfile.mkdtemp(prefix="kill_run_"))
    capture = (options.capture or small_scene(work / "scene")).resolve()
    words = command(capture, work / "straight", options.preset)
    if not kernels_are_compiled():
        run_until(command(capture, work / "first", options.preset), options.cores, None)
    straight, code = run_until(words, options.cores, None)
    if code != 0:
        return 1
    whole, draw = (straight, *result(work / "straight")), random.Random(options.seed)
    head = f"Uninterrupted: {straight:.1f} CPU s on {options.cores} core(s), preset {options.preset}."
    lines = [head, "", "| killed after CPU s | in | lost CPU s | same depth, bit for bit | volume changed by |"]
    lines += ["|---|---|---|---|---|"]
    outcomes, failed = [], 0
    for _ in range(options.times):
        moment = draw.uniform(0, straight)
        outcome = one_kill(capture, work, moment, whole, options.cores, options.preset)
        if outcome is None:
            failed += 1
            lines.append(f"| {moment:.1f} | | did not resume | | |")
        else:
            outcomes.append(outcome)
            same = "yes" if outcome.is_same else "no"
            row = (f"{outcome.killed_after:.1f}", outcome.stage, f"{outcome.lost:.1f}", same, f"{outcome.change:.2%}")
            lines.append(f"| {' | '.join(row)} |")
        print(lines[-1], flush=True)
    lost, n_well = [o.lost for o in outcomes], sum(o.is_well(straight) for o in outcomes)
    same = sum(outcome.is_same for outcome in outcomes)
    found = f"lost work: median {np.median(lost):.1f}, most {max(lost):.1f} CPU s" if lost else "nothing to compare"
    lines += ["", f"{len(outcomes)} of {options.times} resumed; {found}; {same} the same bit for bit; {n_well} well."]
    text = "\n".join(lines) + "\n"
    print(text)
    if options.table:
        options.table.write_text(text)
    shutil.rmtree(work)
    return int(failed > 0 or n_well < len(outcomes))


if __name__ == "__main__":
    sys.exit(main())
