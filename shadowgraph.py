"""Shadowgraph: 3D from shadows. The command `shadowgraph`, and the names to import.

    result = shadowgraph.run("photos/")
    from shadowgraph import load_session, read_stack, calibrate, build_scene, fit, extract_mesh

Exit codes: 0 done, 1 a fault of the program (of `batch`: a capture failed), 2 the input or a setting cannot be used, or
the machine has no room for it (one sentence says why), 130 stopped with Ctrl-C, 143 ended by SIGTERM.
docs/reliability.md says what holds after each.
"""

import importlib
import json
import os
import sys
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin, get_type_hints

import tyro
from rich.console import Console
from tyro.conf import FlagCreatePairsOff, OmitSubcommandPrefixes, Positional, arg, subcommand

from capture.errors import UserError
from capture.faults import Terminated, say_fault, sentence_for, sigterm_as_ctrl_c
from reconstruct.run.folder import RunFolder
from viewer.batch_command import Batch, do_batch
from viewer.save_commands import Export, Relight, do_export, do_relight
from viewer.terminal import Display, page

if TYPE_CHECKING:
    from viewer.run_result import RunResult

FACADE = {
    "read_photo": "capture.photos.photo",
    "read_stack": "capture.photos.photo",
    "load_session": "capture.session.session",
    "check_stack": "capture.checks.check_stack",
    "calibrate": "calibration.calibrate",
    "Calibration": "calibration.calibration",
    "load_calibration": "calibration.calibration",
    "save_calibration": "calibration.calibration",
    "load_known_scene": "calibration.scenes.shadowneus",
    "build_scene": "reconstruct.scene",
    "FitConfig": "reconstruct.solve.solver",
    "fit": "reconstruct.solve.solver",
    "load_fields": "reconstruct.fields",
    "save_fields": "reconstruct.fields",
    "extract_mesh": "reconstruct.mesh.mesh",
    "save_mesh": "reconstruct.mesh.mesh",
    "relight": "reconstruct.render.relight",
    "evaluate": "reconstruct.evaluate.metrics",
    "view": "viewer.page.serve",
    "look": "reconstruct.render.g_buffer",
    "RunResult": "viewer.run_result",
}
SOME_FAILED = 1  # exit code of a batch that ended with failed captures

CaptureFolder = Annotated[Positional[Path], arg(metavar="CAPTURE")]
ResultFolder = Annotated[Positional[Path], arg(metavar="RUN")]
Input = Literal["auto", "rgb", "shadow", "both"]
Preset = Literal["draft", "standard", "fine", "paper"]
Field = Literal["auto", "grid", "neural", "hash"]
Ablation = Literal[
    "intersection", "boundary", "expected-depth", "foreground-only", "background-only", "sampled", "telescoped"
]
Device = Literal["auto", "cpu", "cuda", "torch-cpu"]
Flag = FlagCreatePairsOff[bool]


def __getattr__(name: str) -> Any:
    """The facade: each name is imported from its module when it is first asked for, so that --help stays fast."""
    if name in FACADE:
        return getattr(importlib.import_module(FACADE[name]), name)
    raise AttributeError(f"module 'shadowgraph' has no attribute {name!r}")


