"""A whole run, stage by stage: photos on disk to calibration, surface, mesh and maps in a run folder."""

import platform
from dataclasses import asdict, dataclass, fields
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from PIL import Image

from calibration.known import KnownScene, is_known_scene, load_known_scene
from calibration.result import Calibration, load_calibration, save_calibration
from capture.atomic import atomic_file
from capture.checks import Finding, check_stack
from capture.errors import CaptureError, ReconstructionError
from capture.photo import PhotoStack, read_alpha, read_grey, read_stack, read_thumbnail
from capture.run_folder import LOG, RunFolder, content_hash, read_log
from capture.session import Session, load_session

if TYPE_CHECKING:
    from reconstruct.fields import Fields
    from reconstruct.grid import SdfGrid
    from reconstruct.solver import Report

CALIBRATION_LONG_SIDE = 800  # px: checks and light fit average over patches of ground, finer photos add nothing
THUMBNAIL_LONG_SIDE = 320  # px: what a browser panel shows
THUMBNAIL_QUALITY = 88  # JPEG: artefacts do not show at this size
EXPORTS = ("ply", "glb", "obj", "stl", "off")
CALIBRATION_OPTIONS = ("board", "input", "lights", "split")
NAMES = ("shadowgraph", "numpy", "torch", "numba", "opencv-contrib-python-headless", "trimesh", "viser")


@dataclass(frozen=True)
class RunOptions:
    """Every setting of a run that changes its result."""

    board: str | None = None
    input: str = "auto"
    lights: str = "auto"
    preset: str = "standard"
    device: str = "auto"
    time_budget: float | None = None
    seed: int = 0
    split: str = "train"


@dataclass(frozen=True)
class Source:
    """What a folder turned out to be: a session of plain photos, or a scene whose calibration is given."""

    folder: Path
    session: Session | None = None
    known: KnownScene | None = None

    def files(self) -> list[Path]:
        """Every file whose content decides the result."""
        if self.session is not None:
            settings = self.folder / "session.toml"
            photos = (*self.session.board, *self.session.lit, *self.session.light, *self.session.dark)
            return [*([settings] if settings.is_file() else []), *photos]
        assert self.known is not None
        mask = [self.known.mask_path] if self.known.mask_path else []
        texts = sorted(self.folder.glob("*.json"))
        return [*texts, *(self.known.rgb_paths or ()), *(self.known.shadow_paths or ()), *mask]

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


def open_source(folder: Path, options: RunOptions) -> Source:
    """Find out what a folder holds; reads names and headers only.

    Raises:
        CaptureError, CalibrationError: no such folder, or nothing in it that a run can start from.
    """
    if not folder.is_dir():
        raise CaptureError(f"{folder} is not a folder; a folder with photos was needed.")
    if is_known_scene(folder):
        source = Source(folder, known=load_known_scene(folder, options.split))
    else:
        source = Source(folder, session=load_session(folder))
    _check_input(source, options)
    return source


def _check_input(source: Source, options: RunOptions) -> None:
    """Refuse an --input that is not there."""
    has_shadow = source.known is not None and source.known.shadow_paths is not None
    has_rgb = source.known is None or source.known.rgb_paths is not None
    if (options.input == "shadow" and not has_shadow) or (options.input == "rgb" and not has_rgb):
        raise CaptureError(
            f"{source.folder} holds no {'shadow pictures' if options.input == 'shadow' else 'colour photos'}, which "
            f"--input {options.input} needs. Leave --input out to use what is there."
        )


def read_pictures(source: Source, options: RunOptions) -> Pictures:
    """Read and check the photos, or the given shadow pictures where they are asked for or all there is."""
    if source.known is None:
        stack = read_stack(source.photos(), CALIBRATION_LONG_SIDE)
        return Pictures(stack, tuple(check_stack(stack)))
    known = source.known
    wants_shadow = options.input == "shadow" or known.rgb_paths is None
    mask = read_alpha(known.mask_path) if known.mask_path else None
    if wants_shadow and known.shadow_paths:
        return Pictures(None, shadow=np.stack([read_grey(path) for path in known.shadow_paths]), mask=mask)
    assert known.rgb_paths is not None
    return Pictures(read_stack(known.rgb_paths, CALIBRATION_LONG_SIDE), mask=mask)


