"""Find out what an input folder holds: photos to calibrate, or a scene with a given calibration.

RunOptions: every setting of a run that changes its result.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calibration.board.board import parse_board
from calibration.board.corners import grey_of
from calibration.board.recognise import board_finder, guess_board
from calibration.calibrate import WAYS
from calibration.known_scene import KnownScene
from calibration.scenes.importers import find_importer
from calibration.scenes.listed_lights import load_listed, load_with_ball, why_unused
from calibration.scenes.shadowneus import find_ground_depth
from capture.errors import CalibrationError, CaptureError, Remedy, UserError
from capture.files.names import clip_of, refuse_no_folder
from capture.photos.finding import Finding
from capture.photos.photo import read_photo
from capture.session.capture import Capture, load_capture
from capture.session.roles import NoBoardError
from capture.session.seen import SeenPhotos
from capture.session.session import SETTINGS_FILE, Session, load_settings, parse_length

AUTO, UNKNOWN = "auto", "unknown"  # of --ground, which may be a height instead
CALIBRATION_LONG_SIDE = 800  # px: checks and light fit average over patches of ground, finer photos add nothing
LONG_SIDES = {"draft": 320, "standard": 640, "fine": 1024, "paper": 800}  # px that the solver looks at, by preset
LARGEST_LIGHT_ERROR = 0.3  # of the distance: beyond it, shadows and shading constrain the lights better
# Files that may describe a known scene.
DESCRIPTIONS = ("*.json", "*.txt", "*.npz", "*.npy", "*.lp", "*/*.lp", "*.csv", "light*.mat", "*.dome", "session.toml")
WITHOUT_BOARD = (
    "Without a board, the directions of the lights are missing, which a shiny ball in the picture would tell (none was "
    "found; session.toml may name it: ball = [x, y, radius], pixels)."
)
TRAINER_ABLATIONS = ("expected-depth", "sampled")  # the default solver has neither


@dataclass(frozen=True)
class RunOptions:
    """Every setting of a run that changes its result."""

    board: str | None = None
    input: str = "auto"
    lights: str = "auto"
    light_error: float = 0.0
    preset: str = "standard"
    device: str = "auto"
    time_budget: float | None = None
    seed: int = 0
    split: str = "train"
    ground: str = "auto"
    mask: str = "auto"
    field: str = "auto"
    ablate: str | None = None
    detail: str = "auto"
    memory: float | None = None
    scale: str | None = None

    def is_trained(self) -> bool:
        """True if a field is trained in torch (reconstruct/shadowneus/) instead of fitted by the default solver."""
        return self.preset == "paper" or self.field in ("neural", "hash")

    def long_side(self) -> int:
        """The longer side (px) of photos as they are read, large enough for checks, calibration and solver."""
        return max(CALIBRATION_LONG_SIDE, LONG_SIDES[self.preset])


def ground_option(option: str) -> float | None:
    """Return the world z of the ground that --ground gives; None for "auto" and "unknown".

    Raises:
        CalibrationError: the option is neither of these nor a number.
    """
    if option in (AUTO, UNKNOWN):
        return None
    try:
        height = float(option)
    except ValueError:
        height = np.nan
    if not np.isfinite(height):
        raise CalibrationError(
            f"--ground {option} is no height; auto, unknown, or the world z of the ground was needed."
        )
    return height


@dataclass(frozen=True)
class Source:
    """The content of an input folder: a capture of plain photos, or a scene whose calibration is given."""

    folder: Path
    capture: Capture | None = None
    known: KnownScene | None = None

    @property
    def session(self) -> Session | None:
        """The session of a capture's first view; the only one of most captures."""
        return None if self.capture is None else self.capture.views[0]

    @property
    def name(self) -> str:
        """The name of the view that this source is; "" where there is one."""
        return "" if self.capture is None else self.capture.name

    def views(self) -> tuple["Source", ...]:
        """Return a source for each session of a capture, those of further object poses last; a scene is one view."""
        if self.capture is None:
            return (self,)
        return tuple(replace(self, capture=Capture(x.folder, (x,), name=x.name)) for x in self.capture.sessions())

    def files(self, options: RunOptions) -> list[Path]:
        """Return every file whose content affects the result."""
        given = [] if options.lights in WAYS else [Path(options.lights)]
        return [*given, *self._own_files()]

    def _own_files(self) -> list[Path]:
        if self.capture is not None:
            found: list[Path] = []
            captures = (self.capture, *self.capture.object_poses)
            for folder in dict.fromkeys((self.folder, *(one.folder for one in captures))):
                found += [folder / SETTINGS_FILE] if (folder / SETTINGS_FILE).is_file() else []
            for session in self.capture.sessions():
                own = session.folder / SETTINGS_FILE
                found += [own] if own.is_file() else []
                found += [*session.board, *session.lit, *session.light, *session.dark, *session.side]
                found += filter(None, (session.mask, session.phone_back))
            return list(dict.fromkeys((*found, *(path for one in captures for path in one.board))))
        assert self.known is not None
        texts = sorted(path for kind in DESCRIPTIONS for path in self.folder.glob(kind))
        pictures = (*(self.known.rgb_paths or ()), *(self.known.shadow_paths or ()), *self.known.dark_paths)
        return [*texts, *filter(None, (self.known.ground_depth_path, *pictures, self.known.mask_path))]

    def ground_is_known(self, options: RunOptions) -> bool:
        """Return True if the ground plane is given, by --ground or by the folder itself."""
        if options.ground == AUTO:
            return self.known is None or self.known.ground_known
        return options.ground != UNKNOWN

    def scale(self, options: RunOptions) -> float | None:
        """Return the object's known length, mm: --scale, or session.toml's `scale`.

        Raises:
            CaptureError: it is no length.
        """
        if options.scale is not None:
            return parse_length(options.scale, "--scale")
        return load_settings(self.folder).scale

    def photos(self) -> tuple[Path, ...]:
        """The photos under the moving light, in the order of the lights; view after view."""
        if self.capture is not None:
            return tuple(path for session in self.capture.sessions() for path in session.lit)
        assert self.known is not None
        return self.known.rgb_paths or self.known.shadow_paths or ()

    def left_out(self) -> tuple[Finding, ...]:
        """The photos that cannot be read or have another size than the rest, and the copies of a capture's."""
        if self.capture is None:
            return () if self.known is None else self.known.photos.left_out
        sessions = self.capture.sessions()
        return tuple(one for session in sessions for one in session.left_out)


