"""The lock of a run folder: a file with the id of the process that holds it."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil

from capture.errors import Remedy, UserError
from capture.files.atomic import read_json, write_json

try:
    import fcntl
except ImportError:  # Windows has no such locks
    fcntl = None

LOCK = "lock"
SAME_START_S = 1.0  # files hold rounded times


def take_lock(folder: Path) -> None:
    """Write our process id into the folder's lock; take over a lock whose process is gone.

    Checking and replacing a lock are two steps. Processes of one machine do them one after another, under the system's
    own lock of the folder, which never remains after a kill.

    Raises:
        UserError: another running process has the folder.
    """
    me, path = psutil.Process(), folder / LOCK
    with _one_at_a_time(folder):
        if lock_holder(path) is None:
            write_json(path, {"pid": me.pid, "started": me.create_time()})  # whole: nobody sees an empty one
            return
    raise UserError(
        f"{folder} is in use by another shadowgraph (process {lock_holder(path)}).",
        "wait until it has finished",
        "end it",
        Remedy.OTHER_FOLDER,
    )


def release_lock(folder: Path) -> None:
    """Release the folder."""
    (folder / LOCK).unlink(missing_ok=True)


def lock_holder(path: Path) -> int | None:
    """Return the id of the running process that holds this lock; None if it is gone or the file has no id."""
    try:
        held = read_json(path)
        process = running(int(held["pid"]), float(held["started"]))
    except (OSError, ValueError, KeyError, TypeError, OverflowError):
        return None
    return None if process is None else process.pid


def running(pid: int, started: float) -> psutil.Process | None:
    """Return the process of this id that started then (s since 1970); None if it has ended.

    Ids are reused: the same id with another start time is another process.

    Raises:
        ValueError, OverflowError: there can be none of this id.
    """
    try:
        process = psutil.Process(pid)
        is_it = abs(process.create_time() - started) < SAME_START_S and process.status() != psutil.STATUS_ZOMBIE
    except psutil.Error:
        return None
    return process if is_it else None


@contextmanager
def _one_at_a_time(folder: Path) -> Iterator[None]:
    """Wait until no other process of this machine is in this block with the same folder."""
    if fcntl is None:
        yield
        return
    own = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):  # some network file systems have none
            fcntl.flock(own, fcntl.LOCK_EX)
        yield
    finally:
        os.close(own)  # which also releases it
