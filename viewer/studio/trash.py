"""What was deleted: moved aside within the studio's folder, put back on request, gone once the trash is emptied."""

import os
import secrets
import shutil
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from capture.errors import CaptureError, UserError
from capture.files.atomic import read_json, write_json
from capture.files.schema import Count, FileName, Number, Text, as_type
from viewer.studio.folder import KEPT

NOTE = "note.json"


@dataclass(frozen=True)
class Deleted:
    """One thing in the trash."""

    id: FileName
    key: Text  # where it was, relative to the studio's folder
    title: Text
    when: Number  # seconds since 1970
    bytes: Count


class Trash:
    """The trash of a studio's folder: each thing lies in a folder of its own with a note of where it was."""

    def __init__(self, root: Path):
        """Make the folder for it."""
        self._root, self._folder = root, root / KEPT / "trash"
        self._folder.mkdir(exist_ok=True)

    def put(self, path: Path, title: str) -> Deleted:
        """Move a file or folder below the studio's folder into the trash.

        Raises:
            OSError: it cannot be moved.
        """
        id_ = secrets.token_hex(8)
        place = self._folder / id_
        place.mkdir()
        size = sum(file.lstat().st_size for file in ([path] if path.is_file() else path.rglob("*")))
        deleted = Deleted(id_, path.relative_to(self._root).as_posix(), title, time.time(), size)
        write_json(place / NOTE, asdict(deleted))
        os.replace(path, place / path.name)
        return deleted

    def list(self) -> list[Deleted]:
        """Return what is in it, the newest first."""
        found = [_read(place / NOTE) for place in self._folder.iterdir() if place.is_dir()]
        return sorted((one for one in found if one is not None), key=lambda one: -one.when)

    def restore(self, id_: str) -> str:
        """Put one thing back where it was, and return its key.

        Raises:
            CaptureError: it is not there any more, or something else took its place.
        """
        deleted = next((one for one in self.list() if one.id == id_), None)
        if deleted is None:
            raise CaptureError("This is no longer in the trash.")
        target = (self._root / deleted.key).resolve()
        if not target.is_relative_to(self._root) or target.exists():
            raise CaptureError(f"{deleted.key} exists again; rename or delete that one first.")
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(self._folder / id_ / target.name, target)
        shutil.rmtree(self._folder / id_, ignore_errors=True)
        return deleted.key

    def empty(self) -> int:
        """Delete all that is in it; return the bytes that this freed."""
        freed = sum(one.bytes for one in self.list())
        for place in self._folder.iterdir():
            shutil.rmtree(place, ignore_errors=True)
        return freed


def _read(path: Path) -> Deleted | None:
    try:
        return as_type(read_json(path), Deleted, str(path))
    except (OSError, ValueError, UserError):
        return None
