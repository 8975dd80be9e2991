"""A process beside the server for what is slow or touches strangers' pictures; both speak lines of JSON.

A task is a function of viewer/studio/tasks.py by its name; one with an argument `on_progress` says in lines how far it
is before it answers. A helper that dies fails the task at hand and is started again for the next one; one that waits
for long is ended, which gives its memory back.
"""

import inspect
import json
import subprocess
import sys
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from capture.errors import CaptureError
from capture.files.atomic import parse_json
from reconstruct.run.batch import start_command
from viewer.studio.words import in_page_words

PROGRAM = (sys.executable, "-m", "viewer.studio.tasks")
IDLE_S = 120.0  # after which a helper is ended
LONGEST_ANSWER = 8 << 20  # bytes
GONE = "the helper process ended before it had answered; often the system ends it, for want of memory. Try again."
CANCELLED = "Cancelled."


class Helper:
    """One process and the tasks that wait for it, in order; the same task is done once at a time."""

    def __init__(self, log: Path, program: tuple[str, ...] = PROGRAM):
        """Start nothing yet; what the process says on stderr goes into `log`."""
        self._log, self._program = log, program
        self._waiting: OrderedDict[str, tuple[dict[str, Any], Future[Any]]] = OrderedDict()
        self._changed = threading.Condition()
        self._process: subprocess.Popen[bytes] | None = None
        self._at_hand: Future[Any] | None = None
        self._shares: dict[Future[Any], float] = {}  # of tasks that have said how far they are
        self._is_closed = False
        self._thread = threading.Thread(target=self._work, name="helper", daemon=True)
        self._thread.start()

    def ask(self, task: str, is_urgent: bool = False, **arguments: Any) -> "Future[Any]":
        """Return the future answer of a task: a JSON value, or a CaptureError.

        Args:
            is_urgent: before all others that wait.
        """
        request = {"task": task, "arguments": arguments}
        name = json.dumps(request, sort_keys=True)
        with self._changed:
            if name in self._waiting:
                return self._waiting[name][1]
            future: Future[Any] = Future()
            self._waiting[name] = (request, future)
            if is_urgent:
                self._waiting.move_to_end(name, last=False)
            self._changed.notify()
        return future

    def share(self, future: "Future[Any]") -> float | None:
        """Return which share of a task is done; None while it waits, or where it does not say."""
        return self._shares.get(future)

    def cancel(self, future: "Future[Any]") -> None:
        """Let a task fail with CANCELLED, and end the process if it is at it; nothing where the task is done."""
        with self._changed:
            names = [name for name, (_, waiting) in self._waiting.items() if waiting is future]
            for name in names:
                self._waiting.pop(name)
            is_at_hand = future is self._at_hand
            if is_at_hand and self._process is not None:
                self._process.kill()  # the thread that waits for its answer does the rest
        if names and not is_at_hand:
            future.set_exception(CaptureError(CANCELLED))

    def close(self) -> None:
        """End the process; tasks that wait fail."""
        with self._changed:
            self._is_closed = True
            self._changed.notify()
        self._end()

    def _work(self) -> None:
        while not self._is_closed:
            with self._changed:
                if not self._waiting and not self._changed.wait(IDLE_S):
                    self._end()
                if not self._waiting:
                    continue
                name, (request, future) = next(iter(self._waiting.items()))
                self._at_hand = future
            try:
                answer = self._exchange(request, future)
            except (OSError, ValueError):
                answer = {"error": GONE}
            with self._changed:
                self._at_hand = None
                is_wanted = self._waiting.get(name, (request, None))[1] is future
                if is_wanted:
                    self._waiting.pop(name)
                self._shares.pop(future, None)
            if answer.get("error") == GONE or not is_wanted:  # it may have been killed just after its answer
                self._end()
            if not is_wanted:
                answer = {"error": CANCELLED}
            if "error" in answer:
                future.set_exception(CaptureError(str(answer["error"])[:1000]))
            else:
                future.set_result(answer.get("answer"))

    def _exchange(self, request: dict[str, Any], future: "Future[Any]") -> dict[str, Any]:
        with self._changed:
            if all(waiting is not future for _, waiting in self._waiting.values()):
                raise ValueError(CANCELLED)
            if self._process is None or self._process.poll() is not None:
                self._process = start_command(self._program, self._log, speaks=True)
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps(request).encode() + b"\n")
        self._process.stdin.flush()
        while True:
            line = self._process.stdout.readline(LONGEST_ANSWER)
            answer = parse_json(line.decode()) if line.endswith(b"\n") else None
            if not isinstance(answer, dict):
                raise ValueError("no answer")
            if "share" not in answer:
                return answer
            self._shares[future] = float(answer["share"])

    def _end(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    pipe.close()


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