def run_calibration(source: Source, options: RunOptions, run: RunFolder) -> tuple[Calibration, Pictures | None]:
    """Stages "capture" and "calibrate"; an earlier result is read back, then no pictures are."""
    if run.is_finished("calibrate"):
        return load_calibration(run.file("calibration.json")), None
    with run.stage("capture", f"reading {len(source.photos())} photos"):
        pictures = read_pictures(source, options)
        _write_thumbnails(source.photos(), run)
    with run.stage("calibrate", "finding camera, ground and lights"):
        if source.known is not None:
            calibration = source.known.calibration
        else:
            from calibration.calibrate import calibrate

            assert source.session is not None and pictures.stack is not None
            calibration = calibrate(
                source.session, pictures.stack, options.board, options.lights, list(pictures.findings)
            )
        save_calibration(calibration, run.file("calibration.json"))
    return calibration, pictures


def run_reconstruction(
    source: Source, options: RunOptions, run: RunFolder, calibration: Calibration, pictures: Pictures | None
) -> None:
    """Stages "solve" and "mesh": everything else a run leaves, except the page of the report."""
    from reconstruct.fields import load_fields, save_fields
    from reconstruct.mesh import extract_mesh, save_mesh
    from reconstruct.presets import preset
    from reconstruct.scene import build_scene
    from reconstruct.solver import fit

    long_side, config = preset(options.preset, options.seed)
    if not run.is_finished("solve"):
        if pictures is None:
            with run.stage("capture", f"reading {len(source.photos())} photos"):
                pictures = read_pictures(source, options)
        with run.stage("solve", "fitting the surface"):
            scene = build_scene(pictures.stack, calibration, long_side, pictures.shadow, pictures.mask)
            solved = fit(scene, config, _reporter(run, scene.ground_height), run.file("checkpoint.safetensors"))
            save_fields(solved, run.file("fields.safetensors"))
    fields = load_fields(run.file("fields.safetensors"))
    with run.stage("mesh", "extracting the mesh"):
        mesh = extract_mesh(fields)
        save_mesh(mesh, run.file("mesh.ply"), run.file("mesh.glb"), fields.unit)
        _write_maps(fields, calibration, run)
    size = {"size": mesh.extents.tolist(), "faces": len(mesh.faces), "vertices": len(mesh.vertices)}
    run.write_json("report.json", report(source, options, run, calibration) | {"mesh": size | {"closed": True}})


def _reporter(run: RunFolder, ground_height: float) -> "Report":
    """Tells a run folder what `fit` reports: the log, and now and then a coarse mesh to look at."""
    from reconstruct.mesh import preview_mesh

    def tell(
        *, stage: str, done: int, total: int, message: str, numbers: dict[str, float], surface: "SdfGrid | None"
    ) -> None:
        losses = {f"loss_{name}": value for name, value in numbers.items()}
        mesh = None if surface is None else preview_mesh(surface, ground_height)
        run.progress(stage, done, total, message, losses, mesh)

    return tell


def claim(source: Source, options: RunOptions, run: RunFolder, stages: str, force: bool) -> None:
    """Tie the run folder to this capture and these options.

    Args:
        stages: "run", "calibrate" or "reconstruct": `calibrate` says nothing yet about the solver's options.
        force: start again; after `reconstruct` only the reconstruction.
    """
    names = [f.name for f in fields(options) if stages != "calibrate" or f.name in CALIBRATION_OPTIONS]
    if force and stages == "reconstruct":
        run.forget("solve", "mesh")
        names = [name for name in names if name in CALIBRATION_OPTIONS]
        force = False
    run.claim(content_hash(source.files()), {name: getattr(options, name) for name in names}, force)


