"""Two thousand damaged run folders: does each command that reads one end in a result or in a sentence?

    python benchmarks/fuzz_runs.py [--runs 2000] [--fresh 60] [--seed 0] [--first 0] [--table FILE]

The runs are those of tests/damaged_runs.py: every file that a run may hold, of one view and, every third folder, of
several views with the object laid anew. One of the files, sometimes two, is damaged byte by byte or by its structure,
and one command reads the folder, in a process of its own with 2 GB of memory and 20 s of computing: a fork of this one,
which has imported what the commands import. --fresh folders more are read by command lines as a user types them, in new
interpreters. Exit code 1 for any traceback, signal, hang, flood of memory, file read or
written elsewhere, and text of the folder that becomes markup.
"""

import contextlib
import importlib
import io
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from fuzz_commands import COMMANDS, FRESH
from sheet import ROOT, Sheet, parser_of

# isort: split
import confined  # pyright: ignore[reportMissingImports]
import damaged_runs  # pyright: ignore[reportMissingImports]
from numba.core.registry import cpu_target

import reconstruct.evaluate.metrics
import viewer.report.document
from calibration.calibration import load_calibration
from capture.errors import UserError
from reconstruct.appearance.brdf import facing_reflectances

MEMORY = 2 << 30  # bytes
SECONDS = 20  # of computing; by the clock PATIENCE times as many, because other programs use the processor, too
PATIENCE = 20
IMPORTING = 20  # s of computing that a new interpreter may need before it reads anything
FEW_SAMPLES = 3000  # of a surface, to evaluate it
OUTPUT = 4000  # letters of what a command says that are looked at
WELL = ("result", "sentence")
THREADS = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS")
EVERY = 3  # of so many folders one is of several views
OFTEN = 4  # times as often as the two commands that compute most
DRAWN = tuple(name for name in COMMANDS for _ in range(1 if name in ("report", "evaluate") else OFTEN))


def run_one(case: Path, name: str) -> tuple[str, str]:
    """Let one command read a run in a process of its own; what became of it, and what it said."""
    said = case / "said"
    pid = os.fork()
    if not pid:
        _child(case, name, said)
    end = time.monotonic() + PATIENCE * SECONDS
    while True:
        found, status, usage = os.wait4(pid, os.WNOHANG)
        if found:
            break
        if time.monotonic() > end:
            os.killpg(pid, signal.SIGKILL)
            os.wait4(pid, 0)
            return "hang", ""
        time.sleep(0.01)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(pid, signal.SIGKILL)  # decoders that it left
    text = said.read_text(errors="replace")[-OUTPUT:] if said.exists() else ""
    if os.WIFSIGNALED(status):
        return f"signal {signal.Signals(os.WTERMSIG(status)).name}", text
    if usage.ru_maxrss * 1024 > MEMORY:
        return f"{usage.ru_maxrss / 2**20:.1f} GB", text
    return _verdict(case, os.WEXITSTATUS(status), text), text


def _verdict(case: Path, code: int, text: str) -> str:
    if (case / "heap" / "RAN").exists():
        return "ran code of the folder"
    page = case / "heap" / "report.html"
    if page.is_file() and "<script>alert" in page.read_text(errors="replace"):
        return "markup in the report"
    if code == 2:
        lines = [line for line in text.splitlines() if line.startswith("shadowgraph: ")]
        return "sentence" if len(lines) == 1 and "memory of this machine" not in lines[0] else "no sentence"
    return {0: "result", 3: "traceback", 4: "reached out"}.get(code, f"code {code}")


