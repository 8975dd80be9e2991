"""The commands `studio` and `watch`: captures and runs of a folder in the browser; photos of one as they arrive."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console
from tyro.conf import FlagCreatePairsOff, Positional, arg

HOME = "Shadowgraph"  # in the user's home, where no folder is named and the present one holds no captures


@dataclass(frozen=True)
class Studio:
    """Open the studio: photos in, models out, in the browser. `shadowgraph` alone does the same."""

    folder: Annotated[Positional[Path | None], arg(metavar="FOLDER")] = None
    """Holds captures/ and runs/. Unless given: the present folder if it holds captures or runs, else ~/Shadowgraph."""
    port: int = 8090
    """The next free one is taken where this one is busy."""
    no_open: FlagCreatePairsOff[bool] = False
    """Do not open the browser; print the address only."""
    debug: FlagCreatePairsOff[bool] = False
    """Show the traceback of an error."""


def do_studio(command: Studio, console: Console) -> None:
    """Serve the studio until Ctrl-C.

    Raises:
        UserError: the folder cannot be used, or no port is free.
    """
    import webbrowser

    from shadowgraph.terminal import print_lines
    from viewer.studio_server.serve import serve

    def say(line: str) -> None:
        print_lines(console, line)

    serve(command.folder or default_folder(), command.port, None if command.no_open else webbrowser.open, say)


def default_folder() -> Path:
    """Return the present folder if it holds captures or runs, else Shadowgraph in the user's home."""
    from viewer.studio.folder import KEPT, StudioFolder

    here = Path.cwd()
    if (here / KEPT).is_dir():
        return here
    found = StudioFolder.look_into(here)
    return here if found else Path.home() / HOME
