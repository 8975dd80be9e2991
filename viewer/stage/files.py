"""The stage of a run as files of a server: the page, its parts beside it, and its document, which can be kept."""

import tempfile
import threading
from dataclasses import dataclass
from pathlib import Path

from capture.errors import ReconstructionError, UserError
from capture.files.regular import read_regular
from capture.files.title import title_of
from reconstruct.stored_run.stage_document import read_stage_document, save_stage_document
from reconstruct.stored_run.stage_pack import StagePack
from reconstruct.stored_run.stored_run import FIELDS, MESH
from viewer.stage.pack_file import BINARY, is_finished, kind_of, stage_pack, stored_stage

PAGE, DOCUMENT = ("", "index.html"), "stage.json"
SHARED = "share.html"  # the page in one file, to send
SAVE = "save/"  # and the name of a format: the run as a file of that kind
HTML, ZIP = "text/html; charset=utf-8", "application/zip"
LARGEST_SAVED = 1 << 30  # bytes
SAFE_HEADERS = {  # of every answer of a server of ours
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
}
HEADERS = SAFE_HEADERS | {  # a page of the same server may show the stage in a frame
    "X-Frame-Options": "SAMEORIGIN",
    "Cache-Control": "no-cache",
}


@dataclass(frozen=True)
class StageFile:
    """A file to send, with its media type."""

    content: bytes
    kind: str


class StageFiles:
    """The stage of one run folder. It can be asked from any thread; what the run has not packed is packed when asked.

    A server asks `get` for GET requests below the page's address, sends HEADERS with them, and hands the document that
    comes back to `save`.
    """

    def __init__(self, run_dir: Path, saves: str = "", home: str = "", spare: Path | None = None):
        """Read nothing yet.

        Args:
            saves: how the page sends its document: "socket" (WebSocket stage.json), "frame" (a message to the page
                around it: this one has no origin, and all its parts in it); "": it cannot.
            home: address of the page that leads here, for a link back; "": none.
            spare: a file that may hold the packed stage of a run whose folder has none.
        """
        self.run_dir, self._saves, self._home, self._spare = run_dir, saves, home, spare
        self._lock = threading.Lock()
        self._saving, self._saved = threading.Lock(), (("",), StageFile(b"", HTML))  # made of what, and the newest
        self._pack: StagePack | None = None
        self._made_of: tuple[tuple[int, int], ...] = ()

    @property
    def is_ready(self) -> bool:
        """Whether the run has left what the stage shows."""
        return is_finished(self.run_dir)

    def get(self, name: str) -> StageFile | None:
        """Return the file of this name, "" for the page, SHARED for one with all parts in it; None where there is none.

        Raises:
            UserError: the run is not finished, or a file of it cannot be used.
        """
        if name.startswith(SAVE) and self._saves:
            return self._saved_as(name.removeprefix(SAVE))
        with self._lock:
            pack = self._current(makes=True)
            assert pack is not None
            if name in (*PAGE, SHARED):
                from viewer.stage.page import page_html

                document, how = read_stage_document(self.run_dir), {"saves": self._saves, "home": self._home}
                page = page_html(title_of(self.run_dir), pack, document, **({} if name == SHARED else how))
                return StageFile(page.encode(), HTML)
            return StageFile(pack.read(name), kind_of(name)) if name in pack.names else None

    def _saved_as(self, kind: str) -> StageFile | None:
        """Return the run as a file of a format, made once for as long as run and notes are the same."""
        from reconstruct.export.export import as_one_file, default_file, export
        from reconstruct.export.formats import FORMATS

        if kind not in FORMATS or not self.is_ready:
            return None
        with self._saving, tempfile.TemporaryDirectory() as folder:
            paths = [self.run_dir / name for name in (MESH, FIELDS, DOCUMENT)]
            made_of = (kind, *(str(path.stat().st_mtime_ns) for path in paths if path.exists()))
            if made_of != self._saved[0]:
                file = as_one_file(export(self.run_dir, kind, Path(folder) / default_file(self.run_dir, kind).name))
                found = StageFile(read_regular(file, LARGEST_SAVED), ZIP if file.suffix == ".zip" else BINARY)
                self._saved = made_of, found
            return self._saved[1]

    def is_packed(self) -> bool:
        """Return whether `get` answers at once.

        Raises:
            UserError: the run is not finished.
        """
        with self._lock:
            return self._current(makes=False) is not None

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

    def _current(self, makes: bool) -> StagePack | None:
        """Return the stage of the run as it is on the disk now; where it is not packed, make it or return None."""
        if not self.is_ready:
            self._pack, self._made_of = None, ()
            stored_stage(self.run_dir)  # which says so
        files = [(self.run_dir / name).stat() for name in (MESH, FIELDS)]
        made_of = tuple((file.st_mtime_ns, file.st_size) for file in files)
        if self._pack is None or made_of != self._made_of:
            pack = stored_stage(self.run_dir, self._spare)
            self._pack = stage_pack(self.run_dir) if pack is None and makes else pack
            self._made_of = made_of
        return self._pack
