"""The 3D pages of runs (`shadowgraph view`), each a process of its own that ends with the studio."""

import re
import subprocess
import threading
import time
from pathlib import Path

from capture.errors import CaptureError
from capture.files.regular import read_regular
from reconstruct.run.batch import PROGRAM, start_command, why_it_failed
from viewer.studio.folder import StudioFolder

MOST_PAGES = 3  # at a time: each takes some hundred megabytes
LOG = "view.txt"
PATIENCE_S = 60.0  # until a page answers
ADDRESS = re.compile(r"Open (http://localhost:\d+\S*)")  # as `view` prints it


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
        log = self._folder.kept / LOG
        process, end = start_command([*PROGRAM, "view", str(run), "--no-open"], log), time.monotonic() + PATIENCE_S
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
