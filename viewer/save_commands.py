"""The commands `export` and `relight`: what can be asked on the command line, and how it is done."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import FlagCreatePairsOff, Positional, arg

from capture.run_folder import Progress
from reconstruct.export import FORMATS, ExportOptions, Tell, export, format_for

RunFolder = Annotated[Positional[Path], arg(metavar="RUN")]
Flag = FlagCreatePairsOff[bool]
FORMAT_NAMES = ", ".join(FORMATS)


@dataclass(frozen=True)
class Export:
    """Save a finished run as something else: meshes, pictures, videos, a page to send to somebody."""

    run: RunFolder
    """The folder of a finished run."""
    file: Annotated[Positional[Path | None], arg(metavar="FILE")] = None
    """The file to write; RUN/exports/... unless given. Its ending chooses the format unless --format does."""
    format: Annotated[str | None, arg(metavar=f"{{{FORMAT_NAMES}}}")] = None
    """What to save."""
    faces: int | None = None
    """Triangles to reduce the mesh to; 30000 with pictures on it, all of them for printing and measuring."""
    texture: int = ExportOptions.texture
    """Size of the pictures on the mesh, px."""
    width: int | None = None
    """Width of pictures and videos, px."""
    frames: int = ExportOptions.frames
    """Pictures in a video of one turn; 30 are a second."""
    lamp_size: float | None = None
    """Radius of the lamp in pictures and videos, mm (or units of the scene): softer shadows."""
    debug: Flag = False
    """Show the traceback of an error."""


def do_export(command: Export, say: Callable[[str], object], show: Callable[[Progress], object]) -> None:
    """Write what was asked for and say what is in it."""
    options = ExportOptions(command.faces, command.texture, command.width, command.frames, command.lamp_size)
    name = format_for(command.file, command.format)
    say(export(command.run, name, command.file, options, progress(name, show)).sentence())


def progress(stage: str, show: Callable[[Progress], object]) -> Tell:
    """n of m and the time left, told as steps of a stage."""
    begin = time.monotonic()

    def tell(done: int, total: int, message: str) -> None:
        passed = time.monotonic() - begin
        eta = passed * (total - done) / done if done else None
        show(Progress(passed, time.process_time(), stage, done, total, eta, message))

    return tell
