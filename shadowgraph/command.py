"""The command `shadowgraph`: SUBCOMMANDS, each with its options and the function that does it.

Exit codes: 0 done, 1 a fault of the program (of `batch`: a capture failed), 2 the input or a setting cannot be used, or
the machine has no room for it (one sentence says why), 130 stopped with Ctrl-C, 143 ended by SIGTERM.
docs/reliability.md says what holds after each. The ways in which a command can fail have a sentence each here.
"""

import difflib
import json
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, NamedTuple

import tyro
from rich.console import Console

from capture.errors import FOR_STUDIO, Remedy, UserError
from capture.files.names import in_one_line, refuse_no_folder
from shadowgraph.export_command import Export, Relight, export, relight
from shadowgraph.options import Calibrate, Check, Doctor, Evaluate, Import, PrintBoard, Reconstruct, Report, Run, View
from shadowgraph.run_command import Batch, batch, check, folder_name, run_stages
from shadowgraph.studio_command import Studio, Watch, studio, watch
from shadowgraph.terminal import on_signal, print_lines

OPTIONS = {
    Remedy.NAME_BOARD: "--board",
    Remedy.BOARD_PHOTO: 'or session.toml: roles = { board = ["NAME.jpg"] }',
    Remedy.LIGHTS_FILE: "--lights FILE.lp",
    Remedy.GROUND: "--ground HEIGHT",
    Remedy.COARSER: "--preset draft",
    Remedy.OTHER_SEED: "--seed 1",
    Remedy.START_AGAIN: "--force",
    Remedy.OTHER_FOLDER: "--out",
    Remedy.PACK_FAULT: "--debug shows more",
}


class Terminated(KeyboardInterrupt):
    """SIGTERM arrived. It ends a command as Ctrl-C does; the last state is saved."""


def _stop(_number: int, _frame: FrameType | None) -> None:
    raise Terminated


def _is_out_of_memory(error: Exception) -> bool:
    """Return whether memory ran out. Torch and OpenCV do not raise MemoryError then."""
    words = ("not enough memory", "can't allocate memory", "out of memory")
    return isinstance(error, MemoryError) or any(text in str(error).lower() for text in words)


