"""The options of the subcommands: one dataclass each, whose docstrings are its --help. Those of `batch`, `export` and
`relight` are in the modules of these commands.
"""

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, Positional, arg

CaptureFolder = Annotated[Positional[Path], arg(metavar="CAPTURE")]
ResultFolder = Annotated[Positional[Path], arg(metavar="RUN")]
Input = Literal["auto", "rgb", "shadow", "both"]
Preset = Literal["draft", "standard", "fine", "paper"]
Field = Literal["auto", "grid", "neural", "hash"]
Ablation = Literal[
    "intersection", "boundary", "expected-depth", "foreground-only", "background-only", "sampled", "telescoped"
]
Device = Literal["auto", "cpu", "cuda", "torch-cpu"]
T = TypeVar("T")
UNSAID = arg(help_behavior_hint="")  # no "(default: None)": the sentence before says what happens
Given = Annotated[T | None, UNSAID]  # an option that need not be given
Flag = Annotated[FlagCreatePairsOff[bool], UNSAID]


@dataclass(frozen=True)
class Command:
    """What every command takes."""

    debug: Flag = field(default=False, kw_only=True)
    """Show the traceback of an error."""


@dataclass(frozen=True)
class CalibrateResearch:
    """Scenes of other programs, and comparisons."""

    input: Input = "auto"
    """Which pictures to use where a scene holds both colour photos and shadow pictures; auto prefers colour. both: the
    shadow pictures say where the light arrives, the colour photos which way the surface faces and its albedo."""
    split: str = "train"
    """For scenes with known lights: which transforms_SPLIT.json to read."""
    light_error: float = 0.0
    """How far the lights may be off, as a share of their distance (0.03: 3 %), where that is more than the calibration
    says. Of known lights, one more must then agree before matter is carved away; the result's sigma grows."""
    ground: str = "auto"
    """Where the ground is: auto (as the board or the scene's files say), a height (world z), or unknown: then the scale
    of the result is an assumption, and the report says so."""


@dataclass(frozen=True)
class ReconstructResearch(CalibrateResearch):
    """Scenes of other programs, and comparisons."""

    field: Field = "auto"
    """What represents the surface. auto and grid: the default solver's grid; neural: the paper's network; hash: hash
    features and a small network. With --preset paper, auto is neural and grid a grid trained by the paper's losses."""
    ablate: Given[Ablation] = None
    """Leave one part of the method out, or change it, to see what it is worth."""
    device: Device = "auto"
    """Where the surface is fitted. cpu: the processor; cuda: a graphics card; torch-cpu: the code of cuda
    on the CPU, much slower, to compare; auto: cpu, or where a field is trained (paper), cuda if there is one."""
    detail: Literal["auto", "on", "off"] = "auto"
    """Normals and albedo at the photos' own resolution, on the finished surface; auto: with --preset fine."""
    mask: Literal["auto", "none"] = "auto"
    """none: ignore the object's mask that comes with a scene."""
    seed: int = 0
    """Seed of all random numbers; the same seed gives the same result."""


@dataclass(frozen=True)
class OfCapture(Command):
    """What every command takes that looks at a capture."""

    capture: CaptureFolder
    """Folder with board/, photos/ and optionally light/, dark/, side/; a flat folder of photos; or one with a clip."""
    out: Given[Path] = None
    """Folder for the results; runs/NAME unless given."""
    board: Given[str] = None
    """The printed board: charuco:5x7:30:22:DICT_4X4_50 (squares columns x rows, square mm, marker mm, dictionary) or
    checkerboard:9x6:24.25 (inner corners, square mm); or a blank one: paper:A4, paper:letter, card. Otherwise
    session.toml says it, or common printed boards are tried."""
    lights: str = "auto"
    """auto, shading (from the ground's shading), phone (from the flashlight phone's own photos), or a file: ours
    (calibration.json, lights.json), RTI's .lp, .csv or .dome, or a file of a ShadowNeuS or S3-NeRF scene. A file
    with the light of every photo needs no board; nor do photos in which a shiny ball shows the lights."""


@dataclass(frozen=True)
class Check(OfCapture):
    """Say within a minute whether a capture is good and what to shoot next; writes check.html."""


@dataclass(frozen=True)
class Calibrate(OfCapture):
    """Find camera, ground and flashlight positions; writes calibration.json."""

    force: Flag = False
    """Start again in a folder that holds a run with other settings."""
    research: OmitArgPrefixes[CalibrateResearch] = field(default_factory=CalibrateResearch)
    """Scenes of other programs, and comparisons."""


