"""The stage of a run as files of a server: the page, the run as other kinds of files, and its document to be kept."""

import tempfile
import threading
from pathlib import Path

from capture.errors import UserError
from capture.files.regular import read_regular
from reconstruct.export.export import FORMATS, as_one_file, default_file, export
from reconstruct.stored_run.stage_document import STAGE
from reconstruct.stored_run.stage_pack import StagePack
from reconstruct.stored_run.stored_run import FIELDS, MESH
from viewer.stage.page import is_finished, page_of, stage_pack

SAVE = "save/"  # and the name of a format: the run as a file of that kind
HTML, ZIP, BINARY = "text/html; charset=utf-8", "application/zip", "application/octet-stream"
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


class StageFiles:
    """The stage of one run folder, served beside viser's page. It can be asked from any thread.

    A server asks `get` for GET requests below the page's address, sends HEADERS with them, and hands the document that
    comes back to `save_stage_document`.
    """

    def __init__(self, run_dir: Path):
        """Read nothing yet."""
        self.run_dir = run_dir
        self._lock, self._saving = threading.Lock(), threading.Lock()
        self._pack: StagePack | None = None
        self._saved: tuple[tuple[str, ...], tuple[bytes, str]] = ((), (b"", HTML))  # made of what, and the newest

    def get(self, name: str) -> tuple[bytes, str] | None:
        """Return the file of this name, "" for the page, and its media type; None where there is none.

        Raises:
            UserError: the run is not finished, or a file of it cannot be used.
        """
        if name.startswith(SAVE):
            return self._saved_as(name.removeprefix(SAVE))
        if name:
            return None
        with self._lock:
            self._pack = stage_pack(self.run_dir, self._pack)
        return page_of(self.run_dir, self._pack, "socket", "/").encode(), HTML

    def _saved_as(self, kind: str) -> tuple[bytes, str] | None:
        """Return the run as a file of a format, made once for as long as run and notes are the same."""
        if kind not in FORMATS or not is_finished(self.run_dir):
            return None
        with self._saving, tempfile.TemporaryDirectory() as folder:
            paths = [self.run_dir / name for name in (MESH, FIELDS, STAGE)]
            made_of = (kind, *(str(path.stat().st_mtime_ns) for path in paths if path.exists()))
            if made_of != self._saved[0]:
                file = as_one_file(export(self.run_dir, kind, Path(folder) / default_file(self.run_dir, kind).name))
                content = read_regular(file, LARGEST_SAVED)
                self._saved = made_of, (content, ZIP if file.suffix == ".zip" else BINARY)
            return self._saved[1]

    def warm(self) -> None:
        """Pack the scene now, so that the first visitor does not wait for it; does nothing before the run is over."""
        try:
            if is_finished(self.run_dir):
                self.get("")
        except UserError:
            return  # the visitor gets the sentence