def say_fault(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Print where a fault of the program is and what to do: for sys.excepthook, without --debug."""
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    where = f" ({Path(trace.tb_frame.f_code.co_filename).name}, line {trace.tb_lineno})" if trace else ""
    said = in_one_line(f"{kind.__name__}: {error}{where}")
    fault = UserError(f"a fault of the program: {said}. Started again, it goes on from here.", Remedy.PACK_FAULT)
    sys.stderr.write(f"shadowgraph: {sentence_for(fault)}\n")


def _in_words(error: UserError) -> str:
    """Return the text of an error with what to do as options, or as buttons of the studio that started this process."""
    if os.environ.get(FOR_STUDIO) == "1":
        from viewer.studio.helper import in_page_words

        return in_page_words(error)
    return error.worded(lambda one: f"{one.value} ({OPTIONS[one]})" if one in OPTIONS else one.value)


def sentence_for(error: Exception) -> str | None:
    """Say in one sentence what is wrong with the input or the machine; None: it is a fault of the program."""
    if isinstance(error, UserError):  # which may quote a stranger's file: nothing in it commands the terminal
        return in_one_line(_in_words(error))
    if isinstance(error, OSError):  # no room, no right to write, a drive that went away
        return (
            f"{error.filename or 'a file'}: {error.strerror or error}. Check that the place can be written to and has "
            "room; started again, it goes on from here."
        )
    if isinstance(error, RecursionError):
        return "a file that was read is nested without end, which none of ours is. Make the result again."
    if _is_out_of_memory(error):
        said = (str(error) or "nothing left").splitlines()[0]
        found = f"the memory of this machine is used up ({said}). Started again, it goes on from here."
        return _in_words(UserError(found, "close other programs", Remedy.COARSER))
    return None


def _view(command: View, console: Console) -> None:
    import webbrowser

    from viewer.page.serve import view

    opens = webbrowser.open if console.is_terminal and not command.no_open else None
    view(command.run, command.host, command.port, opens=opens)


def _import(command: Import, console: Console) -> None:
    from calibration.scenes.importers import import_folder

    out = command.out or Path("imported") / folder_name(command.folder)
    importer, scene = import_folder(command.folder, command.split, out)
    kinds = [f"{len(scene.rgb_paths)} photos"] if scene.rgb_paths else []
    kinds += [f"{len(scene.shadow_paths)} shadow pictures"] if scene.shadow_paths else []
    ground = "ground known" if scene.ground_known else "ground unknown"
    found = [f"{' and '.join(kinds)} with camera and lights", "a mask" if scene.mask_path else "no mask", ground]
    unused = [f"left out: {light.photo} ({light.reason})" for light in scene.calibration.lights if not light.used]
    warnings = [f"warning: {text}" for text in scene.calibration.residuals.get("warnings", [])]
    lines = [f"{importer.layout}: {', '.join(found)}", *scene.notes, *warnings, *unused]
    print_lines(console, *lines, f"Written to {out}")


def _evaluate(command: Evaluate, console: Console) -> None:
    from reconstruct.evaluate.metrics import evaluate
    from reconstruct.stored_run.documents import refuse_no_run

    refuse_no_run(command.run)
    refuse_no_folder(command.reference, "the folder that holds the truth")
    print(json.dumps(evaluate(command.run, command.reference), indent=1))


def _report(command: Report, console: Console) -> None:
    """Write the report again, or a bundle."""
    from reconstruct.run.bundle import write_bundle

    if command.bundle is not None:
        names = write_bundle(command.run, command.bundle, command.with_pictures)
        line = f"{command.bundle} written: {', '.join(names)}. Look into it before you send it."
    else:
        from reconstruct.stored_run.documents import refuse_no_run
        from viewer.report.report import write_report

        refuse_no_run(command.run)
        line = f"{write_report(command.run)} written"
    print_lines(console, line)


def _print_board(command: PrintBoard, console: Console) -> None:
    from calibration.board.board import parse_print
    from calibration.board.printing import DEFAULT_BOARDS, lay_out, save_board

    board = parse_print(command.board or DEFAULT_BOARDS[command.kind])
    pdf, png = command.out.with_suffix(".pdf"), command.out.with_suffix(".png")
    save_board(lay_out(board, command.paper), pdf, png)
    print_lines(
        console,
        f"{pdf} and {png} written. Print at 100 %, not fitted to the page, and measure the ruler.",
        "Glue the print to something flat. Then write into session.toml:",
        f'board = "{board.spec()}"',
    )


def _doctor(command: Doctor, console: Console) -> None:
    from reconstruct.run.machine import describe_machine

    print_lines(console, *describe_machine())


class Subcommand(NamedTuple):
    """One row of SUBCOMMANDS."""

    name: str
    options: type  # a dataclass: its docstrings are the --help
    execute: Callable[[Any, Console], None]  # takes an instance of it


SUBCOMMANDS = (  # in the order of --help
    Subcommand("run", Run, run_stages),
    Subcommand("batch", Batch, batch),
    Subcommand("check", Check, check),
    Subcommand("calibrate", Calibrate, run_stages),
    Subcommand("reconstruct", Reconstruct, run_stages),
    Subcommand("studio", Studio, studio),
    Subcommand("watch", Watch, watch),
    Subcommand("view", View, _view),
    Subcommand("export", Export, export),
    Subcommand("relight", Relight, relight),
    Subcommand("import", Import, _import),
    Subcommand("evaluate", Evaluate, _evaluate),
    Subcommand("report", Report, _report),
    Subcommand("board", PrintBoard, _print_board),
    Subcommand("doctor", Doctor, _doctor),
)


def execute(command: Any, console: Console) -> None:
    """Do what an instance of one of the options asks for.

    Raises:
        UserError: the input, a setting or the machine cannot be used.
        SystemExit: a batch ended with failed captures.
    """
    (row,) = (row for row in SUBCOMMANDS if row.options is type(command))
    row.execute(command, console)


def similar_command(word: str) -> str | None:
    """Return the command that a word which is none was probably meant to be."""
    names = [row.name for row in SUBCOMMANDS]
    if word in names or word.startswith("-"):
        return None
    return next(iter(difflib.get_close_matches(word.lower(), names, 1)), None)


def main(arguments: list[str] | None = None) -> int:
    """Do what the command line asks for and return the exit code.

    Args:
        arguments: in the place of those of the process; none at all open the studio.
    """
    given = sys.argv[1:] if arguments is None else arguments
    if given and (meant := similar_command(given[0])):
        print(f"shadowgraph: {given[0]} is no command; did you mean {meant}?", file=sys.stderr)
        return 2
    command = tyro.extras.subcommand_cli_from_dict(
        {row.name: row.options for row in SUBCOMMANDS},
        prog="shadowgraph",
        description="3D from shadows: photos under a moving flashlight become a mesh that can be relit.",
        args=given or ["studio"],
        config=(tyro.conf.OmitSubcommandPrefixes, tyro.conf.DisallowNone),
    )
    if not command.debug:
        sys.excepthook = say_fault
    try:
        with on_signal(signal.SIGTERM, _stop):
            execute(command, Console())
    except KeyboardInterrupt as stop:
        print("Stopped. Started again, it goes on from here.", file=sys.stderr)
        return 143 if isinstance(stop, Terminated) else 130
    except (UserError, OSError, MemoryError, RuntimeError) as error:
        sentence = None if command.debug else sentence_for(error)
        if sentence is None:
            raise
        print(f"shadowgraph: {sentence}", file=sys.stderr)
        return 2
    return 0