@dataclass(frozen=True)
class Reconstruct(Calibrate):
    """Fit the surface of a calibrated capture (after `calibrate` with the same --out); writes meshes and maps."""

    preset: Preset = "standard"
    """draft: a first look; standard: the default; fine: more pixels and a finer grid, several times as long; paper: the
    network, batch and 150 000 iterations of the ShadowNeuS paper, for a graphics card and a day."""
    scale: Given[str] = None
    """One known length of the object, such as "120 mm" (also cm, m, in), where no board gives the scale: its height
    above the ground or, without a ground, its largest extent across the picture. session.toml may say it, too."""
    time_budget: Given[float] = None
    """Make the run shorter, so that it takes about this many seconds on this machine."""
    memory: Given[float] = None
    """Gigabytes that the run may take; what this machine has free unless given. If that is too little, the run uses
    fewer photos or pixels and says so."""
    research: OmitArgPrefixes[ReconstructResearch] = field(default_factory=ReconstructResearch)
    """Scenes of other programs, and comparisons."""


@dataclass(frozen=True)
class Run(Reconstruct):
    """Photos to mesh: calibrate, reconstruct, report. The same command again continues where it stopped."""

    viewer: Given[Literal["on", "off", "keep"]] = None
    """on: a page that follows the run and ends with it; keep: it stays until Ctrl-C; off: none. Otherwise keep in a
    terminal, on elsewhere."""


@dataclass(frozen=True)
class View(Command):
    """Open a run in the browser: follow it while it goes on; light, turn, measure and save it once it is finished."""

    run: ResultFolder
    """The folder of a run, finished or not."""
    host: str = "127.0.0.1"
    """Address to listen on. Anything but 127.0.0.1 lets others on the network see the page."""
    port: int = 8080
    """The next free one is taken where this one is busy."""
    no_open: Flag = False
    """Do not open the browser, which a terminal otherwise does; print the address only."""


@dataclass(frozen=True)
class Import(Command):
    """Write another program's scene (ShadowNeuS, DeepShadow, S3-NeRF, RTI, DiLiGenT) in Shadowgraph's own layout.

    `run` reads these folders directly. This command also says what it found in one and what it assumed.
    """

    folder: Annotated[Positional[Path], arg(metavar="FOLDER")]
    """The scene."""
    out: Given[Path] = None
    """A new folder for the result; imported/NAME unless given."""
    split: str = "train"
    """Which list of photos to read, where there are several: transforms_SPLIT.json, params_SPLIT.npz."""


@dataclass(frozen=True)
class Evaluate(Command):
    """Compare a run with a reference (a capture or scene with a gt/ folder); prints JSON."""

    run: ResultFolder
    """The folder of a finished run."""
    reference: Annotated[Path, arg(metavar="REFERENCE")]
    """The folder that holds the truth."""


@dataclass(frozen=True)
class Report(Command):
    """Write report.html of a run again, or pack the run for a bug report."""

    run: ResultFolder
    """The folder of a run, finished or not."""
    bundle: Given[Path] = None
    """Pack log, reports, calibration, settings and versions into this .zip, without photos and personal paths."""
    with_pictures: Flag = False
    """Also pack small copies of the photos, and the pictures in the pages."""


@dataclass(frozen=True)
class PrintBoard(Command):
    """Make a board to print at true scale: a PDF and a PNG, with a ruler, and the line for session.toml."""

    out: Annotated[Positional[Path], arg(metavar="FILE")] = Path("board.pdf")
    """The PDF to write; the PNG gets the same name."""
    kind: Literal["charuco", "checkerboard"] = "charuco"
    """charuco is recognised from all sides and with parts of it hidden; a checkerboard has fewer fine details."""
    paper: Literal["a4", "letter"] = "a4"
    """The sheet."""
    board: Given[str] = None
    """Another size, as charuco:5x7:30:22:DICT_4X4_50 or checkerboard:9x6:24."""


@dataclass(frozen=True)
class Doctor(Command):
    """Say what this machine can do, and how long a run will take."""


def settings_of(command: Calibrate) -> dict[str, Any]:
    """Return every option of a command by its name, those for research among the others."""
    return {key: value for key, value in vars(command).items() if key != "research"} | vars(command.research)


def run_with(capture: Path, out: Path | None, **settings: Any) -> Run:
    """Return the options of `run` without a page, given by their names.

    Raises:
        TypeError: there is no such option.
    """
    names = {one.name for one in fields(ReconstructResearch)}
    research = ReconstructResearch(**{key: value for key, value in settings.items() if key in names})
    others = {key: value for key, value in settings.items() if key not in names}
    return Run(capture, out, viewer="off", research=research, **others)
