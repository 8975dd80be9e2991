"""export: write a finished run in one of FORMATS, the table of export formats, one row each."""

import importlib.util
import shutil
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from capture.errors import ReconstructionError
from capture.files.atomic import atomic_file, atomic_folder
from capture.files.title import file_stem
from reconstruct.stored_run.stored_run import MESH, StoredRun

UNIT_WORDS = {"mm": "mm", "scene": "units of the scene"}
MEGABYTE = 1e6

OnProgress = Callable[[int, int, str], None]  # done, total, what is being done


@dataclass(frozen=True)
class Format:
    """One row of FORMATS: a kind of file, and the function that writes it."""

    title: str  # for people who do not know the format's name
    about: str  # in one sentence
    suffix: str  # with its dot
    writer: str  # "module:function", a reconstruct.export.export.Writer; imported when it is used
    others: tuple[str, ...] = ()  # further suffixes that the same writer supports; "" of a folder
    ending: str = ""  # of the file's name before the suffix, where formats share a suffix
    takes: tuple[str, ...] = ()  # names of the ExportOptions that change the file


ABOUT = {  # title and sentence of each, the usual ones first
    "glb": ("For the web and Blender (GLB)", "A light mesh with its colours and fine relief in pictures; metres."),
    "3mf": ("For 3D printing (3MF)", "A closed solid in millimetres that stands on its base."),
    "html": ("A page to send to somebody", "One file: the light follows the pointer, no server is needed."),
    "turntable": ("A video of the object turning", "One full turn on even ground, softly lit; it loops."),
    "orbit": ("A video of the light going around", "From where the photos were taken; it loops."),
    "still": ("A picture of it (PNG)", "On even ground, softly lit."),
    "usdz": ("For iPhone and iPad (USDZ)", "To put on a table by augmented reality."),
    "stl": ("For older 3D printers (STL)", "A closed solid; numbers are millimetres."),
    "obj": ("For older programs (OBJ)", "A light mesh with two pictures, in millimetres."),
    "ply": ("Every detail (PLY)", "The full mesh, a colour per vertex, what is known of each place."),
    "off": ("For geometry software (OFF)", "Corners and triangles as text."),
    "normal-png": ("Normals (16-bit PNG)", "Which way each pixel faces, with a file that says how to read it."),
    "depth-png": ("Depth (16-bit PNG)", "How far each pixel is, with a file that says how to read it."),
    "normal-exr": ("Normals (EXR)", "Which way each pixel faces, as exact numbers."),
    "shadowneus": ("ShadowNeuS", "Photos, camera, lights, ground."),
    "rti": ("RTI (relight, OpenLIME)", "Photos, .lp, .dome."),
    "colmap": ("COLMAP (text)", "Camera, photos, points."),
    "nerf": ("NeRF (transforms)", "Photos, camera, light."),
    "depth-exr": ("Depth (EXR)", "How far each pixel is, as exact numbers."),
}
_FACES, _PRINTED, _SKINNED = ("faces",), ("faces", "print_size"), ("faces", "texture")
_LOOK, _MOVES = ("width", "lamp_size"), ("width", "frames", "lamp_size")
_MESH, _MAPS = "reconstruct.export.meshes", "reconstruct.export.maps"
_FILM, _DATA = "reconstruct.export.relit", "reconstruct.export.datasets"
_VIDEO, _FOLDER = (".webm", ".gif"), ("",)
_ROWS: dict[str, tuple] = {  # the fields of a Format from its suffix on
    "glb": (".glb", f"{_MESH}:glb", (), "", _SKINNED),
    "3mf": (".3mf", f"{_MESH}:threemf", (), "", _PRINTED),
    "html": (".html", ""),  # its writer is set in viewer/stage/page.py, where the page is made
    "turntable": (".mp4", f"{_FILM}:turn", _VIDEO, "_turn", _MOVES),
    "orbit": (".mp4", f"{_FILM}:orbit", _VIDEO, "_light", _MOVES),
    "still": (".png", f"{_FILM}:still", (), "", _LOOK),
    "usdz": (".usdz", f"{_MESH}:usdz", (), "", _SKINNED),
    "stl": (".stl", f"{_MESH}:plain", (), "", _PRINTED),
    "obj": (".obj", f"{_MESH}:obj", (), "", _SKINNED),
    "ply": (".ply", f"{_MESH}:plain", (), "", _FACES),
    "off": (".off", f"{_MESH}:plain", (), "", _FACES),
    "normal-png": (".png", f"{_MAPS}:normals", (), "_normals"),
    "depth-png": (".png", f"{_MAPS}:depth", (), "_depth"),
    "normal-exr": (".exr", f"{_MAPS}:normals", (), "_normals"),
    "shadowneus": (".zip", f"{_DATA}:shadowneus", _FOLDER, "_shadowneus"),
    "rti": (".zip", f"{_DATA}:rti", _FOLDER, "_rti"),
    "colmap": (".zip", f"{_DATA}:colmap", _FOLDER, "_colmap"),
    "nerf": (".zip", f"{_DATA}:nerf", _FOLDER, "_nerf"),
    "depth-exr": (".exr", f"{_MAPS}:depth", (), "_depth"),
}
FORMATS = {name: Format(*ABOUT[name], *row) for name, row in _ROWS.items()}


