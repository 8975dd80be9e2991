"""What a folder turned out to be: photos to calibrate, or a scene with a given calibration; read, and calibrated."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from calibration.board.board import parse_board
from calibration.calibrate import WAYS, calibrate
from calibration.calibrate_with_file import calibrate_with_file, scene_with_file
from calibration.calibration import Calibration
from calibration.known_scene import KnownScene
from calibration.scenes.ground_depth import find_ground_depth, read_ground_depth
from calibration.scenes.importers import find_importer
from capture.checks.check_stack import check_stack, white_balance_finding
from capture.checks.finding import Finding, keep_findings, kept_findings
from capture.errors import CalibrationError, CaptureError
from capture.photos.photo import PhotoStack, read_alpha, read_grey, read_stack
from capture.photos.radiometry import with_one_white_balance, without_ambient
from capture.session.session import Session, load_session
from reconstruct.run.options import CALIBRATION_LONG_SIDE, LONG_SIDES, RunOptions

WORDS = ("auto", "unknown")


LARGEST_LIGHT_ERROR = 0.3  # of the distance: beyond, shadows and shading say more about the lights than they do

DESCRIPTIONS = ("*.json", "*.txt", "*.npz", "*.npy", "*.lp", "*/*.lp")  # files that may describe a known scene
SAME_SHAPE = 0.02  # of the ratio of the sides: sizes are rounded to pixels
TRAINER_ABLATIONS = ("expected-depth", "sampled")  # the default solver has neither


@dataclass(frozen=True)
class Source:
    """What a folder turned out to be: a session of plain photos, or a scene whose calibration is given."""

    folder: Path
    session: Session | None = None
    known: KnownScene | None = None

    def files(self, options: RunOptions) -> list[Path]:
        """Every file whose content decides the result."""
        given = [] if options.lights in WAYS else [Path(options.lights)]
        return [*given, *self._own_files()]

    def _own_files(self) -> list[Path]:
        if self.session is not None:
            settings = self.folder / "session.toml"
            photos = (*self.session.board, *self.session.lit, *self.session.light, *self.session.dark)
            mask = [path for path in (self.session.mask, self.session.phone_back) if path]
            return [*([settings] if settings.is_file() else []), *photos, *mask]
        assert self.known is not None
        mask = [self.known.mask_path] if self.known.mask_path else []
        texts = sorted(path for kind in DESCRIPTIONS for path in self.folder.glob(kind))
        uneven = [self.known.ground_depth_path] if self.known.ground_depth_path else []
        return [*texts, *uneven, *(self.known.rgb_paths or ()), *(self.known.shadow_paths or ()), *mask]

    def ground_is_known(self, options: RunOptions) -> bool:
        """Whether the ground plane is given, by --ground or by the folder itself."""
        if options.ground == "auto":
            return self.known is None or self.known.ground_known
        return options.ground != "unknown"

    def photos(self) -> tuple[Path, ...]:
        """The photos under the moving light, in the order of the lights."""
        if self.session is not None:
            return self.session.lit
        assert self.known is not None
        return self.known.rgb_paths or self.known.shadow_paths or ()


@dataclass(frozen=True)
class Pictures:
    """The pictures of one run in memory."""

    stack: PhotoStack | None
    findings: tuple[Finding, ...] = ()
    shadow: Float[np.ndarray, "photos height width"] | None = None
    mask: Float[np.ndarray, "mask_height mask_width"] | None = None
    ground_depth: Float[np.ndarray, "full_height full_width"] | None = None


def open_source(folder: Path, options: RunOptions) -> Source:
    """Find out what a folder holds; reads names and headers only.

    Raises:
        CaptureError, CalibrationError: no such folder, or nothing in it that a run can start from.
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
    check_ground(options.ground)
    if options.lights not in WAYS and not Path(options.lights).is_file():
        raise CaptureError(
            f"--lights {options.lights} is no such file; {', '.join(WAYS)}, or a file of lights was needed."
        )
    return source


