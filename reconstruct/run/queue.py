"""A queue of runs that outlives the program that keeps it: one run at a time, each in a process of its own.

A job is a batch's Task with a state, kept in a file that is written whole after every change. Runs are detached: they
go on while nobody looks. After its next start a queue finds out from process ids, locks and logs what became of them.
"""

import secrets
import subprocess
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Literal

import psutil
from msgspec import Struct

from capture.errors import CaptureError, UserError
from capture.files.atomic import write_json
from capture.files.schema import Count, Number, Text
from reconstruct.run.batch import PROGRAM, Task, log_file, read_record, start_task, why_it_failed
from reconstruct.run_folder.folder import LOG, read_log
from reconstruct.run_folder.lock import LOCK, lock_holder, running

FORMAT = 1
WAITING, RUNNING, FINISHED, FAILED, STOPPED = "waiting", "running", "finished", "failed", "stopped"
MOST_KEPT = 500  # jobs that are over
STOPPED_CODES = (130, 143)  # Ctrl-C, SIGTERM: the run saved its state


@dataclass(frozen=True)
class Job:
    """One run that was asked for."""

    id: Text
    task: Task
    state: Literal["waiting", "running", "finished", "failed", "stopped"] = WAITING
    asked: Number = 0.0  # seconds since 1970
    began: Number = 0.0
    ended: Number = 0.0
    pid: Count = 0  # of its process, while it runs
    started: Number = 0.0  # of that process, by the system
    sentence: Text = ""  # why it failed

    @property
    def run(self) -> Path:
        """Its run folder."""
        return Path(self.task.out) / self.task.name

    @property
    def preset(self) -> str:
        """The preset among its options; "" where none is named."""
        return next((value for name, value in pairwise(self.task.options) if name == "--preset"), "")

    @property
    def is_open(self) -> bool:
        """True while it waits or runs."""
        return self.state in (WAITING, RUNNING)


class _QueueFile(Struct):
    format: Literal[1]
    jobs: list[Job]


