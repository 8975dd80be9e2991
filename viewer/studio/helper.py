"""A process beside the server for what is slow or touches strangers' pictures; both speak lines of JSON.

A task is a function of viewer/studio/tasks.py by its name; one with an argument `on_progress` says in lines how far it
is before it answers. A helper that dies fails the task at hand and is started again for the next one; one that waits
for long is ended, which gives its memory back.

The 3D pages of runs (`shadowgraph view`), too, are each a process of its own, which ends with the studio.
"""

import inspect
import json
import re
import subprocess
import sys
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from capture.errors import CaptureError, Remedy, UserError
from capture.files.atomic import parse_json
from capture.files.regular import read_regular
from reconstruct.run.batch import PROGRAM as COMMAND
from reconstruct.run.batch import start_command, why_it_failed
from viewer.studio.folder import StudioFolder

PROGRAM = (sys.executable, "-m", "viewer.studio.tasks")
IDLE_S = 120.0  # after which a helper is ended
LONGEST_ANSWER = 8 << 20  # bytes
GONE = "the helper process ended before it had answered; often the system ends it, for want of memory. Try again."
CANCELLED = "Cancelled."
BUTTONS = {  # of the page, for the remedies of an error; "": the page has no way to do it
    Remedy.NAME_BOARD: 'choose the board under "Board"',
    Remedy.BOARD_PHOTO: 'choose "board" below the picture that shows it',
    Remedy.LIGHTS_FILE: "drop a file of lights with the photos",
    Remedy.GROUND: "",
    Remedy.COARSER: 'start "A first look"',
    Remedy.OTHER_SEED: "start another run",
    Remedy.START_AGAIN: "",
    Remedy.OTHER_FOLDER: "start another run",
    Remedy.PACK_FAULT: "",
}
MOST_PAGES = 3  # at a time: each takes some hundred megabytes
PAGE_LOG = "view.txt"
PATIENCE_S = 60.0  # until a page answers
ADDRESS = re.compile(r"Open (http://localhost:\d+\S*)")  # as `view` prints it


class Task(Future[Any]):
    """A request, as a line of JSON, and its answer to come: a JSON value, or a CaptureError."""

    def __init__(self, request: str):
        """Nothing is known of it yet."""
        super().__init__()
        self.request = request
        self.share: float | None = None  # that is done; None while it waits, or where it does not say


