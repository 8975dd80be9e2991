"""A result file is there and whole, or not there."""

import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

READABLE = 0o644
TEMPORARY = ".part"  # in the name of every unfinished file


@contextmanager
def atomic_file(path: Path, keep: Path | None = None) -> Iterator[Path]:
    """A temporary path beside `path`, same suffix: it becomes `path` when the block ends well, else it is removed.

    File and folder are flushed to the disk: after a power cut, too, there is the old content or the new one.

    Args:
        keep: where the old content goes, in the same folder; for a moment only that name exists, and never neither.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{TEMPORARY}{path.suffix}")
    try:
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.chmod(READABLE)  # some writers (safetensors) make files that only their owner can read
        if keep is not None and path.exists():
            os.replace(path, keep)
        os.replace(temporary, path)
        flush_folder(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """An empty folder beside `path`: it becomes `path` when the block ends well, else it is removed with all in it.

    Args:
        path: not there yet, or an empty folder.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", suffix=TEMPORARY, dir=path.parent) as place:
        draft = Path(place) / path.name
        draft.mkdir()
        yield draft
        if path.exists():
            path.rmdir()  # of an empty one only
        os.replace(draft, path)
        flush_folder(path.parent)


def flush_folder(folder: Path) -> None:
    """Have the names in a folder survive a power cut; where a system cannot open folders, they do so anyway."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)


def parse_json(text: str) -> Any:
    """What a JSON text says.

    Raises:
        ValueError: it is not JSON, or nested deeper than any file of ours.
    """
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


def read_json(path: Path) -> Any:
    """What a JSON file holds.

    Raises:
        OSError: it cannot be read. ValueError: as `parse_json`.
    """
    return parse_json(path.read_text(encoding="utf-8"))


def write_json(path: Path, value: Any) -> None:
    """JSON by `atomic_file`, indented, keys in the given order."""
    with atomic_file(path) as temporary:
        temporary.write_text(json.dumps(value, indent=1, allow_nan=False) + "\n", encoding="utf-8")
