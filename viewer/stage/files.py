"""The stage of a run as files of a server: the page, its parts beside it, and its document, which can be kept."""

import threading
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from capture.errors import ReconstructionError, UserError
from reconstruct.stored_run.stage_document import save_stage_document
from reconstruct.stored_run.stored_run import FIELDS, MESH, StoredRun

if TYPE_CHECKING:  # torch takes seconds to import, and a page that follows a run needs none of it
    from viewer.stage.parts import StageParts

PAGE, DOCUMENT = ("", "index.html"), "stage.json"
HTML = "text/html; charset=utf-8"
HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "SAMEORIGIN",  # a page of the same server may show it in a frame
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-cache",
}


@dataclass(frozen=True)
class StageFile:
    """A file to send, with its media type."""

    content: bytes
    kind: str


class StageFiles:
    """The stage of one run folder. It can be asked from any thread; the scene is packed at the first request.

    A server asks `get` for GET requests below the page's address, sends HEADERS with them, and hands the body of
    PUT stage.json to `save`.
    """

    def __init__(self, run_dir: Path, saves: str = "put", home: str = ""):
        """Read nothing yet.

        Args:
            saves: how the page sends its document: "put" (HTTP), "socket" (WebSocket stage.json); "": it cannot.
            home: address of the page that leads here, for a link back; "": none.
        """
        self.run_dir, self._saves, self._home = run_dir, saves, home
        self._lock = threading.Lock()
        self._parts: StageParts | None = None
        self._made_of: tuple[tuple[int, int], ...] = ()

    @property
    def is_ready(self) -> bool:
        """Whether the run has left what the stage shows."""
        return all((self.run_dir / name).is_file() for name in (MESH, FIELDS))

    def get(self, name: str) -> StageFile | None:
        """Return the file of this name, "" for the page; None where there is none of it.

        Raises:
            UserError: the run is not finished, or a file of it cannot be used.
        """
        with self._lock:
            parts = self._current()
            from viewer.stage.page import page_html

            if name in PAGE:
                facts = parts.facts({part: part for part in parts.names()})
                return StageFile(page_html(parts.run, facts, self._saves, self._home).encode(), HTML)
            return StageFile(parts.get(name), parts.kind(name)) if name in parts.names() else None

    def save(self, content: bytes) -> None:
        """Keep the page's document with the run, whole or not at all.

        Raises:
            UserError: it is none, or the run's folder cannot be written; the sentence says which.
        """
        if not self._saves:
            raise ReconstructionError("this page cannot keep notes: it was opened for reading only.")
        try:
            with self._lock:
                save_stage_document(self.run_dir, content)
        except OSError as error:
            reason = error.strerror or str(error)
            raise ReconstructionError(f"{self.run_dir / DOCUMENT} cannot be written ({reason}).") from error

    def warm(self) -> None:
        """Pack the scene now, so that the first visitor does not wait for it; does nothing before the run is over."""
        try:
            if self.is_ready:
                self.get("")
        except UserError:
            return  # the visitor gets the sentence

    def _current(self) -> "StageParts":
        """Return the parts of the run as it is on the disk now."""
        if not self.is_ready:
            raise ReconstructionError(f"{self.run_dir} holds no finished run yet: its picture comes with the mesh.")
        from viewer.stage.parts import StageParts

        files = [(self.run_dir / name).stat() for name in (MESH, FIELDS)]
        made_of = tuple((file.st_mtime_ns, file.st_size) for file in files)
        if self._parts is None or made_of != self._made_of:
            self._parts, self._made_of = StageParts(StoredRun(self.run_dir)), made_of
        return self._parts