class Helper:
    """One process and the tasks that wait for it, in order; the same task is done once at a time."""

    def __init__(self, log: Path):
        """Start nothing yet; what the process says on stderr goes into `log`."""
        self._log = log
        self._waiting: OrderedDict[str, Task] = OrderedDict()  # by their requests
        self._changed = threading.Condition()
        self._process: subprocess.Popen[bytes] | None = None
        self._at_hand: Task | None = None
        self._is_closed = False
        self._thread = threading.Thread(target=self._work, name="helper", daemon=True)
        self._thread.start()

    def ask(self, task: str, is_urgent: bool = False, **arguments: Any) -> Task:
        """Return a task by its name and arguments: that which waits already, or a new one.

        Args:
            is_urgent: a new one comes before all others that wait.
        """
        new = Task(json.dumps({"task": task, "arguments": arguments}, sort_keys=True))
        with self._changed:
            found = self._waiting.setdefault(new.request, new)
            if found is new and is_urgent:
                self._waiting.move_to_end(new.request, last=False)
            self._changed.notify()
        return found

    def cancel(self, task: Task) -> None:
        """Let a task fail with CANCELLED, and end the process if it is at it; nothing where the task is done."""
        with self._changed:
            is_waiting, is_at_hand = self._is_wanted(task), task is self._at_hand
            if is_waiting:
                self._waiting.pop(task.request)
            if is_at_hand and self._process is not None:
                self._process.kill()  # the thread that waits for its answer does the rest
        if is_waiting and not is_at_hand:
            task.set_exception(CaptureError(CANCELLED))

    def close(self) -> None:
        """End the process; tasks that wait fail."""
        with self._changed:
            self._is_closed = True
            self._changed.notify()
        self._end()

    def _is_wanted(self, task: Task) -> bool:
        return self._waiting.get(task.request) is task

    def _work(self) -> None:
        while not self._is_closed:
            with self._changed:
                if not self._waiting and not self._changed.wait(IDLE_S):
                    self._end()
                if not self._waiting:
                    continue
                task = self._at_hand = next(iter(self._waiting.values()))
            try:
                answer = self._exchange(task)
            except (OSError, ValueError):
                answer = {"error": GONE}
            with self._changed:
                self._at_hand = None
                is_wanted = self._is_wanted(task)
                if is_wanted:
                    self._waiting.pop(task.request)
            if answer.get("error") == GONE or not is_wanted:  # it may have been killed just after its answer
                self._end()
            if not is_wanted:
                answer = {"error": CANCELLED}
            if "error" in answer:
                task.set_exception(CaptureError(str(answer["error"])[:1000]))
            else:
                task.set_result(answer.get("answer"))

    def _exchange(self, task: Task) -> dict[str, Any]:
        with self._changed:
            if not self._is_wanted(task):
                raise ValueError(CANCELLED)
            if self._process is None or self._process.poll() is not None:
                self._process = start_command(PROGRAM, self._log, speaks=True)
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(task.request.encode() + b"\n")
        self._process.stdin.flush()
        while True:
            line = self._process.stdout.readline(LONGEST_ANSWER)
            answer = parse_json(line.decode()) if line.endswith(b"\n") else None
            if not isinstance(answer, dict):
                raise ValueError("no answer")
            if "share" not in answer:
                return answer
            task.share = float(answer["share"])

    def _end(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    pipe.close()


class Newest:
    """The newest answers of one kind of task, by what each is about: asked for anew once that has changed."""

    def __init__(self, helper: Helper, task: str):
        """Ask nothing yet."""
        self._helper, self._task = helper, task
        self._pending: dict[Any, tuple[Task, str]] = {}
        self._answers: dict[Any, tuple[Any, str]] = {}  # and the mark that it is of

    def about(self, key: Any, mark: str, **arguments: Any) -> Any:
        """Return the newest answer, None where there is none yet, and ask for one of this mark. The caller comes again.

        Args:
            mark: changes with the answer; "": there is nothing to ask for.
        """
        answer, before = self._answers.get(key, (None, ""))
        task, asked = self._pending.get(key, (None, ""))
        if task is not None and task.done():
            self._pending.pop(key, None)  # another request may have been here
            if task.exception() is None:
                answer, before = self._answers[key] = task.result(), asked
            task = None
        if task is None and mark not in ("", before):
            self._pending[key] = self._helper.ask(self._task, is_urgent=True, **arguments), mark
        return answer


def in_page_words(error: Exception) -> str:
    """Return the text of an error with the buttons of the page for what is to be done."""
    return error.worded(lambda one: BUTTONS.get(one, one.value)) if isinstance(error, UserError) else str(error)


def answer_lines(tasks: dict[str, Callable[..., Any]]) -> None:
    """Answer the requests on stdin until it is closed; what else is printed goes to stderr."""
    answers, sys.stdout = sys.stdout, sys.stderr

    def say(line: dict[str, Any]) -> None:
        answers.write(json.dumps(line, allow_nan=False) + "\n")
        answers.flush()

    def on_progress(done: int, total: int, _message: str) -> None:
        say({"share": done / max(total, 1)})

    for line in sys.stdin:
        request = parse_json(line)
        started, task = time.monotonic(), tasks[request["task"]]
        told = {"on_progress": on_progress} if "on_progress" in inspect.signature(task).parameters else {}
        try:
            answer = {"answer": task(**request["arguments"], **told)}
        except Exception as error:  # noqa: BLE001  a stranger's picture may end in anything
            answer = {"error": in_page_words(error) or type(error).__name__}
        sys.stderr.write(f"{request['task']} {time.monotonic() - started:.2f} s {answer.get('error', '')}\n")
        say(answer)


class LivePages:
    """Opens pages, and ends the oldest where there are too many."""

    def __init__(self, folder: StudioFolder):
        """Open nothing yet."""
        self._folder, self._lock = folder, threading.Lock()
        self._open: dict[Path, tuple[subprocess.Popen[bytes], str]] = {}

    def open(self, key: str) -> str:
        """Return the address of the page of a run, once it answers.

        Raises:
            CaptureError: there is no such run, or its page does not open.
        """
        run = self._folder.run(key)
        with self._lock:
            known = self._open.pop(run, None)
            while len(self._open) >= MOST_PAGES:
                _end(self._open.pop(next(iter(self._open)))[0])
            if known is None or known[0].poll() is not None:
                known = self._started(run)
            self._open[run] = known
            return known[1]

    def _started(self, run: Path) -> tuple[subprocess.Popen[bytes], str]:
        log = self._folder.kept / PAGE_LOG
        process, end = start_command([*COMMAND, "view", str(run), "--no-open"], log), time.monotonic() + PATIENCE_S
        while time.monotonic() < end and process.poll() is None:
            if said := ADDRESS.search(read_regular(log).decode(errors="replace")):
                return process, said.group(1)
            time.sleep(0.1)
        code = process.poll()
        _end(process)
        raise CaptureError(f"The 3D page did not open: {why_it_failed(code, log)}")

    def close(self) -> None:
        """End all pages."""
        for process, _ in self._open.values():
            _end(process)
        self._open.clear()


def _end(process: "subprocess.Popen[bytes]") -> None:
    process.terminate()
    process.wait()
