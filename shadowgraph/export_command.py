"""The commands `export` and `relight`: their options and the functions that do them."""

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console
from tyro.conf import Positional, arg

from capture.errors import CaptureError
from reconstruct.export.export import ExportOptions, OnProgress, format_for, save
from reconstruct.export.export import export as export_run
from reconstruct.run_folder.folder import Progress as Step
from reconstruct.stored_run.documents import refuse_no_run
from shadowgraph.options import Command, Given, ResultFolder
from shadowgraph.terminal import Display, print_lines
from viewer.stage.page import FORMATS

FORMAT_NAMES = ", ".join(FORMATS)


@dataclass(frozen=True)
class Export(Command):
    """Save a finished run as something else: meshes, pictures, videos, a page to send to somebody."""

    run: ResultFolder
    """The folder of a finished run."""
    file: Annotated[Positional[Path | None], arg(metavar="FILE", help_behavior_hint="")] = None
    """The file to write; RUN/exports/... unless given. Its ending chooses the format unless --format does."""
    format: Annotated[Given[str], arg(metavar=f"{{{FORMAT_NAMES}}}")] = None
    """What to save."""
    faces: Given[int] = None
    """Triangles to reduce the mesh to; 30000 with pictures on it, all of them for printing and measuring."""
    texture: Given[int] = ExportOptions.texture
    """Size of the pictures on the mesh, px; 1024 unless given, or as fine as the run's detail is, up to 4096."""
    width: Given[int] = None
    """Width of pictures and videos, px."""
    frames: int = ExportOptions.frames
    """Pictures in a video of one turn; 30 are a second."""
    lamp_size: Given[float] = None
    """Radius of the lamp in pictures and videos, mm (or units of the scene); a larger lamp casts softer shadows."""
    print_size: Given[float] = None
    """Longest side of what is printed (3mf, stl), mm; as large as the object unless given."""
    photos: Given[Path] = None
    """For shadowneus, rti, colmap and nerf: the capture's folder, to export its photos. Without it, computed
    pictures are exported. A FILE without an ending is a folder, else a .zip."""


@dataclass(frozen=True)
class Relight(Command):
    """Make a picture under a light that was not there, or a video of a light that goes around the object."""

    run: ResultFolder
    """The folder of a finished run."""
    light: Annotated[Given[str], arg(metavar="X,Y,Z")] = None
    """Place of a lamp in the world of the run, mm (or units of the scene), z up."""
    direction: Annotated[Given[str], arg(metavar="X,Y,Z")] = None
    """Towards a far lamp, in the same world."""
    env: Given[Path] = None
    """An environment map that lights it from all sides: .hdr or .exr."""
    orbit: Given[int] = None
    """Make a video with this many places of the lamp around the object."""
    out: Given[Path] = None
    """The file to write: .png or .exr (linear), .mp4, .webm or .gif; in RUN/exports unless given."""
    width: Given[int] = None
    """Width, px; that of the working picture unless given."""
    rotate: float = 0.0
    """Degrees by which the environment map is turned, from +x towards +y."""
    lamp_size: float = 0.0
    """Radius of the lamp, mm (or units of the scene); a larger lamp casts softer shadows."""
    brightness: float = 1.0
    """Factor on the capture's flashlight, or on the map, which is exposed for white paper on open ground."""


def relight(command: Relight, console: Console) -> None:
    """Make the picture or video that was asked for, and say what is in it."""
    from reconstruct.export.relit import NewLight, relit_file, write_relit

    refuse_no_run(command.run)
    new = NewLight(
        _three(command.light, "--light"),
        _three(command.direction, "--direction"),
        command.env,
        command.orbit,
        math.radians(command.rotate),
        command.lamp_size,
        command.brightness,
    )
    file = relit_file(command.run, new, command.out)
    with _shown("relight", console) as on_progress:
        write = lambda run, draft: write_relit(run, draft, new, command.width, on_progress)  # noqa: E731
        print_lines(console, save(command.run, file, write).sentence())


def export(command: Export, console: Console) -> None:
    """Write the file or folder that was asked for, and say what is in it."""
    refuse_no_run(command.run)
    sizes = (command.faces, command.texture, command.width, command.frames, command.lamp_size)
    options = ExportOptions(*sizes, command.photos, command.print_size)
    name = format_for(command.file, command.format)
    with _shown(name, console) as on_progress:
        print_lines(console, export_run(command.run, name, command.file, options, on_progress).sentence())


@contextmanager
def _shown(stage: str, console: Console) -> Iterator[OnProgress]:
    """Yield a callback whose steps the terminal shows as those of a stage, with the time left."""
    display, begin = Display(console), time.monotonic()

    def on_progress(done: int, total: int, message: str) -> None:
        passed = time.monotonic() - begin
        eta = passed * (total - done) / done if done else None
        display(Step(passed, time.process_time(), stage, done, total, eta, message))

    with display.progress:
        yield on_progress


def _three(text: str | None, option: str) -> tuple[float, float, float] | None:
    """Read the numbers of "x,y,z"."""
    if text is None:
        return None
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError as error:
        raise CaptureError(f"{option} {text}: three numbers were needed, as in {option} 100,-50,400.") from error
    return x, y, z
