"""Saving: finished runs as other kinds of files, made by helper processes, kept until the studio starts anew.

Videos take minutes: they have a process of their own, so that other files are made meanwhile.
"""

import contextlib
import shutil
from concurrent.futures import Future
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

from capture.errors import CaptureError
from capture.files.regular import is_own_folder, is_regular
from capture.files.title import TITLE, title_of
from viewer.report.formats import FORMATS
from viewer.studio.folder import StudioFolder
from viewer.studio.helper import Helper

MADE_OF = ("mesh.ply", "fields.safetensors", "detail.safetensors", "stage.json", TITLE)  # what an export shows
LONGEST_SIZE = 12  # letters of a number


@dataclass(frozen=True)
class Asked:
    """A file that somebody asked for: of which run, which kind and size, and the task that makes it."""

    key: str
    name: str
    size: str
    helper: Helper
    future: Future[Any]


class Saving:
    """The files that were made for download, in a folder each."""

    def __init__(self, folder: StudioFolder):
        """Make nothing yet."""
        self._folder = folder
        self._files, self._films = Helper(folder.kept / "saved.txt"), Helper(folder.kept / "films.txt")
        self._place = folder.kept / "saved"
        self._asked: dict[Path, Asked] = {}

    def close(self) -> None:
        """End the helpers."""
        self._files.close()
        self._films.close()

    def formats(self) -> list[dict[str, Any]]:
        """Return the kinds of files in the words of the page, the usual ones first."""
        rows = FORMATS.items()
        return [{"name": n, "title": r.title, "about": r.about, "sized": "print_size" in r.takes} for n, r in rows]

    def ask(self, key: str, name: str, size: str) -> dict[str, Any]:
        """Return the file made of a run as it is now, and begin to make it where it is not there yet.

        Args:
            size: longest side of a solid to print, mm; "" for the object's own.

        Returns:
            `file`, its name, "" while it is made; `about`, what it holds, in words; `share` that is done, null where
            that is not known.

        Raises:
            CaptureError: there is no such run or format, or it could not be made; the sentence says why.
        """
        return self._answer(key, name, size)[1]

    def file(self, key: str, name: str, size: str) -> Path:
        """Return a file that was made.

        Raises:
            CaptureError: it was not made, or the run has changed since.
        """
        out, found = self._answer(key, name, size)
        if not found["file"]:
            raise CaptureError("This file is still being made.")
        return out / found["file"]

    def asked(self, key: str) -> list[dict[str, Any]]:
        """Return the files asked for of a run as it is now: as `ask`, with `name`, `size`, `title` and `error`."""
        rows = []
        for out, one in list(self._asked.items()):
            if one.key != key or self._request(key, one.name, one.size)[0] != out:
                continue
            error = one.future.exception() if one.future.done() else None
            if one.future.done() and error is None and not is_regular(out / one.future.result()["file"]):
                continue  # removed with the trash
            found = _waiting(one) if error or not one.future.done() else one.future.result() | {"share": 1.0}
            known = {"name": one.name, "size": one.size, "title": FORMATS[one.name].title}
            rows.append(known | found | {"error": str(error or "")})
        return rows

    def forget(self, key: str, name: str, size: str) -> None:
        """Cancel a file that is being made, or remove one that was made."""
        out, _ = self._request(key, name, size)
        one = self._asked.pop(out, None)
        if one is not None:
            one.helper.cancel(one.future)
            one.future.add_done_callback(lambda _: shutil.rmtree(out, ignore_errors=True))

    def _answer(self, key: str, name: str, size: str) -> tuple[Path, dict[str, Any]]:
        out, arguments = self._request(key, name, size)
        one = self._asked.get(out)
        if one is not None and one.future.done() and one.future.exception() is not None:
            self._asked.pop(out, None)  # asked anew, it is tried again
            raise CaptureError(str(one.future.exception()))
        if one is not None and one.future.done() and not is_regular(out / one.future.result()["file"]):
            one = None  # removed with the trash
        if one is None:
            helper = self._films if "frames" in FORMATS[name].takes else self._files
            one = self._asked[out] = Asked(key, name, size, helper, helper.ask("save", **arguments))
        return out, one.future.result() | {"share": 1.0} if one.future.done() else _waiting(one)

    def clear(self) -> None:
        """Remove what was made; each can be made again."""
        if is_own_folder(self._place):
            for place in self._place.iterdir():
                if all(one.future.done() for out, one in self._asked.items() if out == place):
                    shutil.rmtree(place, ignore_errors=True)

    def _request(self, key: str, name: str, size: str) -> tuple[Path, dict[str, Any]]:
        """Return the folder for a file, whose name changes with what it is made of, and the task that makes it."""
        run = self._finished(key)
        if name not in FORMATS:
            raise CaptureError(f"{name!r:.40} is no kind of file that can be made.")
        longest = _number(size) if "print_size" in FORMATS[name].takes else None
        marks = [f"{run} {name} {longest}"]
        for part in MADE_OF:
            with contextlib.suppress(OSError):
                stat = (run / part).stat()
                marks.append(f"{part} {stat.st_size} {stat.st_mtime_ns}")
        out = self._place / sha256("\n".join(marks).encode()).hexdigest()[:24]
        return out, {"run": str(run), "name": name, "out": str(out), "print_size": longest}

    def _finished(self, key: str) -> Path:
        """Return the folder of a finished run.

        Raises:
            CaptureError: there is none, or it has no result.
        """
        run = self._folder.run(key)
        if not is_regular(run / "mesh.ply"):
            raise CaptureError(f"{title_of(run)} has no result yet that could be saved.")
        return run


def _waiting(one: Asked) -> dict[str, Any]:
    return {"file": "", "about": "", "share": one.helper.share(one.future)}


def _number(size: str) -> float | None:
    if not size.strip():
        return None
    try:
        return float(size[:LONGEST_SIZE].replace(",", "."))
    except ValueError as error:
        raise CaptureError(f"{size!r:.20} is no number of millimetres.") from error