def open_source(folder: Path, options: RunOptions) -> Source:
    """Find out what a folder holds: reads names, and decodes small copies of a capture's photos to tell their roles.

    Raises:
        CaptureError, CalibrationError: the folder does not exist, or holds no input for a run.
    """
    refuse_no_folder(folder, "the folder that holds the photos")
    given = None if options.lights in WAYS else Path(options.lights)
    if given is not None and not given.is_file():
        raise CaptureError(f"--lights {given} is no such file; {', '.join(WAYS)}, or a file of lights was needed.")
    source = _opened(folder, options, given)
    _check_input(source, options)
    if given is not None and len(source.views()) > 1:
        raise CaptureError(
            f"--lights {given}: {folder} has {len(source.views())} views, and a file of lights is read for one view "
            "only. Leave --lights out, or give the folder of one view."
        )
    if not 0 <= options.light_error < LARGEST_LIGHT_ERROR:
        raise CaptureError(
            f"--light-error {options.light_error:g}: a share of the lights' distance from 0 to {LARGEST_LIGHT_ERROR} "
            "was needed, 0.03 for 3 %."
        )
    if source.known is not None and options.lights in WAYS[1:]:
        raise CaptureError(
            f"--lights {options.lights}: {folder} comes with its lights, which need no calibration. Leave --lights "
            "out, or give a file of lights."
        )
    spec = options.board or (source.session.settings.board if source.session is not None else None)
    if spec:
        parse_board(spec)
    _check_solver(options)
    _check_uneven(folder, source.known, options)
    ground_option(options.ground)
    _check_scale(source, options)
    return source


