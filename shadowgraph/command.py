"""The command `shadowgraph`: each subcommand calls one function, prints and saves.

Exit codes: 0 done, 1 a fault of the program (of `batch`: a capture failed), 2 the input or a setting cannot be used, or
the machine has no room for it (one sentence says why), 130 stopped with Ctrl-C, 143 ended by SIGTERM.
docs/reliability.md says what holds after each.
"""

import json
import os
import sys
from contextlib import ExitStack
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console

from capture.errors import UserError
from reconstruct.run_folder.folder import RunFolder
from shadowgraph.batch_command import Batch, do_batch
from shadowgraph.export_command import Export, Relight, do_export, do_relight
from shadowgraph.faults import Terminated, say_fault, sentence_for, sigterm_as_ctrl_c
from shadowgraph.options import Calibrate, Check, Command, Evaluate, Import, PrintBoard, Report, Run, View
from shadowgraph.terminal import Display, page

SOME_FAILED = 1  # exit code of a batch that ended with failed captures


def _name(folder: Path) -> str:
    """A folder's name as it was given: a link's own, not that of where it leads."""
    return Path(os.path.abspath(folder)).name


def results_folder(command: Calibrate | Check) -> Path:
    """Where the results go."""
    return command.out or Path("runs") / _name(command.capture)


def run_stages(command: Calibrate, console: Console) -> None:
    """`run`, `calibrate` and `reconstruct`: the stages asked for, in a run folder."""
    from reconstruct.run.options import RunOptions
    from reconstruct.run.source import open_source

    known = {f.name for f in fields(RunOptions)}
    options = RunOptions(**{k: v for k, v in vars(command).items() if k in known})
    stages = type(command).__name__.lower()
    source = open_source(command.capture, options)
    from reconstruct.run import pipeline  # after the refusals, which need none of what it imports

    pipeline.refuse_device(options)

    out = results_folder(command)
    mode = command.viewer or ("keep" if console.is_terminal else "on") if isinstance(command, Run) else "off"
    display = Display(console)
    with ExitStack() as until_closed:
        with RunFolder(out, display) as run:
            pipeline.claim(source, options, run, stages, command.force)
            until_closed.enter_context(page(out, mode, console))
            with display.progress:
                pipeline.run_stages(source, options, run, stages)
                if stages != "calibrate":
                    _write_report(run)
        _say_what_was_found(out, console)
        if mode != "keep":
            console.print(f"Look at them: shadowgraph view {out}", markup=False)


def check(command: Check, console: Console) -> None:
    """`check`: the verdict in the terminal, as a page and as JSON; a hopeless capture is refused after that."""
    from capture.files.atomic import write_json
    from reconstruct.run.options import RunOptions
    from reconstruct.run.source import open_source

    source = open_source(command.capture, RunOptions(board=command.board, lights=command.lights))
    console.print(f"reading and calibrating {len(source.photos())} photos", markup=False, highlight=False)
    from reconstruct.run.check import check_capture, refuse_hopeless  # after the refusals, which need no torch
    from viewer.report.check_page import check_lines, write_check

    checked = check_capture(source, RunOptions(board=command.board, lights=command.lights))
    out = results_folder(command)
    page = write_check(checked, out)
    write_json(out / "check.json", checked.readiness.document())
    for line in [*check_lines(checked), f"Details in {page}"]:
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    refuse_hopeless(checked.readiness)


def _say_what_was_found(out: Path, console: Console) -> None:
    """Photos used, what was assumed, where the results are."""
    from calibration.calibration import load_calibration

    calibration = load_calibration(out / "calibration.json")
    unused = [f"{light.photo} ({light.reason})" for light in calibration.lights if not light.used]
    used = {light.photo for light in calibration.lights if light.used}  # one photo may show several lights
    photos = {light.photo for light in calibration.lights}
    lines = [f"{len(used)} of {len(photos)} photos used", *(f"left out: {text}" for text in unused)]
    lines += [str(note) for note in calibration.residuals.get("notes", [])]
    for line in [*lines, f"Results in {out}"]:
        console.print(line, markup=False, highlight=False, soft_wrap=True)


def _write_report(run: RunFolder) -> None:
    from viewer.report.report import write_report

    with run.stage("report", "writing report.html"):
        write_report(run.path)
    run.progress("done", done=1, total=1, message=f"{run.file('mesh.ply')} written")


