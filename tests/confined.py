"""Readers under watch: what they open, run and connect to, how much memory and time they take."""

import os
import resource
import signal
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

ROOM = 2 << 30  # bytes that a reader may take
LONGEST_S = 10
FORBIDDEN = {"subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "socket.connect", "pickle.find_class"}
CHANGES = {"os.remove", "os.rename", "os.rmdir", "os.mkdir", "os.symlink", "os.link", "os.truncate", "shutil.rmtree"}
DECODER = "capture.decode.sandbox_process"
_watches: list["Watch"] = []


@dataclass
class Watch:
    """What happened while it was on."""

    folder: Path  # the only place that may be read, besides Python's own, and written to
    ran: list[str] = field(default_factory=list)
    read: list[str] = field(default_factory=list)
    written: list[str] = field(default_factory=list)

    def note(self, event: str, arguments: tuple) -> None:
        """Called by the interpreter itself."""
        if event == "subprocess.Popen" and DECODER in list(arguments[1]):
            return  # limited by the system: tests/test_confined.py
        if event in FORBIDDEN:
            self.ran.append(f"{event} {arguments!r:.100}")
        elif event == "open" and isinstance(arguments[0], str | bytes):
            self._note_open(os.fsdecode(arguments[0]), arguments[1], arguments[2] or 0)
        elif event == "os.truncate" and isinstance(arguments[0], int):
            return  # a file that was opened before it
        elif event in CHANGES and not self._is_inside(_whole(event, arguments)):
            self.written.append(_whole(event, arguments))

    def _note_open(self, path: str, mode: str | None, flags: int) -> None:
        if self._is_inside(path):
            return
        writes = bool(set(mode or "") & set("wax+")) or bool(flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))
        if path == os.devnull:
            return
        if writes:
            self.written.append(path)
        elif not path.startswith((sys.prefix, sys.base_prefix, "/proc/", "/sys/", "/etc/mime")) and "py" not in path:
            self.read.append(path)

    def _is_inside(self, path: str) -> bool:
        real = Path(os.path.realpath(path))
        is_pythons = "__pycache__" in real.parts or real.parent == Path(tempfile.gettempdir())
        return is_pythons or real.is_relative_to(self.folder.resolve())


def _whole(event: str, arguments: tuple) -> str:
    """The path that is changed; shutil.rmtree names files by an open folder."""
    path = os.fsdecode(arguments[0])
    folder = arguments[1] if event in ("os.remove", "os.rmdir") else -1
    return path if folder == -1 else os.path.join(os.readlink(f"/proc/self/fd/{folder}"), path)


def _audit(event: str, arguments: tuple) -> None:
    for watch in _watches:
        watch.note(event, arguments)


sys.addaudithook(_audit)


@contextmanager
def limited(folder: Path, room: int = ROOM, seconds: int = LONGEST_S) -> Iterator[Watch]:
    """Watch a block that may use files in one folder only, so much more memory, and so many seconds (0: any)."""
    watch = Watch(folder)
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()

    def late(*_: object) -> None:
        raise TimeoutError(f"longer than {seconds} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(seconds)
    resource.setrlimit(resource.RLIMIT_AS, (now + room, hard))
    _watches.append(watch)
    try:
        yield watch
    finally:
        _watches.remove(watch)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
