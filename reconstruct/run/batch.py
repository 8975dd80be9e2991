"""Run many captures, each in a process of its own: a bad capture never stops the rest.

Each run finds out the available memory and cores itself; a batch only decides how many run at a time. Results are
identified by their folder's name: the same command continues an interrupted batch, repeats captures that failed or
changed, and leaves the rest alone.
"""

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta, Struct

from calibration.scenes.importers import IMPORTERS, OF_A_CAPTURE
from capture.decode.formats import is_photo_name
from capture.errors import FOR_STUDIO, CaptureError, Remedy, UserError
from capture.files.atomic import write_json
from capture.files.names import is_clip_name, refuse_no_folder
from capture.files.schema import FileName, Kind, Number, Text, read_as
from capture.session.session import ROLE_FOLDERS
from reconstruct.run_folder.lock import LOCK, lock_holder
from reconstruct.stored_run.documents import MOST_PHOTOS
from reconstruct.stored_run.stored_run import StoredRun

BATCH, LOGS = "batch.json", "logs"
FORMAT = 1
ROOT = Path(__file__).resolve().parents[2]
PROGRAM = (sys.executable, "-m", "shadowgraph")
SAID_LINES = 4  # of a failed run's last output: enough for its error sentence, even if wrapped
RAY_RETRIES = 3  # of a task whose worker died; each retry continues from the run's checkpoint
GIVES_WAY = 5  # more of niceness: a third of what another program gets of a processor that both want
LEAVING_S = 30.0  # seconds for the cluster to end the run of a dead worker; more are needed while kernels compile


@dataclass(frozen=True)
class Task:
    """One capture to run."""

    name: FileName  # of its folder of results
    capture: str  # its path
    out: str  # the batch's folder
    options: tuple[str, ...] = ()  # of `shadowgraph run`
    threads: int = 1
    program: tuple[str, ...] = PROGRAM


@dataclass(frozen=True)
class Outcome:
    """How one capture ended."""

    name: FileName
    capture: Text
    options: tuple[Text, ...]
    exit_code: int  # 0 done, 2 refused with a sentence, negative: killed by that signal, 1: a defect of ours
    sentence: Text  # why it failed; empty if it did not
    seconds: Number
    began: Number  # seconds since 1970; a file of the capture changed later than this may not be in the result
    report: dict[str, Any] = field(default_factory=dict)  # the part of report.json that the page of results shows


class _BatchFile(Struct):
    format: Literal[1]
    outcomes: Annotated[tuple[Outcome, ...], Meta(max_length=MOST_PHOTOS)]


KEPT = ("unit", "photos", "warnings", "stages", "mesh")  # of report.json


def find_captures(folders: Sequence[Path], out: Path) -> list[Path]:
    """Return the captures among these folders; a folder that is none, but contains one, means all its sub-folders.

    Only names are checked; faults inside a capture are reported by its run. The folder of results may lie among the
    captures and is skipped.

    Raises:
        CaptureError: a folder does not exist, or is given twice.
    """
    found: list[Path] = []
    for folder in folders:
        refuse_no_folder(folder, "a capture, or a folder of captures,")
        places = (path for path in folder.iterdir() if path.is_dir() and path.resolve() != out.resolve())
        inner = sorted(path for path in places if not path.name.startswith("."))
        is_collection = not looks_like_capture(folder) and any(looks_like_capture(path) for path in inner)
        found += inner if is_collection else [folder]
    resolved = [path.resolve() for path in found]
    twice = next((path for path in resolved if resolved.count(path) > 1), None)
    if twice is not None:
        raise CaptureError(f"{twice} was given twice; each capture is run once. Leave one out.")
    return found


def looks_like_capture(folder: Path) -> bool:
    """Return True if the names in a folder are those of a capture: photos, a clip, or a supported layout."""
    if any((folder / name).exists() for name in (*OF_A_CAPTURE, ROLE_FOLDERS["lit"])):
        return True
    if any(is_photo_name(path) or is_clip_name(path) for path in folder.iterdir()):
        return True
    return any(importer.recognises(folder) is not None for importer in IMPORTERS)


def names_of(captures: Sequence[Path]) -> list[str]:
    """Return a unique name for each capture's results: its folder's name (a link's own), with parents where needed."""
    parts = [Path(os.path.abspath(path)).parts[1:] or ("capture",) for path in captures]
    names = []
    for own in parts:
        depth = 1
        while depth < len(own) and sum(other[-depth:] == own[-depth:] for other in parts) > 1:
            depth += 1
        names.append(re.sub(r"[^\w.+-]", "_", "__".join(own[-depth:])).lstrip(".") or "capture")
    return names


