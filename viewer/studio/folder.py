"""StudioFolder: the folder of a studio, what it keeps there, and the paths that it may touch.

What was deleted: moved aside within the studio's folder, put back on request, gone once the trash is emptied.
"""

import contextlib
import os
import secrets
import shutil
import time
from collections.abc import Collection
from dataclasses import asdict, dataclass
from hashlib import sha256
from itertools import count
from pathlib import Path

from capture.errors import CaptureError, UserError
from capture.files.atomic import write_json
from capture.files.names import is_shown
from capture.files.regular import is_own_folder
from capture.files.schema import Count, FileName, Number, Text, read_kept
from capture.files.title import as_name, keep_title
from reconstruct.run.batch import looks_like_capture
from reconstruct.run_folder.folder import LOG
from reconstruct.stored_run.documents import MANIFEST

KEPT, CAPTURES, RUNS = ".studio", "captures", "runs"
ADDRESS, ADDED = "address.json", "added.json"
TOKEN_BYTES = 24
PRIVATE = 0o700
MOST_LOOKED_INTO = 50  # folders, to find out whether a folder is one for a studio
MOST_FOLDERS = 2_000  # that are looked at
DEEPEST = 4  # levels below the folder at which a person may choose one
NOTE = "note.json"


class StudioFolder:
    """A folder with captures and runs. Every path that a browser names is looked up here, never built from its text."""

    def __init__(self, root: Path):
        """Make the folder if there is none.

        Raises:
            UserError: it cannot be made or written to.
        """
        self.root = root.resolve()
        self.kept = self.root / KEPT
        try:
            self.root.mkdir(parents=True, exist_ok=True)
            self.kept.mkdir(mode=PRIVATE, exist_ok=True)
        except OSError as error:
            raise UserError(
                f"{root} cannot be made or written to ({error.strerror}); a folder for captures and runs was needed."
            ) from error
        if not is_own_folder(self.kept):
            raise UserError(f"{self.kept} is a link or a file, a folder was needed. Move it away.")

    @staticmethod
    def look_into(root: Path) -> bool:
        """Return whether a folder holds captures or runs, or is one; nothing is made."""
        if is_run(root) or is_capture(root):
            return True
        places = [place for place in (root, root / CAPTURES, root / RUNS) if place.is_dir()]
        folders = [path for place in places for path in sorted(place.iterdir())[:MOST_LOOKED_INTO] if path.is_dir()]
        return any(not path.name.startswith(".") and (is_run(path) or is_capture(path)) for path in folders)

    def token(self) -> str:
        """Return the secret of the address; it stays the same, so that an open page survives a restart."""
        path = self.kept / "token.json"
        token = str((read_kept(path, dict) or {}).get("token", ""))
        if len(token) < TOKEN_BYTES:
            token = secrets.token_urlsafe(TOKEN_BYTES)
            write_json(path, {"token": token})
        return token

    # --- what is there -----------------------------------------------------------------------------------------------

    def captures(self) -> dict[str, Path]:
        """Return the captures by their keys: paths relative to the folder."""
        own = [path for path in self._folders(self.root / CAPTURES) if not is_run(path)]
        others = [path for path in self._folders(self.root) if path.name not in (CAPTURES, RUNS) and not is_run(path)]
        found = [*own, *(path for path in others if is_capture(path)), *self._added()]
        return {self.key(path): path for path in found}

    def runs(self) -> dict[str, Path]:
        """Return the run folders by their keys."""
        found = [path for path in (*self._folders(self.root / RUNS), *self._folders(self.root)) if is_run(path)]
        return {self.key(path): path for path in found}

    def capture(self, key: str) -> Path:
        """Return the capture with this key.

        Raises:
            CaptureError: there is none.
        """
        return _found(key, self.captures(), "capture", self.runs(), "run")

    def run(self, key: str) -> Path:
        """Return the run with this key.

        Raises:
            CaptureError: there is none.
        """
        return _found(key, self.runs(), "run", self.captures(), "capture")

    def key(self, path: Path) -> str:
        """Return the path of a capture or run relative to the folder."""
        return path.relative_to(self.root).as_posix()

    def new_capture(self, title: str) -> Path:
        """Make an empty capture with this title, in a folder that is named after it.

        Raises:
            CaptureError: the title has no letter.
        """
        capture = _unused(self.root / CAPTURES / as_name(title, "capture").replace(" ", "-"))
        capture.mkdir(parents=True)
        keep_title(capture, title)
        return capture

    def new_run(self, capture: Path, preset: str, taken: set[str]) -> Path:
        """Return a folder for a new run of a capture, which does not exist yet; names in `taken` are promised."""
        return _unused(self.root / RUNS / f"{capture.name}-{preset}", taken)

    # --- folders that a person adds ----------------------------------------------------------------------------------

    def browse(self, key: str) -> list[tuple[str, bool]]:
        """Return the sub-folders of a folder below the studio's, as keys, and whether each looks like a capture.

        Raises:
            CaptureError: it is not below the studio's folder.
        """
        folder = self._below(key)
        return [(self.key(path), is_capture(path)) for path in self._folders(folder)]

    def add(self, key: str) -> str:
        """Add a capture that lies deeper; return its key.

        Raises:
            CaptureError: it is none, or not below the studio's folder.
        """
        path = self._below(key)
        if path == self.root or not is_capture(path):
            raise CaptureError(f"{key[:80]!r} holds no photos, no clip, no photos/; a capture was needed.")
        if self.key(path) not in self.captures():
            write_json(self.kept / ADDED, [*self._keys_added(), self.key(path)])
        return self.key(path)

    def _below(self, key: str) -> Path:
        path, names = self.root, Path(key).parts
        if len(names) > DEEPEST:
            raise CaptureError(f"{key[:80]!r} lies more than {DEEPEST} levels below {self.root}. Move it up.")
        for name in names:
            found = {folder.name: folder for folder in self._folders(path)}
            if name not in found:
                raise CaptureError(f"{key[:80]!r} is no folder below {self.root}; only those can be chosen.")
            path = found[name]
        return path

    def _added(self) -> list[Path]:
        keys = self._keys_added()
        return [path for key in keys if (path := self.root / key).is_dir() and path.resolve().is_relative_to(self.root)]

    def _keys_added(self) -> list[str]:
        return [key for key in read_kept(self.kept / ADDED, list) or [] if isinstance(key, str)]

    def _folders(self, place: Path) -> list[Path]:
        """Return the folders in a place that are not hidden and do not lead outside, at most MOST_FOLDERS."""
        try:
            found = sorted(path for path in place.iterdir() if is_shown(path) and path.is_dir())
        except OSError:
            return []
        return [path for path in found[:MOST_FOLDERS] if path.resolve().is_relative_to(self.root)]


