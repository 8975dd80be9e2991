"""The commands `studio` and `watch`: captures and runs of a folder in the browser; photos of one as they arrive."""

import time
import webbrowser
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

from rich.console import Console
from tyro.conf import Positional, arg

from capture.files.names import refuse_no_folder
from shadowgraph.options import Command, Flag
from shadowgraph.terminal import print_lines

WATCH_S = 0.5  # between two looks at a folder; nothing is read that has not changed
HOME = "Shadowgraph"  # in the user's home, where no folder is named and the present one holds no captures


@dataclass(frozen=True)
class Studio(Command):
    """Open the studio: photos in, models out, in the browser. `shadowgraph` alone does the same."""

    folder: Annotated[Positional[Path | None], arg(metavar="FOLDER", help_behavior_hint="")] = None
    """Holds captures/ and runs/. Unless given: the present folder if it holds captures or runs, else ~/Shadowgraph."""
    port: int = 8090
    """The next free one is taken where this one is busy."""
    no_open: Flag = False
    """Do not open the browser; print the address only."""


@dataclass(frozen=True)
class Watch(Command):
    """Say of each photo that arrives in a folder whether it is good, where its light stands, and what to shoot next."""

    folder: Annotated[Positional[Path], arg(metavar="FOLDER")]
    """Where a tethered camera or a synced phone puts its photos."""
    once: Flag = False
    """Say it of what is there, and end."""


def watch(command: Watch, console: Console) -> None:
    """Look at a folder until Ctrl-C, and print a line for each photo that is new, and what to do next.

    Raises:
        UserError: there is no such folder.
    """
    refuse_no_folder(command.folder, "the folder in which photos arrive")
    print_lines(console, f"Watching {command.folder}; Ctrl-C ends it.")
    from reconstruct.check.coach import Coach, seen_lines

    coach, told, before = Coach(command.folder), set[str](), ""
    while True:
        seen = coach.look()
        lines = [line for line in seen_lines(seen) if line not in told]
        told |= set(lines)
        print_lines(console, *lines, *([seen.advice] if seen.advice != before else []))
        before = seen.advice
        if command.once:
            return
        time.sleep(WATCH_S)


def studio(command: Studio, console: Console) -> None:
    """Serve the studio until Ctrl-C.

    Raises:
        UserError: the folder cannot be used, or no port is free.
    """
    from viewer.studio_server.serve import serve

    opens = None if command.no_open else webbrowser.open
    serve(command.folder or default_folder(), command.port, opens, partial(print_lines, console))


def default_folder() -> Path:
    """Return the present folder if it holds captures or runs, else Shadowgraph in the user's home."""
    from viewer.studio.folder import KEPT, StudioFolder

    here = Path.cwd()
    if (here / KEPT).is_dir():
        return here
    found = StudioFolder.look_into(here)
    return here if found else Path.home() / HOME
