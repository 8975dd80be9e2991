"""Requests of the page's visitors to a running run. Each is an empty file with a fixed name in the run folder.

The page makes and removes the files. The run looks for them and removes those that it has carried out. Neither waits
for the other. Names outside REQUESTS are ignored, and no file is ever opened, so nothing in them can be misread.
"""

import os
from pathlib import Path

from capture.files.regular import is_own_folder

REQUESTS_FOLDER = "wishes"  # in the run folder; a name that other programs know, see CONVENTIONS.md
PAUSE, NEXT_LEVEL, STOP = "pause", "next-level", "stop"
RESOLUTIONS = ("draft", "standard", "fine")  # for the rest of the run; presets by their names
REQUESTS = (PAUSE, NEXT_LEVEL, STOP, *RESOLUTIONS)
ON_REQUEST = "on request: "  # begins the log's message about a request that was carried out; report.json repeats it
PAUSED = "paused: "  # begins the message of a run that waits


def make_request(run_dir: Path, name: str) -> None:
    """Ask the run in this folder for something. A new resolution replaces an earlier one.

    Raises:
        ValueError: the name is not one of REQUESTS.
    """
    if name not in REQUESTS:
        raise ValueError(f"{name!r} is none of {', '.join(REQUESTS)}")
    if name in RESOLUTIONS:
        withdraw(run_dir, *RESOLUTIONS)
    if not is_own_folder(run_dir / REQUESTS_FOLDER):
        (run_dir / REQUESTS_FOLDER).mkdir()  # which fails where a link leads elsewhere
    (run_dir / REQUESTS_FOLDER / name).touch()


def withdraw(run_dir: Path, *names: str) -> None:
    """Remove those of the named requests that are open."""
    for name in set(names) & set(REQUESTS) if is_own_folder(run_dir / REQUESTS_FOLDER) else ():
        (run_dir / REQUESTS_FOLDER / name).unlink(missing_ok=True)


def open_requests(run_dir: Path) -> frozenset[str]:
    """Return the names of the open requests. This takes microseconds: a solver calls it after every iteration."""
    try:
        return frozenset(os.listdir(run_dir / REQUESTS_FOLDER)) & frozenset(REQUESTS)
    except (FileNotFoundError, NotADirectoryError):
        return frozenset()


def withdraw_all(run_dir: Path) -> frozenset[str]:
    """Remove all open requests and return their names, so that a run starts without those of an earlier one."""
    left = open_requests(run_dir)
    withdraw(run_dir, *left)
    folder = run_dir / REQUESTS_FOLDER
    if is_own_folder(folder) and not os.listdir(folder):
        folder.rmdir()
    return left
