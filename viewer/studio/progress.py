"""Where a run of the studio is: its share done and the seconds left, from the lines of its log."""

from dataclasses import dataclass

from viewer.display.run_follower import RunFollower, status


@dataclass(frozen=True)
class RunProgress:
    """Where a run is."""

    title: str  # what is done now, in plain words
    message: str
    share: float  # of the whole run, 0 to 1
    elapsed_s: float
    left_s: float | None  # until its end; None: not known yet
    is_running: bool
    is_finished: bool


def run_progress(follower: RunFollower, since_last_line_s: float = 0.0, started_s: float | None = None) -> RunProgress:
    """Return where the run of a folder is.

    Args:
        since_last_line_s: seconds since the log's last line was written.
        started_s: seconds since the queue started its process, which may not have taken the folder yet and whose log
            counts from a little later; None: the queue runs no process in it.
    """
    lines, is_running = follower.log(), follower.is_running() or started_s is not None
    now = status(lines, is_running, since_last_line_s)
    if now.is_finished:
        return RunProgress(now.title, "", 1.0, now.elapsed_s, 0.0, False, True)
    elapsed = max(now.elapsed_s, since_last_line_s if is_running else 0.0, started_s or 0.0)
    title, message = (now.title, now.message) if lines else ("Starting" if is_running else now.title, "")
    return RunProgress(title, message, now.fraction or 0.0, elapsed, now.eta_s, is_running, False)