def make_tasks(
    captures: Sequence[Path], out: Path, options: tuple[str, ...], jobs: int, threads: int | None = None
) -> list[Task]:
    """Return a task for each capture, with `threads` threads or its share of the cores when `jobs` run at a time."""
    share = threads or max(1, (os.cpu_count() or 1) // jobs)
    named = zip(names_of(captures), captures, strict=True)
    return [Task(name, str(path.resolve()), str(out.resolve()), options, share) for name, path in named]


def run_task(task: Task) -> Outcome:
    """Run one capture, wait for it, and return its Outcome, also if it fails."""
    out = Path(task.out)
    end = time.monotonic() + LEAVING_S  # if the folder is not free then, the run's error names its process
    while lock_holder(out / task.name / LOCK) is not None and time.monotonic() < end:
        time.sleep(0.1)
    start, began = time.monotonic(), time.time()
    process = start_task(task)
    try:
        code = process.wait()
    finally:
        if process.poll() is None:
            process.terminate()  # it saves where it stands
            process.wait()
    seconds = time.monotonic() - start
    sentence = "" if code == 0 else why_it_failed(code, log_file(task))
    report = _report(out / task.name) if code == 0 else {}
    return Outcome(task.name, task.capture, task.options, code, sentence, round(seconds, 1), began, report)


def start_task(task: Task, is_detached: bool = False) -> subprocess.Popen[bytes]:
    """Start the run of a task in a process of its own, which writes what it says into `log_file`.

    Args:
        is_detached: neither Ctrl-C nor the end of this process reaches it; it is the studio's.
    """
    words = ["run", task.capture, "--out", str(Path(task.out) / task.name), "--viewer", "off", *task.options]
    return start_command([*task.program, *words], log_file(task), task.threads, is_detached, for_studio=is_detached)


def start_command(
    words: Sequence[str],
    log: Path,
    threads: int | None = None,
    is_detached: bool = False,
    speaks: bool = False,
    for_studio: bool = False,
) -> subprocess.Popen[bytes]:
    """Start one of our commands; what it says goes into `log`.

    Args:
        threads: that its kernels may use; all cores unless given.
        speaks: its stdin and stdout are pipes, and only its stderr goes into the log.
        for_studio: its errors name the buttons of the page, and it gives way to other programs, where the system has
            priorities: somebody waits for those meanwhile.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    paths = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))
    count = {} if threads is None else {"NUMBA_NUM_THREADS": str(threads), "OMP_NUM_THREADS": str(threads)}
    environment = os.environ | count | {"PYTHONPATH": paths, FOR_STUDIO: str(int(for_studio))}
    with log.open("wb") as file:
        process = subprocess.Popen(
            list(words),
            stdin=subprocess.PIPE if speaks else subprocess.DEVNULL,
            stdout=subprocess.PIPE if speaks else file,
            stderr=file,
            env=environment,
            start_new_session=is_detached,
        )
    if for_studio and hasattr(os, "setpriority"):
        with contextlib.suppress(OSError):  # it has ended already
            os.setpriority(os.PRIO_PROCESS, process.pid, os.getpriority(os.PRIO_PROCESS, 0) + GIVES_WAY)
    return process


def log_file(task: Task) -> Path:
    """Return the file for what the run of a task says."""
    return Path(task.out) / LOGS / f"{task.name}.txt"


def why_it_failed(code: int | None, log: Path) -> str:
    """Return why a run failed, from its exit code (None: unknown) and its last output."""
    if code is not None and code < 0:
        name = signal.Signals(-code).name if -code in set(signal.Signals) else str(-code)
        hint = "; often the system's, for want of memory" if name == "SIGKILL" else ""
        return f"ended by {name}{hint}. Started again, it goes on."
    lines = [line for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    said = next((i for i in range(len(lines) - 1, -1, -1) if lines[i].startswith("shadowgraph: ")), None)
    if said is None and code is None:
        return "ended without a word; often by the system, for want of memory. Started again, it goes on."
    text = " ".join(lines[said:]) if said is not None else " ".join(lines[-SAID_LINES:])
    return text.removeprefix("shadowgraph: ") or f"ended with exit code {code} and said nothing"


def _report(run_dir: Path) -> dict[str, Any]:
    try:
        report = StoredRun(run_dir).report
    except UserError:
        return {}
    return {key: report[key] for key in KEPT if key in report}


def locally(tasks: Sequence[Task], jobs: int) -> Iterator[Outcome]:
    """Run tasks on this machine, `jobs` at a time, and yield each outcome as it ends."""
    with ThreadPoolExecutor(jobs) as pool:
        waiting = [pool.submit(run_task, task) for task in tasks]
        try:
            for done in as_completed(waiting):
                yield done.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def on_ray(tasks: Sequence[Task], address: str) -> Iterator[Outcome]:
    """Run tasks on a Ray cluster, whose machines see the same folders under the same paths; yield each as it ends.

    A task whose worker dies is run again and continues from its checkpoint.

    Args:
        address: as for ray.init: "auto", "host:port", "ray://host:port", or "local" for a cluster on this machine.

    Raises:
        CaptureError: Ray is not installed, or no cluster answers at the address.
    """
    try:
        import ray
    except ImportError as error:
        raise CaptureError("--ray needs Ray, which is not installed: pip install 'shadowgraph[ray]'.") from error
    started_here = not ray.is_initialized()
    if started_here:
        try:
            ray.init(address=address, log_to_driver=False, configure_logging=False)
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise CaptureError(f"--ray {address}: no Ray cluster answers there ({error}).") from error
    try:
        threads = max((task.threads for task in tasks), default=1)
        remote = ray.remote(num_cpus=threads, max_retries=RAY_RETRIES)(run_task)
        pending = {remote.remote(task): task for task in tasks}
        while pending:
            (done,), _ = ray.wait(list(pending), num_returns=1)
            task = pending.pop(done)
            try:
                yield ray.get(done)
            except ray.exceptions.RayError as error:
                said = (
                    f"the cluster lost it {RAY_RETRIES + 1} times ({type(error).__name__}). Started again, it goes on."
                )
                yield Outcome(task.name, task.capture, task.options, 1, said, 0.0, time.time())
    finally:
        if started_here:
            ray.shutdown()


Engine = Callable[[Sequence[Task]], Iterator[Outcome]]


def run_batch(
    tasks: Sequence[Task], engine: Engine, on_outcomes: Callable[[Mapping[str, Outcome]], object]
) -> dict[str, Outcome]:
    """Run the tasks that are not done yet; call `on_outcomes` with all of them so far, first and after each.

    batch.json in the batch's folder is rewritten after each task. A capture that finished before with the same options
    and has not changed since is not run again.
    """
    if not tasks:
        return {}
    file = Path(tasks[0].out) / BATCH
    before = load_outcomes(file)
    outcomes = {task.name: before[task.name] for task in tasks if _is_done(task, before.get(task.name))}
    on_outcomes(outcomes)
    for outcome in engine([task for task in tasks if task.name not in outcomes]):
        outcomes[outcome.name] = outcome
        write_json(file, {"format": FORMAT, "outcomes": [asdict(o) for o in outcomes.values()]})
        on_outcomes(outcomes)
    return outcomes


def load_outcomes(file: Path) -> dict[str, Outcome]:
    """Return the outcomes of an earlier batch, by name; empty if there is no such file.

    Raises:
        CaptureError: the file is damaged or of another format.
    """
    rows = read_record(file, _BatchFile, "batch", Remedy.OTHER_FOLDER).outcomes if file.is_file() else ()
    return {row.name: replace(row, report=_report(file.parent / row.name)) for row in rows}


def read_record(file: Path, kind: type[Kind], what: str, *remedies: Remedy) -> Kind:
    """Return the record of a batch or queue.

    Raises:
        CaptureError: the file is damaged or of another format.
    """
    try:
        return read_as(file, kind, "")[0]
    except UserError as error:
        said = f"{file} is not the record of a {what} ({str(error).rstrip(' .')})."
        raise CaptureError(said, "move it away; the runs stay", *remedies) from error


def _is_done(task: Task, outcome: Outcome | None) -> bool:
    """Return True if the run finished with these options, its result still exists, and the capture has not changed."""
    if outcome is None or outcome.exit_code != 0 or outcome.capture != task.capture:
        return False
    if outcome.options != task.options or not (Path(task.out) / task.name / "report.json").is_file():
        return False
    return all(path.stat().st_mtime <= outcome.began for path in _own_files(Path(task.capture), Path(task.out)))


def _own_files(capture: Path, out: Path) -> Iterator[Path]:
    """Yield the files of a capture, except the results if their folder lies inside it."""
    for path in capture.rglob("*"):
        is_result = out.is_relative_to(capture) and path.is_relative_to(out)
        if path.is_file() and not is_result:
            yield path