@dataclass(frozen=True)
class Calibrate:
    """Find camera, ground and flashlight positions; writes calibration.json."""

    capture: CaptureFolder
    """Folder with board/, photos/ and optionally light/, dark/; a flat folder of photos; or one with a clip."""
    out: Path | None = None
    """Folder for the results; runs/NAME unless given."""
    board: str | None = None
    """The printed board: charuco:5x7:30:22:DICT_4X4_50 (squares columns x rows, square mm, marker mm, dictionary) or
    checkerboard:9x6:24.25 (inner corners, square mm). Otherwise session.toml says it, or common boards are tried."""
    input: Input = "auto"
    """Which pictures to use where a scene holds both colour photos and shadow pictures; auto prefers colour. both: the
    shadow pictures say where the light arrives, the colour photos which way the surface faces and its albedo."""
    lights: str = "auto"
    """auto, shading (from the ground's shading), phone (from the flashlight phone's own photos), or a file: ours
    (calibration.json, lights.json), RTI's .lp or .dome, or a file of a ShadowNeuS or S3-NeRF scene."""
    split: str = "train"
    """For scenes with known lights: which transforms_SPLIT.json to read."""
    light_error: float = 0.0
    """How far the lights may be off, as a share of their distance (0.03: 3 %), where that is more than the calibration
    says; uncertain lights are refined together with the surface. 0: known lights stay where they are."""
    ground: str = "auto"
    """Where the ground is: auto (as the board or the scene's files say), a height (world z), or unknown: then the scale
    of the result is an assumption, and the report says so."""
    force: Flag = False
    """Start again in a folder that holds a run with other settings."""
    debug: Flag = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class Check:
    """Say within a minute whether a capture is good and what to shoot next; writes check.html."""

    capture: CaptureFolder
    """Folder with board/, photos/ and optionally light/, dark/; a flat folder of photos; or one with a clip."""
    out: Path | None = None
    """Folder for check.html and check.json; runs/NAME unless given."""
    board: str | None = None
    """The printed board, as for `run`."""
    lights: str = "auto"
    """Where the lights come from, as for `run`."""
    debug: Flag = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class Reconstruct(Calibrate):
    """Fit the surface of a calibrated capture (after `calibrate` with the same --out); writes meshes and maps."""

    preset: Preset = "standard"
    """draft: a first look; standard: the default; fine: more pixels and a finer grid, several times as long; paper: the
    network, batch and 150 000 iterations of the ShadowNeuS paper, for a graphics card and a day."""
    field: Field = "auto"
    """What represents the surface. auto and grid: the default solver's grid; neural: the paper's network; hash: hash
    features and a small network. With --preset paper, auto is neural and grid a grid trained by the paper's losses."""
    ablate: Ablation | None = None
    """Leave one part of the method out, or change it, to see what it is worth."""
    device: Device = "auto"
    """Where the surface is fitted. cpu: compiled kernels; cuda: torch on a graphics card; auto: cuda if there is one;
    torch-cpu: the code of cuda on the CPU, much slower, to compare."""
    detail: Literal["auto", "on", "off"] = "auto"
    """Normals and albedo at the photos' own resolution, on the finished surface; auto: with --preset fine."""
    mask: Literal["auto", "none"] = "auto"
    """none: leave out the object's mask that comes with a scene."""
    time_budget: float | None = None
    """Shorten the schedule so that the run takes about this many seconds here, measured with a short loop."""
    memory: float | None = None
    """Gigabytes that the run may take; what this machine has free unless given. Where that is too little, the run looks
    at fewer photos or pixels, and says so."""
    seed: int = 0
    """Of everything random; the same seed gives the same result."""


@dataclass(frozen=True)
class Run(Reconstruct):
    """Photos to mesh: calibrate, reconstruct, report. The same command again continues where it stopped."""

    viewer: Literal["on", "off", "keep"] | None = None
    """on: a page that follows the run and ends with it; keep: it stays until Ctrl-C; off: none. Otherwise keep in a
    terminal, on elsewhere."""


@dataclass(frozen=True)
class View:
    """Open a run in the browser: the mesh, photos, lights, and a lamp to drag."""

    run: ResultFolder
    """The folder of a run, finished or not."""
    host: str = "127.0.0.1"
    """Address to listen on. Anything but 127.0.0.1 lets others on the network see the page."""
    port: int = 8080
    """The next free one is taken where this one is busy."""
    reference: Path | None = None
    """A mesh file or the folder of another run: the page can colour this run by its distance to it. A file without a
    unit is taken to be in this run's."""
    debug: Flag = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class Import:
    """Write another program's scene (ShadowNeuS, DeepShadow, S3-NeRF, RTI, DiLiGenT) in Shadowgraph's own layout.

    `run` reads these folders without it, too; this says what is found in one and what is assumed.
    """

    folder: Annotated[Positional[Path], arg(metavar="FOLDER")]
    """The scene."""
    out: Path | None = None
    """A new folder for the result; imported/NAME unless given."""
    split: str = "train"
    """Which list of photos to read, where there are several: transforms_SPLIT.json, params_SPLIT.npz."""
    debug: Flag = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class Evaluate:
    """Compare a run with a reference (a capture or scene with a gt/ folder); prints JSON."""

    run: ResultFolder
    """The folder of a finished run."""
    reference: Annotated[Path, arg(metavar="REFERENCE")]
    """The folder that holds the truth."""
    debug: Flag = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class Report:
    """Write report.html of a run again, or pack the run for a bug report."""

    run: ResultFolder
    """The folder of a run, finished or not."""
    bundle: Path | None = None
    """Pack log, reports, calibration, settings and versions into this .zip, without photos and personal paths."""
    with_pictures: Flag = False
    """Into the bundle, too: small copies of the photos, and the pictures in the pages."""
    debug: Flag = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class PrintBoard:
    """Make a board to print at true scale: a PDF and a PNG, with a ruler, and the line for session.toml."""

    out: Annotated[Positional[Path], arg(metavar="FILE")] = Path("board.pdf")
    """The PDF to write; the PNG gets the same name."""
    kind: Literal["charuco", "checkerboard"] = "charuco"
    """charuco can be told from all sides and in parts; a checkerboard has fewer fine details."""
    paper: Literal["a4", "letter"] = "a4"
    """The sheet."""
    board: str | None = None
    """Another size, as charuco:5x7:30:22:DICT_4X4_50 or checkerboard:9x6:24."""
    debug: Flag = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class Doctor:
    """Say what this machine can do, and how long a run will take."""

    debug: Flag = False
    """Show the traceback of an error."""


