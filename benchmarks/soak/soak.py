"""A page that is looked at for hours while runs go on: do memory and file handles of both stay flat?

    python benchmarks/soak/soak.py [--minutes 120] [--capture FOLDER] [--preset draft] [--table FILE]

One `shadowgraph view` follows a run folder in which the same run is made again and again with other seeds; a client
opens the page's WebSocket anew every few seconds. Memory and open files of the page's process are sampled; warm-up is
the first quarter. Runs are processes of their own: their peaks are compared, first to last.
Exit code 1 where the page's memory grows by more than 5 % or its open files by more than 2 after the warm-up.
"""

import contextlib
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil
import viser
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

sys.path.insert(0, str(Path(__file__).parents[1]))

from sheet import ROOT, Sheet, parser_of

# isort: split
from kill_run import small_scene

PORT = 8471
WARM_UP = 0.25
MOST_GROWTH, MOST_FILES = 0.05, 2
VISIT_S, SAMPLE_S = 5.0, 2.0
FRAMES_READ = 30  # of a visit


def visit(port: int) -> bool:
    """Open the page's WebSocket as its page does, read what comes, and leave; whether it answered."""
    try:
        here = f"127.0.0.1:{port}"
        spoken = [f"viser-v{viser.__version__}"]
        with connect(f"ws://{here}", origin=f"http://{here}", subprotocols=spoken, max_size=None) as socket:
            for _ in range(FRAMES_READ):
                socket.recv(timeout=1)
    except TimeoutError:
        return True  # nothing more to tell
    except (OSError, EOFError, WebSocketException):
        return False
    return True


def start_run(capture: Path, out: Path, preset: str, seed: int) -> subprocess.Popen:
    """A whole run in the folder that the page follows."""
    words = [sys.executable, str(ROOT / "shadowgraph"), "run", str(capture), "--out", str(out), "--force"]
    words += ["--preset", preset, "--seed", str(seed), "--viewer", "off"]
    return subprocess.Popen(words, cwd=ROOT, stdout=subprocess.DEVNULL)


def soak(
    capture: Path, out: Path, preset: str, minutes: float
) -> tuple[list[tuple[float, int, int]], list[int], int, int]:
    """Samples of the page (s, bytes, open files), peaks of the runs, visits that were answered, and all visits."""
    words = [sys.executable, str(ROOT / "shadowgraph"), "view", str(out), "--port", str(PORT)]
    run = start_run(capture, out, preset, 0)
    while not (out / "log.jsonl").exists():
        time.sleep(0.2)
    page = subprocess.Popen(words, cwd=ROOT, stdout=subprocess.DEVNULL)
    watched, samples, peaks = psutil.Process(page.pid), [], [0]
    begin, seed, answered, visits, next_visit = time.monotonic(), 0, 0, 0, 20.0
    while (now := time.monotonic() - begin) < 60 * minutes and page.poll() is None:
        samples.append((now, watched.memory_info().rss, watched.num_fds()))
        if run.poll() is None:
            with contextlib.suppress(psutil.Error):
                peaks[-1] = max(peaks[-1], psutil.Process(run.pid).memory_info().rss)
        else:
            seed += 1
            peaks.append(0)
            run = start_run(capture, out, preset, seed)
        if now > next_visit:
            visits, next_visit = visits + 1, now + VISIT_S
            answered += visit(PORT)
        time.sleep(SAMPLE_S)
    for process in (run, page):
        process.terminate()
        process.wait()
    return samples, peaks[:-1], answered, visits


def main() -> int:
    """Print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("--minutes", type=float, default=120.0)
    parser.add_argument("--capture", type=Path)
    parser.add_argument("--preset", default="draft")
    options = parser.parse_args()
    sheet = Sheet(options.table, "seeds from 0")
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        capture = options.capture or small_scene(work / "scene")
        samples, peaks, answered, visits = soak(capture, work / "run", options.preset, options.minutes)
    warm = [row for row in samples if row[0] > WARM_UP * samples[-1][0]]
    third = max(1, len(warm) // 3)
    first, last = (np.median([row[1] for row in part]) for part in (warm[:third], warm[-third:]))
    handles = [int(np.median([row[2] for row in part])) for part in (warm[:third], warm[-third:])]
    growth = float(last / first - 1)
    row = {"minutes": f"{samples[-1][0] / 60:.1f}", "runs": len(peaks), "visits answered": f"{answered} of {visits}"}
    row |= {"page MB: warm, at the end": f"{first / 1e6:.0f}, {last / 1e6:.0f}", "growth": f"{growth:+.1%}"}
    row |= {"open files": f"{handles[0]}, {handles[1]}", "run peaks MB": [f"{peak / 1e6:.0f}" for peak in peaks]}
    sheet.write([row])
    is_flat = growth <= MOST_GROWTH and handles[1] - handles[0] <= MOST_FILES
    return int(not is_flat or answered < visits)


if __name__ == "__main__":
    sys.exit(main())
