"""Find out what an input folder holds: photos to calibrate, or a scene with a given calibration."""

from dataclasses import dataclass
from pathlib import Path

from calibration.board.board import parse_board
from calibration.calibrate import WAYS
from calibration.known_scene import KnownScene
from calibration.scenes.ground_depth import find_ground_depth
from calibration.scenes.importers import find_importer
from capture.errors import CaptureError
from capture.session.session import Session, load_session
from reconstruct.source.options import AUTO, UNKNOWN, RunOptions, ground_option

LARGEST_LIGHT_ERROR = 0.3  # of the distance: beyond it, shadows and shading constrain the lights better

DESCRIPTIONS = ("*.json", "*.txt", "*.npz", "*.npy", "*.lp", "*/*.lp")  # files that may describe a known scene
TRAINER_ABLATIONS = ("expected-depth", "sampled")  # the default solver has neither


@dataclass(frozen=True)
class Source:
    """The content of an input folder: a session of plain photos, or a scene whose calibration is given."""

    folder: Path
    session: Session | None = None
    known: KnownScene | None = None

    def files(self, options: RunOptions) -> list[Path]:
        """Return every file whose content affects the result."""
        given = [] if options.lights in WAYS else [Path(options.lights)]
        return [*given, *self._own_files()]

    def _own_files(self) -> list[Path]:
        if self.session is not None:
            settings = self.folder / "session.toml"
            session = self.session
            photos = (*session.board, *session.lit, *session.light, *session.dark, *session.side)
            mask = [path for path in (self.session.mask, self.session.phone_back) if path]
            return [*([settings] if settings.is_file() else []), *photos, *mask]
        assert self.known is not None
        mask = [self.known.mask_path] if self.known.mask_path else []
        texts = sorted(path for kind in DESCRIPTIONS for path in self.folder.glob(kind))
        uneven = [self.known.ground_depth_path] if self.known.ground_depth_path else []
        return [*texts, *uneven, *(self.known.rgb_paths or ()), *(self.known.shadow_paths or ()), *mask]

    def ground_is_known(self, options: RunOptions) -> bool:
        """Return True if the ground plane is given, by --ground or by the folder itself."""
        if options.ground == AUTO:
            return self.known is None or self.known.ground_known
        return options.ground != UNKNOWN

    def photos(self) -> tuple[Path, ...]:
        """The photos under the moving light, in the order of the lights."""
        if self.session is not None:
            return self.session.lit
        assert self.known is not None
        return self.known.rgb_paths or self.known.shadow_paths or ()


def open_source(folder: Path, options: RunOptions) -> Source:
    """Find out what a folder holds; reads names and headers only.

    Raises:
        CaptureError, CalibrationError: the folder does not exist, or holds no input for a run.
    """
    if not folder.is_dir():
        raise CaptureError(f"{folder} is not a folder; a folder with photos was needed.")
    importer = find_importer(folder, None if options.lights in WAYS else Path(options.lights))
    if importer is None:
        source = Source(folder, session=load_session(folder))
    else:
        source = Source(folder, known=importer.load(folder, options.split))
    _check_input(source, options)
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
    _check_uneven(source, options)
    ground_option(options.ground)
    if options.lights not in WAYS and not Path(options.lights).is_file():
        raise CaptureError(
            f"--lights {options.lights} is no such file; {', '.join(WAYS)}, or a file of lights was needed."
        )
    return source


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


def _check_uneven(source: Source, options: RunOptions) -> None:
    """Raise an error if uneven ground cannot be used with this source."""
    path = find_ground_depth(source.folder)
    if path is None or options.ground != AUTO:
        return
    if source.known is None or source.known.ground_depth_path is None:
        raise CaptureError(
            f"{path} gives uneven ground, which needs a scene with its own camera and lights in the ShadowNeuS layout; "
            "the ground of other folders is a plane. Remove the file, or give the plane with --ground HEIGHT."
        )
    if options.is_trained():
        raise CaptureError(
            f"{path} gives uneven ground, and a field trained with --preset paper or --field is held to a plane. "
            "Use --preset draft, standard or fine without --field, or give a plane with --ground HEIGHT."
        )