@dataclass(frozen=True)
class ExportOptions:
    """Options of an export; each format uses only some of them."""

    faces: int | None = None  # triangles to reduce the mesh to; None: the format's default
    texture: int | None = None  # px, both sides; None: chosen from the surface's resolution, or from its detail
    width: int | None = None  # px, of pictures and videos; None: the format's default
    frames: int = 120  # of a turn: four seconds
    lamp_size: float | None = None  # radius of a lamp in pictures, world length; None: chosen for the scene
    photos: Path | None = None  # folder of the capture, whose photos a dataset then holds; None: the surface is relit
    print_size: float | None = None  # mm: longest side of a solid to print; None: as large as the object


@dataclass(frozen=True)
class Contents:
    """Countable contents of a file; None: does not apply."""

    faces: int | None = None
    extents: tuple[float, float, float] | None = None  # along the world's x, y, z
    unit: str = "mm"  # of the extents: "mm" | "scene"
    is_closed: bool | None = None
    pixels: tuple[int, int] | None = None  # width, height
    frames: int | None = None
    note: str = ""  # further facts: units and axes of the file, range of values

    def sentence(self) -> str:
        """Return the contents as a readable sentence."""
        parts = []
        if self.extents is not None:
            parts.append(" x ".join(f"{e:.1f}" if self.unit == "mm" else f"{e:.4g}" for e in self.extents))
            parts[-1] += f" {UNIT_WORDS[self.unit]}"
        if self.faces is not None:
            parts.append(f"{self.faces:,} triangles")
        if self.is_closed is not None:
            parts.append("closed" if self.is_closed else "not closed")
        if self.pixels is not None:
            parts.append(f"{self.pixels[0]} x {self.pixels[1]} pixels")
        if self.frames is not None:
            parts.append(f"{self.frames} frames")
        return ", ".join([*parts, self.note] if self.note else parts)


@dataclass(frozen=True)
class FinishedExport:
    """A finished export."""

    path: Path
    companions: tuple[Path, ...]  # other files that belong to it, in the same folder
    size_bytes: int  # of all of them
    contents: Contents

    def sentence(self) -> str:
        """Return a sentence about the export."""
        others = "".join(f" and {path.name}" for path in self.companions)
        return f"{self.path}{others}: {self.about()}"

    def about(self) -> str:
        """Return size and contents in words."""
        return f"{self.size_bytes / MEGABYTE:.2f} MB, {self.contents.sentence()}"


def as_one_file(written: FinishedExport) -> Path:
    """Return the file of an export, or a zip of it and its companions, written beside them."""
    if not written.companions:
        return written.path
    archive = written.path.with_name(f"{written.path.stem}.zip")
    with atomic_file(archive) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as packed:
        for path in (written.path, *written.companions):
            packed.write(path, path.name)
    return archive


