"""export: writes a finished run in one of FORMATS and opens what it wrote again."""

import importlib
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from capture.errors import ReconstructionError
from capture.files.atomic import atomic_file
from reconstruct.export.formats import FORMATS

if TYPE_CHECKING:
    import trimesh

    from calibration.calibration import Calibration
    from reconstruct.detail.file import Detail
    from reconstruct.fields import Fields

EXPORTS = "exports"  # folder in a run's, for what is saved without a place of its own
UNIT_WORDS = {"mm": "mm", "scene": "units of the scene"}
MEGABYTE = 1e6

Tell = Callable[[int, int, str], None]  # done, total, what is being done


@dataclass(frozen=True)
class ExportOptions:
    """What can be chosen; a format takes what concerns it."""

    faces: int | None = None  # triangles to reduce the mesh to; None: what suits the format
    texture: int | None = None  # px, both sides; None: what suits the surface, or the detail that was read for it
    width: int | None = None  # px, of pictures and videos; None: what suits the format
    frames: int = 120  # of a turn: four seconds
    lamp_size: float | None = None  # radius of a lamp in pictures, world length; None: what suits the scene
    photos: Path | None = None  # folder of the capture, whose photos a dataset then holds; None: the surface is relit


@dataclass(frozen=True)
class Contents:
    """What a file holds, as far as it can be counted; None: that does not apply."""

    faces: int | None = None
    extents: tuple[float, float, float] | None = None  # along the world's x, y, z, in the world's unit
    is_closed: bool | None = None
    pixels: tuple[int, int] | None = None  # width, height
    frames: int | None = None
    note: str = ""  # what else is worth knowing: units and axes of the file, range of values

    def sentence(self, unit: str) -> str:
        """In words, for people.

        Args:
            unit: of the run, "mm" | "scene".
        """
        parts = []
        if self.extents is not None:
            parts.append(" x ".join(f"{e:.1f}" if unit == "mm" else f"{e:.4g}" for e in self.extents))
            parts[-1] += f" {UNIT_WORDS[unit]}"
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
class Written:
    """A finished export."""

    path: Path
    companions: tuple[Path, ...]  # other files that belong to it, in the same folder
    size_bytes: int  # of all of them
    contents: Contents
    unit: str  # "mm" | "scene"

    def sentence(self) -> str:
        """What was written, as read back from the file."""
        others = "".join(f" and {path.name}" for path in self.companions)
        return f"{self.path}{others}: {self.about()}"

    def about(self) -> str:
        """Size and contents."""
        return f"{self.size_bytes / MEGABYTE:.2f} MB, {self.contents.sentence(self.unit)}"


class FinishedRun:
    """A run's results, each read when it is first asked for.

    Raises:
        ReconstructionError, CalibrationError: the file that is asked for is not there, or damaged.
    """

    def __init__(self, run_dir: Path):
        """Nothing is read yet."""
        self.run_dir = run_dir

    @property
    def name(self) -> str:
        """Of the run's folder."""
        return self.run_dir.resolve().name

    @property
    def unit(self) -> str:
        """Of lengths in this run: "mm" | "scene"."""
        return self.fields.unit

    @cached_property
    def fields(self) -> "Fields":
        """The solved scene."""
        from reconstruct.fields import load_fields

        return load_fields(self.run_dir / "fields.safetensors")

    @cached_property
    def detail(self) -> "Detail | None":
        """Normals and albedo at the photos' own resolution, if they were read on this surface."""
        from reconstruct.detail.file import DETAIL, load_detail

        return load_detail(self.run_dir / DETAIL, self.fields)

    @cached_property
    def calibration(self) -> "Calibration":
        """Camera, ground and lights."""
        from calibration.calibration import load_calibration

        return load_calibration(self.run_dir / "calibration.json")

    @cached_property
    def mesh(self) -> "trimesh.Trimesh":
        """mesh.ply: world frame, sRGB colours and normals per vertex."""
        import trimesh

        try:
            mesh = trimesh.load_mesh(self.run_dir / "mesh.ply", process=False)
        except (ValueError, IndexError, KeyError) as error:  # what trimesh raises for a damaged PLY
            raise ReconstructionError(f"{self.run_dir / 'mesh.ply'} is damaged ({error}); run again.") from error
        if not len(mesh.faces):
            raise ReconstructionError(f"{self.run_dir / 'mesh.ply'} holds no triangles; run again.")
        return mesh


