"""The commands `run`, `calibrate`, `reconstruct` and `check`: stages of a run, in the terminal.

The command `batch`: many captures, one page of results.
"""

import gc
import os
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.console import Console
from rich.text import Text
from tyro.conf import Positional, arg

from capture.errors import CaptureError
from capture.files.names import in_one_line
from reconstruct.run_folder.folder import RunFolder
from shadowgraph.options import Calibrate, Check, Command, Given, OfCapture, Preset, Run, settings_of
from shadowgraph.terminal import Display, page, print_lines

if TYPE_CHECKING:
    from reconstruct.run.batch import Outcome


SOME_FAILED = 1  # exit code of a batch that ended with failed captures


@dataclass(frozen=True)
class Batch(Command):
    """Run many captures, each on its own, and write one page of results. The same command again continues it."""

    folders: Annotated[Positional[tuple[Path, ...]], arg(metavar="FOLDER")]
    """Captures, or folders whose sub-folders are captures."""
    out: Path
    """Folder for the results: a run for each capture, index.html, batch.json."""
    jobs: int = 1
    """Captures at a time on this machine; each takes its share of the cores, and memory as `doctor` says."""
    ray: Given[str] = None
    """Run on a Ray cluster instead, whose machines see the same folders: auto, HOST:PORT, ray://HOST:PORT, or local."""
    threads: Given[int] = None
    """Cores for each capture; all of this machine over --jobs unless given."""
    preset: Preset = "standard"
    """As for `run`."""
    board: Given[str] = None
    """The printed board of all captures, as for `run`, where they do not say it themselves."""
    seed: int = 0
    """As for `run`."""


def batch(command: Batch, console: Console) -> None:
    """Run every capture that is not done yet.

    Raises:
        CaptureError: no capture, one given twice, or settings that make no sense.
        SystemExit: a capture failed.
    """
    from reconstruct.run.batch import find_captures, locally, make_tasks, on_ray, run_batch
    from viewer.report.batch_page import write_batch_page, write_thumbnail

    if command.jobs < 1 or (command.threads or 1) < 1:
        raise CaptureError(f"--jobs {command.jobs}, --threads {command.threads}: at least 1 was needed.")
    board = ("--board", command.board) if command.board else ()
    options = ("--preset", command.preset, "--seed", str(command.seed), *board)
    tasks = make_tasks(find_captures(command.folders, command.out), command.out, options, command.jobs, command.threads)
    said: set[str] = set()

    def show_outcomes(outcomes: Mapping[str, "Outcome"]) -> None:
        for name in [name for name in outcomes if name not in said]:
            one = outcomes[name]
            if one.exit_code == 0:
                write_thumbnail(command.out / name)
            words = f"failed: {one.sentence}" if one.exit_code else f"done in {one.seconds:.0f} s"
            said.add(name)
            print_lines(console, f"{len(said)} of {len(tasks)}, {name}: {words}")
        write_batch_page(command.out, tasks, outcomes)

    engine = partial(on_ray, address=command.ray) if command.ray else partial(locally, jobs=command.jobs)
    outcomes = run_batch(tasks, engine, show_outcomes)
    print_lines(console, f"Results in {command.out / 'index.html'}")
    if any(one.exit_code for one in outcomes.values()):
        raise SystemExit(SOME_FAILED)


@contextmanager
def _loading() -> Iterator[None]:
    """Import what a command needs in this block; the garbage collector never looks at what is there at its first end.

    torch and the packages that come with it make a million objects, and the collector would go through them again and
    again, half a CPU second until they are loaded, and at every later collection.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if not gc.get_freeze_count():  # what a program that calls commands has made since may be garbage
            gc.freeze()
        if was_on:
            gc.enable()


def folder_name(folder: Path) -> str:
    """Return a folder's name as it was given: of a link its own, not that of its target."""
    return Path(os.path.abspath(folder)).name


def results_folder(command: OfCapture) -> Path:
    """Return the folder for the results."""
    return command.out or Path("runs") / folder_name(command.capture)


