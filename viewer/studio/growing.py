"""Growing: a picture of a run under way, made again as it goes on: its photos first, then the surface as it grows."""

import time
from concurrent.futures import Future
from hashlib import sha256
from pathlib import Path
from typing import Any

from capture.files.regular import is_own_folder, is_regular
from reconstruct.stored_run.maps import THUMBS
from viewer.display.run_follower import PREVIEW
from viewer.studio.folder import StudioFolder
from viewer.studio.helper import Helper

PAUSE_S = 4.0  # between two pictures of a run: each takes some tenths of a CPU second


class Growing:
    """The newest picture of each run that somebody watches."""

    def __init__(self, folder: StudioFolder, helper: Helper):
        """Make nothing yet."""
        self._folder, self._helper = folder, helper
        self._made: dict[Path, tuple[str, float]] = {}  # by run: what the picture was made of, and when by our clock
        self._pending: dict[Path, tuple[Future[Any], str]] = {}

    def picture(self, key: str) -> Path | None:
        """Return the newest picture of a run, and ask for the next one; None where there is none yet.

        Raises:
            CaptureError: there is no such run.
        """
        run = self._folder.run(key)
        out = self._folder.kept / "pictures" / f"growing-{sha256(str(run).encode()).hexdigest()[:24]}.jpg"
        pending = self._pending.get(run)
        if pending is not None and pending[0].done():
            self._made[run] = (pending[1], time.monotonic())
            self._pending.pop(run, None)  # another request may have been here
            pending = None
        mark = mark_of(run)
        before, when = self._made.get(run, ("", 0.0))
        if mark and pending is None and mark != before and time.monotonic() - when > PAUSE_S:
            self._pending[run] = (self._helper.ask("growing", run=str(run), out=str(out)), mark)
        return out if run in self._made and is_regular(out) else None


def mark_of(run: Path) -> str:
    """Return a text that changes with what a picture of a run under way shows; "" where there is nothing to show."""
    try:
        if is_regular(run / PREVIEW):
            stat = (run / PREVIEW).stat()
            return f"surface {stat.st_mtime_ns} {stat.st_size}"
        if is_own_folder(run / THUMBS):
            return f"photos {(run / THUMBS).stat().st_mtime_ns}"
    except OSError:
        pass
    return ""
