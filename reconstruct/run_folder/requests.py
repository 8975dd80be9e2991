"""What visitors of the page ask of a run that goes on: empty files with fixed names in its folder.

A page makes and removes them, the run looks for them and removes those it has followed. Neither waits for the other,
and a name outside WISHES is never looked at, so there is nothing in them to be misread.
"""

import os
from pathlib import Path

FOLDER = "wishes"
PAUSE, NEXT_LEVEL, STOP = "pause", "next-level", "stop"
RESOLUTIONS = ("draft", "standard", "fine")  # for the rest of the run; presets by their names
WISHES = (PAUSE, NEXT_LEVEL, STOP, *RESOLUTIONS)
ON_REQUEST = "on request: "  # begins the log's message on a wish that was followed, which report.json repeats
PAUSED = "paused: "  # begins the message of a run that waits


def wish(run_dir: Path, name: str) -> None:
    """Ask the run in this folder for something; of several resolutions the last one counts.

    Raises:
        ValueError: not one of WISHES.
    """
    if name not in WISHES:
        raise ValueError(f"{name!r} is none of {', '.join(WISHES)}")
    if name in RESOLUTIONS:
        withdraw(run_dir, *RESOLUTIONS)
    (run_dir / FOLDER).mkdir(exist_ok=True)
    (run_dir / FOLDER / name).touch()


def withdraw(run_dir: Path, *names: str) -> None:
    """Take back those of these wishes that are there."""
    for name in set(names) & set(WISHES):
        (run_dir / FOLDER / name).unlink(missing_ok=True)


def wishes(run_dir: Path) -> frozenset[str]:
    """What is asked for at the moment; a few microseconds, for a solver asks after every iteration."""
    try:
        return frozenset(os.listdir(run_dir / FOLDER)) & frozenset(WISHES)
    except FileNotFoundError:
        return frozenset()


def withdraw_all(run_dir: Path) -> frozenset[str]:
    """Take back every wish, and say which there were: a run begins without those of an earlier one."""
    left = wishes(run_dir)
    withdraw(run_dir, *left)
    folder = run_dir / FOLDER
    if folder.is_dir() and not os.listdir(folder):
        folder.rmdir()
    return left