def run_stages(source: Source, options: RunOptions, run: RunFolder, stages: str) -> None:
    """Do what "run", "calibrate" or "reconstruct" asks for, from where an earlier invocation stopped."""
    if stages == "reconstruct" and not run.is_finished("calibrate"):
        raise CaptureError(
            f"{run.path} holds no finished calibration, which `reconstruct` starts from. "
            f"Run `shadowgraph calibrate {source.folder} --out {run.path}` first."
        )
    calibration, pictures = run_calibration(source, options, run)
    if stages != "calibrate":
        run_reconstruction(source, options, run, calibration, pictures)


def export_mesh(run_dir: Path, file: Path) -> None:
    """The mesh of a run in the format that the file's name asks for; world frame and unit, .glb as the run left it.

    Raises:
        ReconstructionError: the run has no mesh, or the format is not known.
    """
    import trimesh

    kind = file.suffix.lower().removeprefix(".")
    source = run_dir / ("mesh.glb" if kind == "glb" else "mesh.ply")
    if not source.is_file():
        raise ReconstructionError(f"{source} is not there; the folder of a finished run was needed.")
    if kind not in EXPORTS:
        raise ReconstructionError(f"{file}: '.{kind}' is not a mesh format; one of {', '.join(EXPORTS)} was needed.")
    with atomic_file(file) as temporary:
        if kind in ("ply", "glb"):
            temporary.write_bytes(source.read_bytes())
        else:
            data = trimesh.load_mesh(source, process=False).export(file_type=kind)
            temporary.write_bytes(data if isinstance(data, bytes) else str(data).encode())


def report(source: Source, options: RunOptions, run: RunFolder, calibration: Calibration) -> dict[str, Any]:
    """What report.json says: costs, photos used and dropped, residuals, versions."""
    lights = {light.photo: light for light in calibration.lights}
    return {
        "format": 1,
        "capture": source.folder.name,
        "unit": calibration.unit,
        **asdict(options),
        "stages": {name: asdict(cost) for name, cost in run.costs.items()},
        "photos": [
            {"name": p.name, "role": "lit", "used": lights[p.name].used, "reason": lights[p.name].reason}
            for p in source.photos()
            if p.name in lights
        ],
        "calibration": plain(calibration.residuals),
        "fit": _last_numbers(run),
        "versions": {"python": platform.python_version()} | versions(),
    }


def versions() -> dict[str, str]:
    """The installed versions of the packages that decide a result."""
    found = {}
    for name in NAMES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue  # run from a checkout: the project itself is not installed
    return found


def plain(value: Any) -> Any:
    """A value as JSON can hold it: arrays become lists, and numbers that are not finite become null."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def _last_numbers(run: RunFolder) -> dict[str, float]:
    """The last numbers that the solver logged."""
    lines = [line for line in read_log(run.file(LOG)) if line["stage"] == "solve" and line["numbers"]]
    return lines[-1]["numbers"] if lines else {}


def _write_thumbnails(photos: tuple[Path, ...], run: RunFolder) -> None:
    """thumbs/*.jpg: small sRGB copies for page and report."""
    for photo in photos:
        with run.writing(f"thumbs/{photo.stem}.jpg") as path:
            Image.fromarray(read_thumbnail(photo, THUMBNAIL_LONG_SIDE)).save(path, quality=THUMBNAIL_QUALITY)


def _write_maps(fields: "Fields", calibration: Calibration, run: RunFolder) -> None:
    """depth.npy, normal.npy, mask.png of the object, on the grid of the input photos."""
    from reconstruct.view import surface_maps

    maps = surface_maps(fields.grid, fields.ground_height, calibration.camera, calibration.world_from_camera)
    mask = maps.mask.numpy()
    with run.writing("depth.npy") as path:
        np.save(path, np.where(mask, maps.depth.numpy(), np.inf).astype(np.float32))
    with run.writing("normal.npy") as path:
        np.save(path, np.where(mask[..., None], maps.normals.numpy(), 0).astype(np.float32))
    with run.writing("mask.png") as path:
        Image.fromarray(np.where(mask, 255, 0).astype(np.uint8)).save(path)
