"""Saving: finished runs as other kinds of files, made by helper processes, kept until the studio starts anew.

Videos take minutes: they have a process of their own, so that other files are made meanwhile.
"""

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from capture.errors import CaptureError
from capture.files.regular import is_own_folder, is_regular
from capture.files.title import TITLE, title_of
from viewer.stage.page import FORMATS
from viewer.studio.folder import StudioFolder, mark_of
from viewer.studio.helper import Helper, Task

MADE_OF = ("mesh.ply", "fields.safetensors", "detail.safetensors", "stage.json", TITLE)  # what an export shows
LONGEST_SIZE = 12  # letters of a number


@dataclass(frozen=True)
class Asked:
    """A file that somebody asked for: of which run, which kind and size, and the task that makes it in a folder."""

    key: str
    name: str
    size: str
    out: Path
    helper: Helper
    task: Task

    def row(self) -> dict[str, Any] | None:
        """Return what has become of it, see `Saving.asked`; None: it was removed with the trash."""
        row = {"name": self.name, "size": self.size, "title": FORMATS[self.name].title, "error": "", "file": ""}
        if not self.task.done():
            return row | {"about": "", "share": self.task.share}
        if error := self.task.exception():
            return row | {"about": "", "share": None, "error": str(error)}
        made = self.task.result()
        return row | made | {"share": 1.0} if is_regular(self.out / made["file"]) else None


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

    def ask(self, key: str, name: str, size: str) -> None:
        """Begin to make a file of a run as it is now, where it is not there or being made.

        Args:
            size: longest side of a solid to print, mm; "" for the object's own.

        Raises:
            CaptureError: there is no such run or format.
        """
        out, arguments = self._request(key, name, size)
        one = self._asked.get(out)
        if one is None or (row := one.row()) is None or row["error"]:
            helper = self._films if "frames" in FORMATS[name].takes else self._files
            self._asked[out] = Asked(key, name, size, out, helper, helper.ask("save", **arguments))

    def file(self, key: str, name: str, size: str) -> Path:
        """Return a file that was made.

        Raises:
            CaptureError: it was not made, or the run has changed since.
        """
        out, _ = self._request(key, name, size)
        one = self._asked.get(out)
        if one is None or (row := one.row()) is None or not row["file"]:
            raise CaptureError("This file is not there. Make it first.")
        return out / row["file"]

    def asked(self, key: str) -> list[dict[str, Any]]:
        """Return the files asked for of a run as it is now.

        Each has `name`, `size` and `title`; `file`, its name, "" while it is made; `about`, what it holds, in words;
        `share` that is done, null where that is not known; `error`, why it could not be made.
        """
        now = [one for one in list(self._asked.values()) if one.key == key]
        now = [one for one in now if self._request(key, one.name, one.size)[0] == one.out]
        return [row for one in now if (row := one.row()) is not None]

    def forget(self, key: str, name: str, size: str) -> None:
        """Cancel a file that is being made, or remove one that was made."""
        out, _ = self._request(key, name, size)
        one = self._asked.pop(out, None)
        if one is not None:
            one.helper.cancel(one.task)
            one.task.add_done_callback(lambda _: shutil.rmtree(out, ignore_errors=True))

    def clear(self) -> None:
        """Remove what was made; each can be made again."""
        if is_own_folder(self._place):
            for place in self._place.iterdir():
                if place not in self._asked or self._asked[place].task.done():
                    shutil.rmtree(place, ignore_errors=True)

    def _request(self, key: str, name: str, size: str) -> tuple[Path, dict[str, Any]]:
        """Return the folder for a file, whose name changes with what it is made of, and the task that makes it."""
        run = self._folder.run(key)
        if not is_regular(run / "mesh.ply"):
            raise CaptureError(f"{title_of(run)} has no result yet that could be saved.")
        if name not in FORMATS:
            raise CaptureError(f"{name!r:.40} is no kind of file that can be made.")
        longest = _number(size) if "print_size" in FORMATS[name].takes else None
        out = self._place / f"{name}-{longest}-{mark_of(*(run / part for part in MADE_OF))}"
        return out, {"run": str(run), "name": name, "out": str(out), "print_size": longest}


def _number(size: str) -> float | None:
    if not size.strip():
        return None
    try:
        return float(size[:LONGEST_SIZE].replace(",", "."))
    except ValueError as error:
        raise CaptureError(f"{size!r:.20} is no number of millimetres.") from error