def run_fresh(case: Path, name: str) -> tuple[str, str]:
    """Let a command line of a new interpreter read a run; what became of it, and what it said."""

    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_CPU, (IMPORTING + SECONDS, IMPORTING + SECONDS + 1))

    (case / "out").mkdir()
    named = {"run": case / "heap", "out": case / "out", "reference": case.parent / "reference"}
    words = [sys.executable, str(ROOT / "shadowgraph"), *(word.format(**named) for word in FRESH[name])]
    try:
        done = subprocess.run(
            words,
            capture_output=True,
            cwd=case,
            stdin=subprocess.DEVNULL,
            timeout=PATIENCE * SECONDS,
            preexec_fn=limited,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return "hang", ""
    text = (done.stdout + done.stderr).decode(errors="replace")[-OUTPUT:]
    if done.returncode < 0:
        return f"signal {signal.Signals(-done.returncode).name}", text
    return ("traceback" if "Traceback" in text else _verdict(case, done.returncode, text)), text


def _child(case: Path, name: str, said: Path) -> None:
    """Run a command under limits, and end the process with its exit code."""
    os.setpgid(0, 0)
    code = 3
    try:
        stream = said.open("w")
        os.dup2(stream.fileno(), 1)
        os.dup2(stream.fileno(), 2)
        sys.stdout = sys.stderr = io.TextIOWrapper(os.fdopen(os.dup(2), "wb", 0), write_through=True)
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS + 1))
        now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (now + 2 * MEMORY, now + 2 * MEMORY))
        os.chdir(case)
        (case / "temporary").mkdir()
        tempfile.tempdir = str(case / "temporary")
        watch = confined.Watch(case)
        confined._watches.append(watch)
        try:
            code = COMMANDS[name](case / "heap")
        except UserError as error:
            print(f"shadowgraph: {error}", file=sys.stderr)
            code = 2
        secret = [path for path in watch.read if "secret" in os.path.realpath(path)]
        ran = [event for event in watch.ran if not event.startswith("pickle.find_class")]  # numba's own cache
        if ran or watch.written or secret:
            print(ran[:2], watch.written[:2], secret[:2], file=sys.stderr)
            code = 4
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 3
    except BaseException:  # noqa: BLE001  what this script looks for
        traceback.print_exc()
        code = 3
    finally:
        sys.stderr.flush()
        os._exit(code)


def reference_of(folder: Path, run: Path) -> None:
    """A scene with its truth, to evaluate the run with: its own maps and mesh."""
    truth = folder / "reference" / "gt"
    truth.mkdir(parents=True)
    for name in ("depth.npy", "normal.npy", "mask.png", "mesh.ply"):
        shutil.copy(run / name, truth / name)
    camera = load_calibration(run / "calibration.json").camera
    pose = load_calibration(run / "calibration.json").world_from_camera.matrix().tolist()
    k = [[camera.fx, 0, camera.cx + 0.5], [0, camera.fy, camera.cy + 0.5], [0, 0, 1]]
    given = {"width": camera.width, "height": camera.height, "K": k, "world_from_camera": pose}
    (truth / "camera.json").write_text(json.dumps(given))
    (truth / "ground.json").write_text(json.dumps({"z": 0.0}))