Writer = Callable[[StoredRun, Path, ExportOptions, OnProgress], Contents]  # to this path; other files go beside it


def format_for(file: Path | None, name: str | None) -> str:
    """Return the key in FORMATS of a name, or else of the first format with the file's ending.

    Raises:
        ReconstructionError: there is none.
    """
    if name is not None and name in FORMATS:
        return name
    suffix = "" if file is None else file.suffix.lower()
    for candidate, row in FORMATS.items():
        if name is None and suffix and suffix in (row.suffix, *row.others):
            return candidate
    asked = f"'{name}'" if name is not None else f"'{suffix}'" if file is not None else "no format"
    raise ReconstructionError(f"{asked} was asked for; one of {', '.join(FORMATS)} was needed (--format).")


def default_file(run_dir: Path, name: str) -> Path:
    """Return a format's default file, RUN/exports/TITLE.suffix; videos are .webm if .mp4 cannot be written."""
    row = FORMATS[name]
    suffix = ".webm" if row.suffix == ".mp4" and importlib.util.find_spec("av") is None else row.suffix
    return StoredRun(run_dir).exports() / f"{file_stem(run_dir)}{row.ending}{suffix}"


def export(
    run_dir: Path,
    name: str,
    file: Path | None = None,
    options: ExportOptions | None = None,
    on_progress: OnProgress = lambda done, total, message: None,
) -> FinishedExport:
    """Write a finished run in one of FORMATS; whole, or not at all.

    Args:
        name: in FORMATS.
        file: with the format's suffix; default_file unless given.
        on_progress: callback (done, total, message).

    Raises:
        ReconstructionError: the run is not finished, or the file cannot be written there.
    """
    row = FORMATS[name]
    target = default_file(run_dir, name) if file is None else file
    if target.suffix.lower() not in (row.suffix, *row.others):
        endings = " or ".join(ending or "nothing (a folder)" for ending in (row.suffix, *row.others))
        raise ReconstructionError(f"{target}: a file of format {name} ends in {endings}. Name it so.")
    module, function = row.writer.split(":")
    writer: Writer = getattr(importlib.import_module(module), function)
    chosen = options or ExportOptions()
    return save(run_dir, target, lambda run, draft: writer(run, draft, chosen, on_progress))


def save(run_dir: Path, target: Path, write: Callable[[StoredRun, Path], Contents]) -> FinishedExport:
    """Write a file or folder made from a finished run, whole or not at all.

    Args:
        target: its folder must exist, unless it is inside the run's folder.
        write: writes to a draft in an empty folder, with companion files beside it.

    Raises:
        ReconstructionError: the run is not finished, the folder does not exist, or the target is a folder that is not
            empty; also errors of `write`.
    """
    run = StoredRun(run_dir)
    if not (run_dir / MESH).exists():
        raise ReconstructionError(f"{run_dir / MESH} is not there; the folder of a finished run was needed.")
    if target.parent != run.exports() and not target.parent.is_dir():
        raise ReconstructionError(
            f"{target.parent} is not a folder; {target.name} was to be written there. Make it first."
        )
    if not target.suffix and target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise ReconstructionError(f"{target} exists and is not empty; a new folder was needed. Name another one.")
    with tempfile.TemporaryDirectory() as place:
        draft = Path(place) / target.name
        contents = write(run, draft)
        if draft.is_dir():
            with atomic_folder(target) as folder:
                shutil.copytree(draft, folder, dirs_exist_ok=True)
            size = sum(part.stat().st_size for part in target.rglob("*") if part.is_file())
            return FinishedExport(target, (), size, contents)
        parts = sorted(path for path in Path(place).iterdir() if path != draft)
        for part in [*parts, draft]:  # the main file last: if it exists, so do the others
            with atomic_file(target.parent / part.name) as temporary:
                shutil.copyfile(part, temporary)
        size = sum(part.stat().st_size for part in [*parts, draft])
    return FinishedExport(target, tuple(target.parent / part.name for part in parts), size, contents)