class Queue:
    """The jobs of one file, in the order in which they will run. Methods may be called from any thread."""

    def __init__(self, file: Path, program: tuple[str, ...] = PROGRAM, refuse: Callable[[Task], None] | None = None):
        """Read what the file holds; `tick` then takes up what runs.

        Args:
            program: what to start in the place of `python -m shadowgraph`.
            refuse: called with a task that is about to start; the sentence of a UserError that it raises fails the job.

        Raises:
            CaptureError: the file is damaged or of another format.
        """
        self._file, self._program, self._refuse = file, program, refuse
        self._lock = threading.RLock()
        self._children: dict[str, subprocess.Popen[bytes]] = {}
        self._jobs = _load(file, program)
        self._is_stale = False  # the file: what became of jobs could not be written yet

    @property
    def jobs(self) -> tuple[Job, ...]:
        """Every job: what is over, what runs, what waits, in this order."""
        with self._lock:
            return tuple(self._jobs)

    def add(self, task: Task) -> Job:
        """Ask for a run, after all others.

        Raises:
            CaptureError: the same run folder is asked for already.
        """
        with self._lock:
            task = replace(task, program=self._program)
            job = Job(secrets.token_hex(8), task, asked=time.time())
            if any(other.is_open and other.run == job.run for other in self._jobs):
                raise CaptureError(f"{task.name} runs or waits already. Stop it first, or wait for its end.")
            self._write([*(other for other in self._jobs if other.run != job.run or other.is_open), job])
            return job

    def find(self, id_: str) -> Job:
        """Return a job.

        Raises:
            CaptureError: there is none with this id.
        """
        for job in self.jobs:
            if job.id == id_:
                return job
        raise CaptureError("This job is no longer in the queue.")

    def stop(self, id_: str) -> None:
        """Take a job that waits out of the queue; tell one that runs to save its state and end."""
        with self._lock:
            job = self.find(id_)
            if job.state == WAITING:
                stopped = replace(job, state=STOPPED, ended=time.time())
                self._write([stopped if other is job else other for other in self._jobs])
            elif job.state == RUNNING:
                process = running(job.pid, job.started)
                if process is not None:
                    process.terminate()

    def first(self, id_: str) -> None:
        """Move a job that waits before all others that wait."""
        with self._lock:
            job = self.find(id_)
            others = [other for other in self._jobs if other is not job]
            at = next((k for k, other in enumerate(others) if other.state == WAITING), len(others))
            self._write([*others[:at], job, *others[at:]])

    def again(self, id_: str) -> None:
        """Ask once more for a run that failed or was stopped: it goes on where it stood."""
        with self._lock:
            job = self.find(id_)
            if not job.is_open:
                self.add(job.task)  # which forgets this one

    def forget(self, run: Path) -> None:
        """Forget the jobs of a run folder that are over."""
        with self._lock:
            self._write([job for job in self._jobs if job.is_open or job.run != run])

    def tick(self) -> None:
        """Note what has ended, and start the next job if none runs.

        Raises:
            OSError: the file cannot be written. What became of jobs is known all the same, and written by a later tick.
        """
        with self._lock:
            if self._is_stale:
                self._note(self._jobs)
            for job in self._jobs:
                if job.state == RUNNING:
                    self._look_after(job)
            if not any(job.state == RUNNING for job in self._jobs):
                job = next((job for job in self._jobs if job.state == WAITING), None)
                if job is not None:
                    self._start(job)

    def _start(self, job: Job) -> None:
        holder = lock_holder(job.run / LOCK)  # started before the queue was killed, or in a terminal
        try:
            if holder is None:
                if self._refuse is not None:
                    self._refuse(job.task)
                child = start_task(job.task, is_detached=True)
                self._children[job.id], holder = child, child.pid
        except (UserError, OSError) as error:
            is_refused = isinstance(error, UserError)
            sentence = str(error) if is_refused else f"it could not be started: {error.strerror or error}."
            self._change(job, state=FAILED, began=time.time(), ended=time.time(), sentence=sentence)
            return
        try:
            started = psutil.Process(holder).create_time()
        except psutil.Error:  # over already
            started = 0.0
        self._change(job, state=RUNNING, began=time.time(), pid=holder, started=started)

    def _look_after(self, job: Job) -> None:
        child = self._children.get(job.id)
        code = None if child is None else child.poll()
        if code is None and (child is not None or running(job.pid, job.started) is not None):
            return
        self._children.pop(job.id, None)
        state, sentence = _end_of(job, code)
        self._change(job, state=state, sentence=sentence, ended=time.time(), pid=0, started=0.0)

    def _change(self, job: Job, **values: str | float | int) -> None:
        self._note([replace(job, **values) if other.id == job.id else other for other in self._jobs])

    def _note(self, jobs: list[Job]) -> None:
        """Keep what has become of jobs, also where the file cannot be written: a run that was started is not undone."""
        self._jobs, self._is_stale = _in_order(jobs), True
        self._write(self._jobs)

    def _write(self, jobs: list[Job]) -> None:
        """Write the file; only then is it so: what could not be written was not asked for."""
        jobs = _in_order(jobs)
        parts = ("name", "capture", "out", "options")  # of a task
        rows = [asdict(job) | {"task": {name: getattr(job.task, name) for name in parts}} for job in jobs]
        write_json(self._file, {"format": FORMAT, "jobs": rows})
        self._jobs, self._is_stale = jobs, False


def _in_order(jobs: list[Job]) -> list[Job]:
    """What is over, as far as it is kept, what runs, what waits."""
    over = [job for job in jobs if not job.is_open][-MOST_KEPT:]
    running = [job for job in jobs if job.state == RUNNING]
    return [*over, *running, *(job for job in jobs if job.state == WAITING)]


def _end_of(job: Job, code: int | None) -> tuple[str, str]:
    """Return the state of a run whose process is gone, and why it failed."""
    try:
        lines = read_log(job.run / LOG)
    except OSError:
        lines = []
    if code == 0 or (code is None and lines and lines[-1]["stage"] == "done"):
        return FINISHED, ""
    said = lines[-1]["message"] if lines else ""
    if code in STOPPED_CODES or (
        code is None and said.startswith(("stopped: KeyboardInterrupt", "stopped: Terminated"))
    ):
        return STOPPED, ""
    try:
        return FAILED, why_it_failed(code, log_file(job.task))
    except OSError:
        return FAILED, "its output is gone. Start it again."


def _load(file: Path, program: tuple[str, ...]) -> list[Job]:
    jobs, threads = read_record(file, _QueueFile, "queue").jobs if file.is_file() else [], psutil.cpu_count() or 1
    return [replace(job, task=replace(job.task, threads=threads, program=program)) for job in jobs]
