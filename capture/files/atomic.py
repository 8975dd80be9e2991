"""Write files and folders atomically: a result is complete or absent."""

import json
import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from capture.files.regular import read_regular

READABLE = 0o644
TEMPORARY = ".part"  # in the name of every unfinished file
_HALF_LETTER = re.compile(r"\\u[dD][89a-fA-F]")  # in JSON: fine if its other half follows


@contextmanager
def atomic_file(path: Path, keep: Path | None = None) -> Iterator[Path]:
    """Yield a temporary path beside `path`, with its suffix; rename it to `path` if the block succeeds, else remove it.

    File and folder are flushed to the disk, so that even after a power cut either the old or the new content exists.

    Args:
        keep: new name of the old content, in the same folder. For a moment only this name exists; one always does.

    Raises:
        OSError: the file cannot be written or renamed.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{TEMPORARY}{path.suffix}")
    if temporary.is_symlink():  # it would lead the writer elsewhere
        temporary.unlink()
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
    """Yield an empty folder beside `path`; rename it to `path` if the block succeeds, else remove it and its content.

    Args:
        path: absent, or an empty folder.

    Raises:
        OSError: the folder cannot be written or renamed.
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
    """Flush a folder's names to the disk, so that they survive a power cut, on systems that can open folders."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)


def parse_json(text: str) -> Any:
    """Parse JSON text.

    Raises:
        ValueError: it is not JSON, nested too deeply, or holds half of a letter, which nothing can write again.
    """
    try:
        found = json.loads(text)
        if _HALF_LETTER.search(text):
            json.dumps(found, ensure_ascii=False).encode()
        return found
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


def read_json(path: Path) -> Any:
    """Read a JSON file, which may be a stranger's.

    Raises:
        OSError: as `open_regular`.
        ValueError: as `parse_json`.
    """
    return parse_json(read_regular(path).decode("utf-8"))


def write_json(path: Path, value: Any) -> None:
    """Write JSON atomically, indented, with the keys in the given order.

    Raises:
        OSError: the file cannot be written.
        ValueError: a number is not finite.
    """
    with atomic_file(path) as temporary:
        temporary.write_text(json.dumps(value, indent=1, allow_nan=False) + "\n", encoding="utf-8")