def _check_input(source: Source, options: RunOptions) -> None:
    """Refuse an --input that is not there."""
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
    """Refuse what the chosen solver cannot do."""
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
    """Refuse uneven ground where it cannot be used."""
    path = find_ground_depth(source.folder)
    if path is None or options.ground != "auto":
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


def read_pictures(source: Source, options: RunOptions, kept: Path | None = None) -> Pictures:
    """Read and check the photos, the given shadow pictures where they are asked for or all there is, or both.

    Args:
        kept: a folder for what is read and found; what it holds already is not done again, see read_stack.
    """
    long_side = max(CALIBRATION_LONG_SIDE, LONG_SIDES[options.preset])
    kept = None if kept is None else kept / str(long_side)
    if source.known is None:
        stack = read_stack(source.photos(), long_side, kept=kept)
        assert source.session is not None
        dark = source.session.dark
        dark_stack = read_stack(dark, long_side, stack.reference) if dark else None
        findings = kept_findings(kept, stack.paths) if kept else None
        if findings is None:
            tripod = source.session.board[:1]  # the photo that camera and ground are calibrated with
            findings = check_stack(stack, dark_stack, read_stack(tripod, long_side) if tripod else None)
            keep_findings(kept, findings) if kept else None
        if dark_stack is not None:
            stack = without_ambient(stack, dark_stack)
        stack, changed = with_one_white_balance(stack)
        findings = (*findings, *map(white_balance_finding, changed, changed.values()))
        return Pictures(stack, findings, mask=_users_mask(source.session, stack) if options.mask == "auto" else None)
    known = source.known
    wants_shadow = options.input in ("shadow", "both") or known.rgb_paths is None
    wants_rgb = options.input != "shadow" and known.rgb_paths is not None
    mask = _given_mask(known) if options.mask == "auto" else None
    shadow = None
    if wants_shadow:
        assert known.shadow_paths is not None
        shadow = np.stack([read_grey(path) for path in known.shadow_paths])
    stack = (
        read_stack(known.rgb_paths, long_side, as_linear=known.is_linear, kept=kept)
        if wants_rgb and known.rgb_paths is not None
        else None
    )
    path = known.ground_depth_path if options.ground == "auto" else None
    ground_depth = None if path is None else read_ground_depth(path, known.calibration.camera)
    return Pictures(stack, shadow=shadow, mask=mask, ground_depth=ground_depth)


def _users_mask(session: Session, stack: PhotoStack) -> Float[np.ndarray, "mask_height mask_width"] | None:
    """The mask beside a capture's session.toml, if there is one.

    Raises:
        CaptureError: it has other pixels than the photos, or shows no object.
    """
    if session.mask is None:
        return None
    mask = read_grey(session.mask)
    if mask.shape != (stack.full_height, stack.full_width):
        raise CaptureError(
            f"{session.mask} is {mask.shape[1]} x {mask.shape[0]} pixels, {stack.full_width} x {stack.full_height} as "
            "the photos are stored was needed. Draw it on one of them, or remove it."
        )
    if not 0 < mask.mean() < 1:
        raise CaptureError(f"{session.mask} is all one colour; white on the object and black elsewhere was needed.")
    return mask


def _given_mask(known: KnownScene) -> Float[np.ndarray, "mask_height mask_width"] | None:
    if known.mask_path is None:
        return None
    mask = read_grey(known.mask_path) if known.mask_is_grey else read_alpha(known.mask_path)
    camera = known.calibration.camera
    if mask is not None and abs(mask.shape[1] * camera.height / (mask.shape[0] * camera.width) - 1) > SAME_SHAPE:
        raise CaptureError(
            f"{known.mask_path} is {mask.shape[1]} x {mask.shape[0]} pixels and the photos are {camera.width} x "
            f"{camera.height}; the same shape was needed. Correct it, or leave it out with --mask none."
        )
    return mask


