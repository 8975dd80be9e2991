"""Saving: finished runs as other kinds of files, made by a helper process, kept until the studio starts anew."""

import contextlib
import shutil
from concurrent.futures import Future
from hashlib import sha256
from pathlib import Path
from typing import Any

from capture.errors import CaptureError
from capture.files.regular import is_own_folder, is_regular
from viewer.report.formats import FORMATS
from viewer.studio.folder import StudioFolder
from viewer.studio.helper import Helper

MADE_OF = ("mesh.ply", "fields.safetensors", "detail.safetensors", "stage.json")  # what an export shows
LONGEST_SIZE = 12  # letters of a number


class Saving:
    """The files that were made for download, in a folder each."""

    def __init__(self, folder: StudioFolder, helper: Helper):
        """Make nothing yet."""
        self._folder, self._helper = folder, helper
        self._place = folder.kept / "saved"
        self._asked: dict[Path, Future[Any]] = {}

    def formats(self) -> list[dict[str, Any]]:
        """Return the kinds of files in the words of the page, the usual ones first."""
        rows = FORMATS.items()
        return [{"name": n, "title": r.title, "about": r.about, "sized": "print_size" in r.takes} for n, r in rows]

    def ask(self, key: str, name: str, size: str) -> dict[str, Any]:
        """Return the file made of a run as it is now, and begin to make it where it is not there yet.

        Args:
            size: longest side of a solid to print, mm; "" for the object's own.

        Returns:
            `file`, its name, "" while it is made; `about`, what it holds, in words.

        Raises:
            CaptureError: there is no such run or format, or it could not be made; the sentence says why.
        """
        out, arguments = self._request(key, name, size)
        future = self._asked.get(out)
        if future is None:
            future = self._asked[out] = self._helper.ask("save", **arguments)
        if not future.done():
            return {"file": "", "about": ""}
        if future.exception() is not None:
            self._asked.pop(out, None)  # asked anew, it is tried again
            raise CaptureError(str(future.exception()))
        if not is_regular(out / future.result()["file"]):  # removed with the trash
            self._asked.pop(out, None)
            return self.ask(key, name, size)
        return future.result()

    def file(self, key: str, name: str, size: str) -> Path:
        """Return a file that was made.

        Raises:
            CaptureError: it was not made, or the run has changed since.
        """
        found = self.ask(key, name, size)
        if not found["file"]:
            raise CaptureError("This file is still being made.")
        return self._request(key, name, size)[0] / found["file"]

    def clear(self) -> None:
        """Remove what was made; each can be made again."""
        if is_own_folder(self._place):
            for place in self._place.iterdir():
                if all(future.done() for out, future in self._asked.items() if out == place):
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
            raise CaptureError(f"{run.name} has no result yet that could be saved.")
        return run


def _number(size: str) -> float | None:
    if not size.strip():
        return None
    try:
        return float(size[:LONGEST_SIZE].replace(",", "."))
    except ValueError as error:
        raise CaptureError(f"{size!r:.20} is no number of millimetres.") from error