def main() -> int:
    """Print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("--runs", type=int, default=2000)
    parser.add_argument("--fresh", type=int, default=0, help="folders more for new interpreters")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="the number of the first folder")
    parser.add_argument("--only", help="one command")
    parser.add_argument("--seconds", type=float, default=1e9, help="stop after so many seconds")
    options = parser.parse_args()
    if os.environ.get(THREADS[0]) != "1":  # this process forks, and must have no threads
        os.execve(sys.executable, [sys.executable, *sys.argv], os.environ | dict.fromkeys(THREADS, "1"))
    sheet = Sheet(options.table, f"seed {options.seed}, from folder {options.first}")
    tally = Tally()
    end = time.monotonic() + options.seconds
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
        work = Path(name)
        _in_a_child(lambda: damaged_runs.make(work / "base"))
        _in_a_child(lambda: damaged_runs.make_several(work / "several"))
        _in_a_child(lambda: reference_of(work, work / "base" / "heap"))
        warm_up(work)
        lighten()
        if (threads := len(os.listdir("/proc/self/task"))) > 1:
            raise SystemExit(f"{threads} threads in the process that forks, 1 needed")
        for number in range(options.first, options.first + options.runs + options.fresh):
            if time.monotonic() > end:
                break
            is_fresh = number >= options.first + options.runs
            draw = random.Random(f"{options.seed} {number}")
            case, how = _damaged_case(work, number, draw)
            command = options.only or draw.choice(tuple(FRESH) if is_fresh else DRAWN)
            start = time.monotonic()
            found, said = (run_fresh if is_fresh else run_one)(case, command)
            tally.count(f"{command}, new interpreter" if is_fresh else command, found, time.monotonic() - start)
            if found not in WELL:
                print(f"{number}\t{command}\t{how}\t{found}\t{said[-1500:]!r}", flush=True)
            shutil.rmtree(case, ignore_errors=True)
            if number % 100 == 99:
                print(number + 1, tally.total(), file=sys.stderr, flush=True)
    sheet.write(tally.rows())
    return int(not tally.is_well())


class Tally:
    """What became of the folders, by command."""

    def __init__(self):
        self._counts: dict[str, Counter[str]] = {}
        self._slowest: Counter[str] = Counter()

    def count(self, command: str, found: str, seconds: float) -> None:
        """One folder more."""
        self._counts.setdefault(command, Counter())[found] += 1
        self._slowest[command] = max(self._slowest[command], seconds)

    def total(self) -> Counter[str]:
        """Of all commands."""
        return sum(self._counts.values(), Counter())

    def is_well(self) -> bool:
        """Each ended in a result or in a sentence."""
        return set(self.total()) <= set(WELL)

    def rows(self) -> list[dict]:
        """One row for each command, and one for all."""
        rows = [_row(command, found, self._slowest[command]) for command, found in sorted(self._counts.items())]
        return [*rows, _row("together", self.total(), max(self._slowest.values(), default=0.0))]


def _damaged_case(work: Path, number: int, draw: random.Random) -> tuple[Path, str]:
    """A damaged copy of the run, beside a file that nobody may read, and what was done to it."""
    case = work / f"case{number}"
    shutil.copytree(work / ("several" if number % EVERY == 0 else "base") / "heap", case / "heap")
    (case / "secret").write_text("{}")
    return case, damaged_runs.damaged(draw, case / "heap")


def warm_up(work: Path) -> None:
    """Import what the commands import on the undamaged run, so that no child has to; they must start no thread."""
    listed = work / "modules"
    for number, name in enumerate(COMMANDS):
        case = work / f"warm{number}"
        shutil.copytree(work / "base" / "heap", case / "heap")

        def tell(case: Path = case, name: str = name) -> None:
            quiet = contextlib.ExitStack()
            said = quiet.enter_context((case / "said").open("w"))
            with (
                quiet,
                contextlib.redirect_stdout(said),
                contextlib.redirect_stderr(said),
                contextlib.suppress(UserError),
            ):
                COMMANDS[name](case / "heap")
            listed.write_text("\n".join(sys.modules))

        _in_a_child(tell)
        for module in listed.read_text().splitlines():
            with contextlib.suppress(ImportError, AttributeError):
                importlib.import_module(module)
        shutil.rmtree(case, ignore_errors=True)
    for context in (cpu_target.typing_context, cpu_target.target_context):
        context.refresh()  # of numba: what every first call of a kernel would do


def lighten() -> None:
    """Small pictures and few samples: what a command computes from a run that was read is not what is tried here."""
    viewer.report.document.OVERSAMPLING = 1
    reconstruct.evaluate.metrics.SAMPLES = FEW_SAMPLES
    facing_reflectances()  # a table that every process would make for itself


def _row(name: str, found: Counter[str], slowest: float) -> dict:
    others = {kind: count for kind, count in found.items() if kind not in WELL}
    row = {"command": name, "folders": sum(found.values()), "result": found["result"], "sentence": found["sentence"]}
    said = ", ".join(f"{count} {kind}" for kind, count in sorted(others.items())) or "none"
    return row | {"anything else": said, "slowest s": round(slowest, 1)}


def _in_a_child(do: Callable[[], object]) -> None:
    """Do something that starts threads in a process of its own."""
    pid = os.fork()
    if not pid:
        code = 1
        try:
            do()
            code = 0
        except BaseException:  # noqa: BLE001
            traceback.print_exc()
        os._exit(code)
    if os.waitpid(pid, 0)[1]:
        raise SystemExit("the run to damage could not be made")


if __name__ == "__main__":
    sys.exit(main())
