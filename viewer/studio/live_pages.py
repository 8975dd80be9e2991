"""The 3D pages of runs (`shadowgraph view`), each a process of its own that ends with the studio."""

import socket
import subprocess
import threading
import time
from pathlib import Path

from capture.errors import CaptureError
from reconstruct.run.batch import PROGRAM, start_command, why_it_failed
from viewer.studio.folder import StudioFolder
from viewer.studio.sockets import free_socket

HOST, FIRST_PORT = "127.0.0.1", 8080
MOST_PAGES = 3  # at a time: each takes some hundred megabytes
LOG = "view.txt"
PATIENCE_S = 60.0  # until a page answers


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
