"""RunFollower: what a run folder holds at any moment. Only what has changed is read again."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from capture.errors import UserError
from capture.files.regular import is_own_folder
from reconstruct.run_folder.folder import LOG, read_log
from reconstruct.run_folder.forecast import STAGE_NAMES, Forecast
from reconstruct.run_folder.lock import LOCK, lock_holder
from reconstruct.run_folder.requests import PAUSED, REQUESTS_FOLDER
from reconstruct.stored_run.maps import THUMBS, read_thumbnail
from reconstruct.stored_run.stored_run import CALIBRATION

FIT_WORDS = {
    "loss_shadow": ("Shadows", "How far computed shadows are from those in the photos."),
    "loss_mask": ("Outline", "How far the surface's outline is from the object's in the photos."),
    "loss_normal": ("Shading", "How far the surface's slopes are from those that its shading shows."),
    "loss_held_out": ("Unseen shadows", "The same as Shadows, for shadow rays that the fit has never used."),
    "loss_colour": ("Colour", "How far computed colours are from those in the photos."),
}

HULL, PREVIEW = "hull.ply", "preview.ply"
SHOWN = (LOG, LOCK, CALIBRATION, PREVIEW, HULL, THUMBS, REQUESTS_FOLDER)  # on a page


@dataclass(frozen=True)
class Status:
    """The state of a run, as the page shows it."""

    title: str
    message: str = ""
    share: float | None = None  # of the whole run, in [0, 1]; None = unknown
    counts: str = ""  # of the stage, "34 of 120"
    left_s: float | None = None  # until the end of the run
    elapsed_s: float = 0.0
    is_over: bool = False  # no more is coming
    is_finished: bool = False  # and the result is complete


@dataclass
class RunFollower:
    """Watches the files of one run folder. Nothing here fails because files are missing."""

    path: Path
    _seen: dict[str, tuple[int, int, int]] = field(default_factory=dict)
    _lines: list[dict[str, Any]] = field(default_factory=list)  # of the log
    _read: tuple[int, int, int] | None = None  # the mark of the log when it was read
    _marks: tuple[tuple[int, int, int] | None, ...] = ()

    def changed(self, name: str) -> bool:
        """Return whether `name` exists and is another file than at the last call for it."""
        mark = self._mark(name)
        if mark is None:
            return False
        is_new = self._seen.get(name) != mark
        self._seen[name] = mark
        return is_new

    def has_news(self) -> bool:
        """Return whether a file that the page shows has changed since the last call. No file is read.

        A run that was killed changes nothing: `is_running` has to be asked now and then all the same.
        """
        before, self._marks = self._marks, tuple(self._mark(name) for name in SHOWN)
        return before != self._marks

    def _mark(self, name: str) -> tuple[int, int, int] | None:
        try:
            stat = (self.path / name).stat()
        except OSError:
            return None
        return (stat.st_mtime_ns, stat.st_size, stat.st_ino)

    def log(self) -> list[dict[str, Any]]:
        """Return every line of the log so far; none of a log that no run writes. It is read when it has changed."""
        if (mark := self._mark(LOG)) != self._read or mark is None:
            try:
                self._lines, self._read = read_log(self.path / LOG), mark
            except OSError:
                self._lines, self._read = [], None
        return self._lines

    def is_running(self) -> bool:
        """Return whether a living process holds this run."""
        return lock_holder(self.path / LOCK) is not None

    def since_last_line_s(self) -> float:
        """Return the seconds since the log was written to, or, before it is there, since the run took the folder."""
        mark = self._mark(LOG) or self._mark(LOCK)
        return max(0.0, time.time() - mark[0] / 1e9) if mark else 0.0

    def thumbnail(self, photo: str) -> np.ndarray | None:
        """Return the small sRGB picture of a photo, (H, W, 3) uint8; None where there is none that can be read."""
        try:
            return read_thumbnail(self.path, photo)
        except (OSError, UserError):
            return None

    def thumbnails(self) -> list[str]:
        """Return the names of the small pictures of photos that are there, in order."""
        folder = self.path / THUMBS
        return sorted(path.name for path in folder.glob("[!.]*.jpg")) if is_own_folder(folder) else []


def status(lines: list[dict[str, Any]], is_running: bool, since_last_line_s: float = 0.0) -> Status:
    """Return the state that a log describes.

    A run that planned no time, as that of a trained field, is as far as its stage.

    Args:
        lines: the log so far.
        is_running: whether a process still holds the run.
        since_last_line_s: seconds since its last line was written, or, without any, since the run was started.
    """
    if not lines:
        return Status("Starting", elapsed_s=since_last_line_s) if is_running else Status("Waiting for a run")
    last, forecast = lines[-1], Forecast(lines)
    stage = forecast.stage
    name = STAGE_NAMES.get(stage, stage.capitalize() or "Working")
    message = str(last.get("message") or "")
    is_working = is_running and not message.startswith(PAUSED)
    elapsed = float(last.get("t") or 0.0) + (since_last_line_s if is_working else 0.0)
    if stage == "done":
        return Status(name, message, 1.0, elapsed_s=elapsed, is_over=True, is_finished=True)
    done, total = float(last.get("done") or 0), float(last.get("total") or 0)
    if not is_running:
        return Status(f"Stopped while {name[0].lower()}{name[1:]}", message, elapsed_s=elapsed, is_over=True)
    if not is_working:
        name, message = f"Paused while {name[0].lower()}{name[1:]}", ""
    counts = f"{done:g} of {total:g}" if total > 1 else ""
    forecast.at(elapsed)
    if forecast.left_s is not None:
        return Status(name, message, forecast.share, counts, forecast.left_s, elapsed)
    left = last.get("eta_s")
    share = min(done / total, 1.0) if total > 0 else None
    return Status(name, message, share, counts, None if left is None else float(left), elapsed)


def loss_curves(lines: Sequence[Mapping[str, Any]]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return seconds, and the values at them of every number named "loss..."; nan where a line does not have it."""
    rows = [line for line in lines if any(k.startswith("loss") for k in line.get("numbers") or {})]
    names = sorted({k for row in rows for k in row["numbers"] if k.startswith("loss")})
    seconds = np.array([float(row.get("t") or 0.0) for row in rows])
    return seconds, {n: np.array([float(row["numbers"].get(n, np.nan)) for row in rows]) for n in names}


def residual_text(name: str) -> tuple[str, str]:
    """Return a plain name for a residual of the fit, and what it means."""
    return FIT_WORDS.get(name, (name.removeprefix("loss_").replace("_", " "), ""))


def size_text(extents: Float[np.ndarray, "3"], unit: str) -> str:
    """Return the size of a box along the world's axes as text."""
    times = " \N{MULTIPLICATION SIGN} "
    if unit == "mm":
        return times.join(f"{v:.1f}" for v in extents) + " mm"
    return times.join(f"{v:.3g}" for v in extents) + " units"