Command = OmitSubcommandPrefixes[
    Annotated[Run, subcommand("run")]
    | Annotated[Batch, subcommand("batch")]
    | Annotated[Check, subcommand("check")]
    | Annotated[Calibrate, subcommand("calibrate")]
    | Annotated[Reconstruct, subcommand("reconstruct")]
    | Annotated[View, subcommand("view")]
    | Annotated[Export, subcommand("export")]
    | Annotated[Relight, subcommand("relight")]
    | Annotated[Import, subcommand("import")]
    | Annotated[Evaluate, subcommand("evaluate")]
    | Annotated[Report, subcommand("report")]
    | Annotated[PrintBoard, subcommand("board")]
    | Annotated[Doctor, subcommand("doctor")]
]


def run(capture: str | Path, out: str | Path | None = None, *, quiet: bool = False, **settings: Any) -> "RunResult":
    """Photos to mesh, as the command `shadowgraph run`: also a call that was interrupted is continued by the same call.

        result = shadowgraph.run("photos/", preset="draft")
        result.mesh.export("head.stl")

    Args:
        capture: folder of photos, or a clip's folder, or a scene.
        out: folder for the results; runs/NAME unless given.
        quiet: no progress on standard output.
        settings: options of the command, with underscores: preset, board, lights, seed, time_budget, force, ...

    Raises:
        UserError: the input cannot be used; says what was found, what was needed and what to do.
    """
    from viewer.run_result import RunResult

    _check_choices(settings)
    command = Run(Path(capture), None if out is None else Path(out), viewer="off", **settings)
    run_stages(command, Console(quiet=quiet))
    return RunResult(results_folder(command))


def _check_choices(settings: Mapping[str, Any]) -> None:
    """Refuse what the command line would refuse."""
    hints = get_type_hints(Run)
    known = [name for name in hints if name not in ("capture", "out", "viewer")]
    unknown = sorted(set(settings) - set(known))
    if unknown:
        raise TypeError(f"shadowgraph.run has no setting {unknown[0]!r}; {', '.join(known)} are known.")
    for name, value in settings.items():
        kinds = (hints.get(name), *get_args(hints.get(name)))
        choices = [choice for kind in kinds if get_origin(kind) is Literal for choice in get_args(kind)]
        if choices and value is not None and value not in choices:
            raise UserError(f"{name}={value!r}: one of {', '.join(map(repr, choices))} was needed.")


def _name(folder: Path) -> str:
    """A folder's name as it was given: a link's own, not that of where it leads."""
    return Path(os.path.abspath(folder)).name


def results_folder(command: Calibrate | Check) -> Path:
    """Where the results go."""
    return command.out or Path("runs") / _name(command.capture)


def run_stages(command: Calibrate, console: Console) -> None:
    """`run`, `calibrate` and `reconstruct`: the stages asked for, in a run folder."""
    from reconstruct.run.source import RunOptions, open_source

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
    from reconstruct.run.source import RunOptions, open_source

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
        from reconstruct.run.machine import describe_machine

        for line in describe_machine():
            console.print(line, markup=False, highlight=False, soft_wrap=True)


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


if __name__ == "__main__":
    sys.exit(main())