def _opened(folder: Path, options: RunOptions, lights: Path | None) -> Source:
    """Return a scene that comes with its lights, in the folder or in the user's file, or a capture with a board."""
    importer = find_importer(folder, lights)
    if importer is not None:
        return Source(folder, known=importer.load(folder, options.split))
    _check_uneven(folder, None, options)  # before photos are opened
    circle = load_settings(folder).ball
    if circle is not None and lights is None:
        return Source(folder, known=load_with_ball(folder, circle))
    try:
        capture = load_capture(folder, SeenPhotos(board_finder(options.board or load_settings(folder).board)))
        is_bare = _may_lack_a_board(capture, options)
        if is_bare and lights is not None:
            raise NoBoardError(f"no photo in {folder} shows a board that others show too.")
        ball = load_with_ball(folder, None) if is_bare else None
        return Source(folder, capture=capture) if ball is None else Source(folder, known=ball)
    except NoBoardError as no_capture:
        if lights is None:
            known = load_with_ball(folder, None) if options.lights == WAYS[0] else None
            if known is None:
                said = f"{no_capture.found} {WITHOUT_BOARD}{why_unused(folder)}"
                raise CaptureError(said, *no_capture.remedies, Remedy.LIGHTS_FILE) from None
            return Source(folder, known=known)
        try:
            known = load_listed(folder, lights)
        except UserError as no_list:
            raise CaptureError(
                f"{no_capture} Without a board the lights must be those of the photos: {no_list}"
            ) from None
        return Source(folder, known=replace(known, lights_from=lights))


def _may_lack_a_board(capture: Capture, options: RunOptions) -> bool:
    """Return True if the board's photo was only guessed, by its even light, and shows no common board."""
    session = capture.views[0]
    if len(capture.sessions()) > 1 or not session.board:
        return False
    is_named = options.board or session.settings.board or "board" in session.settings.roles
    if is_named or options.lights in WAYS[1:] or session.board[0].parent != session.folder or clip_of(session.board[0]):
        return False
    return guess_board([grey_of(read_photo(path)) for path in session.board]) is None


def _check_input(source: Source, options: RunOptions) -> None:
    """Raise an error if the folder lacks the chosen --input."""
    has_shadow = source.known is not None and source.known.shadow_paths is not None
    has_rgb = source.known is None or source.known.rgb_paths is not None
    lacks_shadow = options.input in ("shadow", "both") and not has_shadow
    lacks_rgb = options.input in ("rgb", "both") and not has_rgb
    if lacks_shadow or lacks_rgb:
        raise CaptureError(
            f"{source.folder} holds no {'shadow pictures' if lacks_shadow else 'colour photos'}, which "
            f"--input {options.input} needs. Leave --input out to use what is there."
        )


def _check_scale(source: Source, options: RunOptions) -> None:
    """Raise an error for a scale where the input has one."""
    length = source.scale(options)
    if length is None:
        return
    if source.known is None or source.known.calibration.unit != "scene":
        raise CaptureError(
            f"{source.folder}: a scale of {length:g} mm was given, but its board or calibration gives lengths in "
            "millimetres; one of them was needed. Leave --scale and session.toml's scale out."
        )
    if source.known.ground_depth_path is not None and options.ground == AUTO:
        raise CaptureError(
            f"{source.folder} has uneven ground, whose unit a scale would change; a plane was needed. Leave --scale "
            "out."
        )


def _check_solver(options: RunOptions) -> None:
    """Raise an error for options that the chosen solver does not support."""
    if options.is_trained() and options.time_budget is not None:
        raise CaptureError(
            "--time-budget shortens the default solver; a field trained with --preset paper or --field was asked for. "
            "Choose its length by --preset draft, standard or fine."
        )
    if not options.is_trained() and options.ablate in TRAINER_ABLATIONS:
        raise CaptureError(
            f"--ablate {options.ablate} is not part of the default solver; a trained field was needed. "
            "Add --field neural or --field hash."
        )


def _check_uneven(folder: Path, known: KnownScene | None, options: RunOptions) -> None:
    """Raise an error if uneven ground in a folder cannot be used: known is None for photos without a layout."""
    path = find_ground_depth(folder)
    if path is None or options.ground != AUTO:
        return
    if known is None or known.ground_depth_path is None:
        raise CaptureError(
            f"{path} gives uneven ground, which needs a scene with its own camera and lights in the ShadowNeuS layout; "
            "the ground of other folders is a plane.",
            "remove the file",
            Remedy.GROUND,
        )
    if options.is_trained():
        raise CaptureError(
            f"{path} gives uneven ground, and a field trained with --preset paper or --field is held to a plane.",
            "use another preset without a field",
            Remedy.GROUND,
        )
