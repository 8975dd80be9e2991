"""A process beside the server for what is slow or touches strangers' pictures; both speak lines of JSON.

A task is a function of viewer/studio/tasks.py by its name. A helper that dies fails the task at hand and is started
again for the next one; one that waits for long is ended, which gives its memory back.
"""

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

PROGRAM = (sys.executable, "-m", "viewer.studio.tasks")
IDLE_S = 120.0  # after which a helper is ended
LONGEST_ANSWER = 8 << 20  # bytes
GONE = "the helper process ended before it had answered; often the system ends it, for want of memory. Try again."


class Helper:
    """One process and the tasks that wait for it, in order; the same task is done once at a time."""

    def __init__(self, log: Path, program: tuple[str, ...] = PROGRAM):
        """Start nothing yet; what the process says on stderr goes into `log`."""
        self._log, self._program = log, program
        self._waiting: OrderedDict[str, tuple[dict[str, Any], Future[Any]]] = OrderedDict()
        self._changed = threading.Condition()
        self._process: subprocess.Popen[bytes] | None = None
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
            try:
                answer = self._exchange(request)
            except (OSError, ValueError):
                self._end()
                answer = {"error": GONE}
            with self._changed:
                self._waiting.pop(name, None)
            if "error" in answer:
                future.set_exception(CaptureError(str(answer["error"])[:1000]))
            else:
                future.set_result(answer.get("answer"))

    def _exchange(self, request: dict[str, Any]) -> dict[str, Any]:
        if self._process is None or self._process.poll() is not None:
            self._process = start_command(self._program, self._log, speaks=True)
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps(request).encode() + b"\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline(LONGEST_ANSWER)
        answer = parse_json(line.decode()) if line.endswith(b"\n") else None
        if not isinstance(answer, dict):
            raise ValueError("no answer")
        return answer

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
    for line in sys.stdin:
        request = parse_json(line)
        started = time.monotonic()
        try:
            answer = {"answer": tasks[request["task"]](**request["arguments"])}
        except Exception as error:  # noqa: BLE001  a stranger's picture may end in anything
            answer = {"error": str(error) or type(error).__name__}
        sys.stderr.write(f"{request['task']} {time.monotonic() - started:.2f} s {answer.get('error', '')}\n")
        answers.write(json.dumps(answer, allow_nan=False) + "\n")
        answers.flush()