def run_stages(command: Calibrate, console: Console) -> None:
    """Do the stages that `run`, `calibrate` or `reconstruct` asks for, in a run folder.

    Raises:
        UserError: the input, a setting or the machine cannot be used.
    """
    with _loading():
        from reconstruct.source.source import RunOptions, open_source

    known = {f.name for f in fields(RunOptions)}
    options = RunOptions(**{k: v for k, v in settings_of(command).items() if k in known})
    stages = type(command).__name__.lower()
    out = results_folder(command)
    mode = command.viewer or ("keep" if console.is_terminal else "on") if isinstance(command, Run) else "off"
    display = Display(console)
    with ExitStack() as until_closed:
        with display.beating(opening := f"opening {command.capture}"):
            with console.status(Text(in_one_line(opening))):
                source = open_source(command.capture, options)
                with _loading():
                    from reconstruct.run import pipeline  # after the refusals, which need none of what it imports
                    from reconstruct.solve.backend import solver_device
                solver_device(options.device)  # refuses one that is not there before anything is read or written
            with RunFolder(out, display, display.activity) as run:
                pipeline.claim(source, options, run, stages, command.force)
                until_closed.enter_context(page(out, mode, console))
                with display.progress:
                    pipeline.run_stages(source, options, run, stages)
                    if stages != "calibrate":
                        _write_report(run)
        _print_result(out, console)
        if mode != "keep":
            print_lines(console, f"Look at them: shadowgraph view {out}")


def check(command: Check, console: Console) -> None:
    """Print the verdict on a capture, and write it as a page and as JSON.

    Raises:
        UserError: the capture cannot be read, or, after the verdict is written, it is hopeless.
    """
    from capture.files.atomic import write_json
    from reconstruct.source.source import RunOptions, open_source

    options, display = RunOptions(board=command.board, lights=command.lights), Display(console)
    with display.beating(f"opening {command.capture}"):
        source = open_source(command.capture, options)
        display.activity(reading := f"reading and calibrating {len(source.photos())} photos")
        console.print(reading, markup=False, highlight=False)
        from reconstruct.check.readiness import refuse_hopeless  # after the refusals, which need no torch
        from reconstruct.check.verdict import read_and_check
        from reconstruct.run_folder.progress import log_to
        from viewer.report.check_page import check_lines, write_check

        with log_to(display.activity, lambda text: print_lines(console, f"warning: {text}")):
            checked = read_and_check(source, options)
    out = results_folder(command)
    written = write_check(checked, out)
    write_json(out / "check.json", checked.document())
    print_lines(console, *check_lines(checked), f"Details in {written}")
    refuse_hopeless(checked.readiness)


def _print_result(out: Path, console: Console) -> None:
    """Print how many photos were used, what was assumed, what to doubt and where the results are."""
    from calibration.board.board_scale import scale_sentence
    from calibration.calibrated_views import load_views
    from capture.files.atomic import read_json
    from reconstruct.stored_run.documents import lit_photos

    path = out / "report.json"
    report = read_json(path) if path.is_file() else {}
    views = load_views(out / "calibration.json").every()
    photos = lit_photos(report, views)
    unused = [f"{name} ({row['reason']})" for name, row in photos.items() if not row["used"]]
    used = sum(bool(row["used"]) for row in photos.values())
    lines = [f"{used} of {len(photos)} photos used", *(f"left out: {text}" for text in unused)]
    lines += dict.fromkeys(filter(None, (scale_sentence(view.calibration.residuals) for view in views)))
    lines += dict.fromkeys(str(note) for view in views for note in view.calibration.residuals.get("notes", []))
    of_lights = [text for view in views for text in view.calibration.residuals.get("warnings", [])]
    warnings = report.get("warnings", list(dict.fromkeys(map(str, of_lights))))  # a calibration alone leaves no report
    print_lines(console, *lines, *(f"warning: {text}" for text in warnings), f"Results in {out}")


def _write_report(run: RunFolder) -> None:
    from viewer.report.report import write_report
    from viewer.stage.page import write_stage

    with run.stage("report", "writing report.html and the page's picture"):
        write_report(run.path)
        write_stage(run.path)
    run.progress("done", done=1, total=1, message=f"{run.file('mesh.ply')} written")