Writer = Callable[[FinishedRun, Path, ExportOptions, Tell], None]  # to this path; other files go beside it
Reader = Callable[[FinishedRun, Path], Contents]  # raises ReconstructionError where the file is not what it should be


def format_for(file: Path | None, name: str | None) -> str:
    """The row of FORMATS that is meant: by its name, or else the first one with the file's ending.

    Raises:
        ReconstructionError: there is none.
    """
    if name is not None and name in FORMATS:
        return name
    suffix = "" if file is None else file.suffix.lower()
    for candidate, row in FORMATS.items():
        if name is None and suffix in (row.suffix, *row.others):
            return candidate
    asked = f"'{name}'" if name is not None else f"'{suffix}'" if file is not None else "no format"
    raise ReconstructionError(f"{asked} was asked for; one of {', '.join(FORMATS)} was needed (--format).")


def default_file(run_dir: Path, name: str) -> Path:
    """Where a format goes unless a file is named: RUN/exports/RUN.suffix; videos in .webm where .mp4 is impossible."""
    from reconstruct.export.video import can_write_mp4

    row = FORMATS[name]
    suffix = ".webm" if row.suffix == ".mp4" and not can_write_mp4() else row.suffix
    return run_dir / EXPORTS / f"{run_dir.resolve().name}{row.ending}{suffix}"


def export(
    run_dir: Path,
    name: str,
    file: Path | None = None,
    options: ExportOptions | None = None,
    tell: Tell = lambda done, total, message: None,
) -> Written:
    """Write a finished run in one of FORMATS; whole, or not at all; then read it back.

    Args:
        name: in FORMATS.
        file: with the format's suffix; default_file unless given.
        tell: called with n of m while it goes on.

    Raises:
        ReconstructionError: the run is not finished, the file cannot be written there, or does not read back.
    """
    row = FORMATS[name]
    target = default_file(run_dir, name) if file is None else file
    if target.suffix.lower() not in (row.suffix, *row.others):
        endings = " or ".join((row.suffix, *row.others))
        raise ReconstructionError(f"{target}: a file of format {name} ends in {endings}. Name it so.")
    writer, chosen = _imported(row.writer), options or ExportOptions()
    return save(run_dir, target, lambda run, draft: writer(run, draft, chosen, tell), _imported(row.reader))


def save(run_dir: Path, target: Path, write: Callable[[FinishedRun, Path], None], read: "Reader") -> Written:
    """Write something made of a finished run; whole, or not at all; then read it back.

    Args:
        target: its folder must be there, unless it is in the run's own.
        write: to a draft in an empty folder; other files that belong to it go beside it.

    Raises:
        ReconstructionError: the run is not finished, or there is no such folder; and what write and read raise.
    """
    run = FinishedRun(run_dir)
    if not (run_dir / "mesh.ply").is_file():
        raise ReconstructionError(f"{run_dir / 'mesh.ply'} is not there; the folder of a finished run was needed.")
    if target.parent != run_dir / EXPORTS and not target.parent.is_dir():
        raise ReconstructionError(
            f"{target.parent} is not a folder; {target.name} was to be written there. Make it first."
        )
    with tempfile.TemporaryDirectory() as place:
        draft = Path(place) / target.name
        write(run, draft)
        contents = read(run, draft)
        parts = sorted(path for path in Path(place).iterdir() if path != draft)
        for part in [*parts, draft]:  # the main file last: where it is, the others are
            with atomic_file(target.parent / part.name) as temporary:
                shutil.copyfile(part, temporary)
        size = sum(part.stat().st_size for part in [*parts, draft])
    return Written(target, tuple(target.parent / part.name for part in parts), size, contents, run.unit)


def _imported(reference: str) -> Any:
    """The function of "module:function"."""
    module, function = reference.split(":")
    return getattr(importlib.import_module(module), function)