def calibrate_source(source: Source, pictures: Pictures, options: RunOptions) -> Calibration:
    """The given calibration of a scene; else from the photos, with the lights from a file where --lights names one.

    Raises:
        CalibrationError, CaptureError: the board, the ground or the lights cannot be found, or the file lacks a light.
    """
    calibration = _calibrated(source, pictures, options)
    calibration = with_ground(calibration, options.ground, source.ground_is_known(options))
    return with_light_error(calibration, options.light_error)


def with_light_error(calibration: Calibration, relative: float) -> Calibration:
    """Every light at least so uncertain, in any direction: `relative` of its distance from where the camera looks at
    the ground, or radians for a directional light."""
    if relative == 0:
        return calibration
    middle, lights = calibration.posed_camera.looked_at(), []
    for light in calibration.lights:
        distance = 1.0 if light.position is None else float(np.linalg.norm(light.position - middle))
        lights.append(replace(light, sigma=np.maximum(light.sigma, relative * distance / np.sqrt(3))))
    return replace(calibration, lights=tuple(lights))


def _calibrated(source: Source, pictures: Pictures, options: RunOptions) -> Calibration:
    if source.known is not None:
        if options.lights in WAYS:
            return source.known.with_notes()
        return scene_with_file(source.known, pictures.stack, Path(options.lights))
    assert source.session is not None and pictures.stack is not None
    if options.lights in WAYS:
        return calibrate(source.session, pictures.stack, options.board, options.lights, pictures.findings)
    named = (Path(options.lights), options.board)
    return calibrate_with_file(source.session, pictures.stack, *named, pictures.findings)


def check_ground(option: str) -> None:
    """Refuse a --ground that is neither one of WORDS nor a height.

    Raises:
        CalibrationError: naming the option.
    """
    if option not in WORDS:
        _height(option)


def with_ground(calibration: Calibration, option: str, is_known: bool) -> Calibration:
    """The calibration with the ground that `option` asks for.

    Args:
        option: "auto", "unknown", or the world z of the ground.
        is_known: whether there is a ground then; if not, calibration.ground_height is only where the surface is
            assumed, and the result says so.

    Raises:
        CalibrationError: the camera or a light in use is not above the ground.
    """
    if option not in WORDS:
        calibration = replace(calibration, ground_height=_height(option))
        _check_above(calibration, option)
    if is_known:
        return calibration
    away = calibration.world_from_camera.translation[2] - calibration.ground_height
    unit = "" if calibration.unit == "scene" else f" {calibration.unit}"
    note = f"ground: unknown; the surface is assumed to lie about {away:.4g}{unit} below the camera"
    warning = (
        "The ground is unknown: the scale of the result is an assumption, and slow changes of depth over the picture "
        "may be wrong, most of all under distant lights. Give the ground's height with --ground if you can."
    )
    residuals = calibration.residuals
    lists = {key: [*residuals.get(key, []), text] for key, text in (("notes", note), ("warnings", warning))}
    return replace(calibration, residuals=residuals | lists)


def _height(option: str) -> float:
    try:
        height = float(option)
    except ValueError:
        height = np.nan
    if not np.isfinite(height):
        raise CalibrationError(
            f"--ground {option} is no height; auto, unknown, or the world z of the ground was needed."
        )
    return height


def _check_above(calibration: Calibration, option: str) -> None:
    eye = float(calibration.world_from_camera.translation[2])
    used = [light for light in calibration.lights if light.used and light.position is not None]
    lights = [(float(np.asarray(light.position)[2]), f"the light of {light.photo}") for light in used]
    lowest, name = min([(eye, "the camera"), *lights])
    if lowest <= float(option):
        raise CalibrationError(
            f"--ground {option}: {name} stands at z = {lowest:.4g}, above the ground was needed. Give a lower one."
        )