def _report(command: Report, console: Console) -> None:
    """`report`: the page again, or a bundle."""
    from reconstruct.run.bundle import write_bundle

    if command.bundle is not None:
        names = write_bundle(command.run, command.bundle, command.with_pictures)
        line = f"{command.bundle} written: {', '.join(names)}. Look into it before you send it."
    else:
        from viewer.report.report import write_report

        line = f"{write_report(command.run)} written"
    console.print(line, markup=False, highlight=False, soft_wrap=True)


def _import(command: Import, console: Console) -> None:
    from calibration.scenes.importers import import_folder

    out = command.out or Path("imported") / _name(command.folder)
    importer, scene = import_folder(command.folder, command.split, out)
    kinds = [f"{len(scene.rgb_paths)} photos"] if scene.rgb_paths else []
    kinds += [f"{len(scene.shadow_paths)} shadow pictures"] if scene.shadow_paths else []
    ground = "ground known" if scene.ground_known else "ground unknown"
    found = [f"{' and '.join(kinds)} with camera and lights", "a mask" if scene.mask_path else "no mask", ground]
    unused = [f"left out: {light.photo} ({light.reason})" for light in scene.calibration.lights if not light.used]
    warnings = [f"warning: {text}" for text in scene.calibration.residuals.get("warnings", [])]
    for line in [f"{importer.layout}: {', '.join(found)}", *scene.notes, *warnings, *unused, f"Written to {out}"]:
        console.print(line, markup=False, highlight=False, soft_wrap=True)


def _print_board(command: PrintBoard, console: Console) -> None:
    from calibration.board.board import parse_board
    from calibration.board.printing import DEFAULT_BOARDS, lay_out, save_board

    board = parse_board(command.board or DEFAULT_BOARDS[command.kind])
    pdf, png = command.out.with_suffix(".pdf"), command.out.with_suffix(".png")
    save_board(lay_out(board, command.paper), pdf, png)
    lines = (
        f"{pdf} and {png} written. Print at 100 %, not fitted to the page, and measure the ruler.",
        "Glue the print to something flat. Then write into session.toml:",
        f'board = "{board.spec()}"',
    )
    for line in lines:
        console.print(line, markup=False, highlight=False, soft_wrap=True)


def _describe_machine(console: Console) -> None:
    from reconstruct.run.machine import describe_machine

    for line in describe_machine():
        console.print(line, markup=False, highlight=False, soft_wrap=True)


def execute(command: Any, console: Console) -> None:
    """Do what was asked."""
    if isinstance(command, Calibrate):
        run_stages(command, console)
    elif isinstance(command, Check):
        check(command, console)
    elif isinstance(command, Batch):
        if not do_batch(command, partial(console.print, markup=False, highlight=False, soft_wrap=True)):
            raise SystemExit(SOME_FAILED)
    elif isinstance(command, View):
        from viewer.page.serve import view

        view(command.run, command.host, command.port, reference=command.reference)
    elif isinstance(command, Export):
        display = Display(console)
        with display.progress:
            do_export(command, partial(console.print, markup=False, highlight=False, soft_wrap=True), display)
    elif isinstance(command, Relight):
        display = Display(console)
        with display.progress:
            do_relight(command, partial(console.print, markup=False, highlight=False, soft_wrap=True), display)
    elif isinstance(command, Import):
        _import(command, console)
    elif isinstance(command, Evaluate):
        from reconstruct.evaluate.metrics import evaluate

        print(json.dumps(evaluate(command.run, command.reference), indent=1))
    elif isinstance(command, Report):
        _report(command, console)
    elif isinstance(command, PrintBoard):
        _print_board(command, console)
    else:
        _describe_machine(console)


def main(arguments: list[str] | None = None) -> int:
    """The command; returns its exit code."""
    command = tyro.cli(
        Command,
        prog="shadowgraph",
        description="3D from shadows: photos under a moving flashlight become a mesh that can be relit.",
        args=arguments,
    )
    if not command.debug:
        sys.excepthook = say_fault
    try:
        with sigterm_as_ctrl_c():
            execute(command, Console())
    except KeyboardInterrupt as stop:
        print("Stopped. The same command continues from here.", file=sys.stderr)
        return 143 if isinstance(stop, Terminated) else 130
    except (UserError, OSError, MemoryError, RuntimeError) as error:
        sentence = None if command.debug else sentence_for(error)
        if sentence is None:
            raise
        print(f"shadowgraph: {sentence}", file=sys.stderr)
        return 2
    return 0
