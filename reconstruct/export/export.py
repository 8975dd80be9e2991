"""export: write a finished run in one of FORMATS."""

import importlib
import shutil
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from capture.errors import ReconstructionError
from capture.files.atomic import atomic_file, atomic_folder
from capture.files.title import file_stem
from reconstruct.export.formats import FORMATS
from reconstruct.stored_run.stored_run import MESH, StoredRun

UNIT_WORDS = {"mm": "mm", "scene": "units of the scene"}
MEGABYTE = 1e6

OnProgress = Callable[[int, int, str], None]  # done, total, what is being done


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
    from reconstruct.export.video import can_write_mp4

    row = FORMATS[name]
    suffix = ".webm" if row.suffix == ".mp4" and not can_write_mp4() else row.suffix
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