def mark_of(*paths: Path) -> str:
    """Return a name that changes with the sizes and times of these files; "" where none is there."""
    rows = []
    for path in paths:
        with contextlib.suppress(OSError):
            stat = path.stat()
            rows.append(f"{path} {stat.st_size} {stat.st_mtime_ns}")
    return sha256("\n".join(rows).encode("utf-8", "surrogateescape")).hexdigest()[:24] if rows else ""


def without_folder(text: str, folder: Path, called: str = "this folder") -> str:
    """Return a sentence with the names of files without this folder: where it lies is the studio's machine's alone."""
    return text.replace(f"{folder}{os.sep}", "").replace(str(folder), called)


def is_run(folder: Path) -> bool:
    """Return whether a folder holds a run, by its names."""
    return (folder / MANIFEST).is_file() or (folder / LOG).is_file()


def is_capture(folder: Path) -> bool:
    """Return whether a folder looks like a capture and can be read."""
    try:
        return looks_like_capture(folder)
    except (OSError, UserError):
        return False


def _found(key: str, places: dict[str, Path], kind: str, others: dict[str, Path], other: str) -> Path:
    if key in places:
        return places[key]
    is_what = f"a {other}, a {kind} was needed" if key in others else f"no {kind} here; it was moved or deleted"
    raise CaptureError(f"{key[:80]!r} is {is_what}. Go back to all captures.")


def _unused(path: Path, taken: Collection[str] = ()) -> Path:
    """Return this path, or with the first number from 2 behind it, that is not there and whose name is not taken."""
    places = (path if number == 1 else path.with_name(f"{path.name}-{number}") for number in count(1))
    return next(place for place in places if place.name not in taken and not os.path.lexists(place))


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
        found = [read_kept(place / NOTE, Deleted) for place in self._folder.iterdir() if place.is_dir()]
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
