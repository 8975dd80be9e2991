"""The 3D pages of runs (`shadowgraph view`), each a process of its own that ends with the studio.

Growing: a picture of a run under way, made again as it goes on: its photos first, then the surface as it grows.
"""

import socket
import subprocess
import threading
import time
from concurrent.futures import Future
from hashlib import sha256
from pathlib import Path
from typing import Any

from capture.errors import CaptureError
from capture.files.regular import is_own_folder, is_regular
from reconstruct.run.batch import PROGRAM, start_command, why_it_failed
from reconstruct.stored_run.maps import THUMBS
from viewer.display.run_follower import PREVIEW
from viewer.studio.folder import StudioFolder
from viewer.studio.helper import Helper
from viewer.studio.sockets import free_socket

PAUSE_S = 4.0  # between two pictures of a run: each takes some tenths of a CPU second
HOST, FIRST_PORT = "127.0.0.1", 8080
MOST_PAGES = 3  # at a time: each takes some hundred megabytes
LOG = "view.txt"
PATIENCE_S = 60.0  # until a page answers


class Growing:
    """The newest picture of each run that somebody watches."""

    def __init__(self, folder: StudioFolder, helper: Helper):
        """Make nothing yet."""
        self._folder, self._helper = folder, helper
        self._made: dict[Path, tuple[str, float]] = {}  # by run: what the picture was made of, and when by our clock
        self._pending: dict[Path, tuple[Future[Any], str]] = {}

    def picture(self, key: str) -> Path | None:
        """Return the newest picture of a run, and ask for the next one; None where there is none yet.

        Raises:
            CaptureError: there is no such run.
        """
        run = self._folder.run(key)
        out = self._folder.kept / "pictures" / f"growing-{sha256(str(run).encode()).hexdigest()[:24]}.jpg"
        pending = self._pending.get(run)
        if pending is not None and pending[0].done():
            self._made[run] = (pending[1], time.monotonic())
            self._pending.pop(run, None)  # another request may have been here
            pending = None
        mark = mark_of(run)
        before, when = self._made.get(run, ("", 0.0))
        if mark and pending is None and mark != before and time.monotonic() - when > PAUSE_S:
            self._pending[run] = (self._helper.ask("growing", run=str(run), out=str(out)), mark)
        return out if run in self._made and is_regular(out) else None


def mark_of(run: Path) -> str:
    """Return a text that changes with what a picture of a run under way shows; "" where there is nothing to show."""
    try:
        if is_regular(run / PREVIEW):
            stat = (run / PREVIEW).stat()
            return f"surface {stat.st_mtime_ns} {stat.st_size}"
        if is_own_folder(run / THUMBS):
            return f"photos {(run / THUMBS).stat().st_mtime_ns}"
    except OSError:
        pass
    return ""


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
            if known is not None and known[0].poll() is None:
                self._open[run] = known
                return known[1]
            while len(self._open) >= MOST_PAGES:
                _end(self._open.pop(next(iter(self._open)))[0])
            with free_socket(HOST, FIRST_PORT) as taken:
                port = taken.getsockname()[1]
            words = [*PROGRAM, "view", str(run), "--port", str(port), "--no-open"]
            process = start_command(words, self._folder.kept / LOG)
            address = f"http://localhost:{port}"
            self._open[run] = process, address
        end = time.monotonic() + PATIENCE_S
        while time.monotonic() < end and process.poll() is None:
            if answers(port):
                return address
            time.sleep(0.1)
        raise CaptureError(f"The 3D page did not open: {why_it_failed(process.poll(), self._folder.kept / LOG)}")

    def close(self) -> None:
        """End all pages."""
        for process, _ in self._open.values():
            _end(process)
        self._open.clear()


def answers(port: int) -> bool:
    """Return whether something listens on a port of this machine."""
    with socket.socket() as probe:
        probe.settimeout(0.2)
        return probe.connect_ex((HOST, port)) == 0


def _end(process: "subprocess.Popen[bytes]") -> None:
    process.terminate()
    process.wait()
