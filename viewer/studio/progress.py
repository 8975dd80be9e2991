"""One bar for a whole run: its share done and the seconds left, from the lines of its log."""

from dataclasses import dataclass

from viewer.display.run_follower import RunFollower, status

SHARES = {  # of a run's time, measured on drafts of 36 photos on two cores; finer presets solve for longer
    "capture": 0.04,
    "calibrate": 0.15,
    "check": 0.02,
    "hull": 0.28,
    "solve": 0.42,
    "mesh": 0.03,
    "detail": 0.0,
    "report": 0.06,
}
EARLY = 0.08  # of the whole: before it, the time left is a guess that is not shown
LOOSE = 0.9  # of a stage whose steps are not counted: what is shown once it takes as long as it should


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
        since_last_line_s: seconds since the log's last line was written: stages without steps move on by them.
        started_s: seconds since the queue started its process, which may not have taken the folder yet and whose log
            counts from a little later; None: the queue runs no process in it.
    """
    lines, is_running = follower.log(), follower.is_running() or started_s is not None
    now = status(lines, is_running)
    if now.is_finished:
        return RunProgress(now.title, "", 1.0, now.elapsed_s, 0.0, False, True)
    elapsed = max(now.elapsed_s + (since_last_line_s if is_running else 0.0), started_s or 0.0)
    stage = str(lines[-1].get("stage", "")).split("/")[0] if lines else "capture"
    before = 0.0
    for name, share in SHARES.items():
        if name == stage:
            break
        before += share
    own = SHARES.get(stage, 0.0)
    inside = now.fraction if now.counts and now.fraction is not None else None
    if inside is None:  # 1 - 1 / (1 + t / expected): never stands still, never arrives
        expected = own * max(elapsed, 1.0) / max(before + own / 2, 0.02)
        inside = LOOSE * (1 - 1 / (1 + since_last_line_s / max(expected, 1.0)))
    share = min(before + own * inside, 0.99)
    left = elapsed * (1 - share) / share if is_running and share > EARLY else None
    if not lines and is_running:
        return RunProgress("Starting", "", share, elapsed, None, True, False)
    return RunProgress(now.title, now.message, share, elapsed, left, is_running, False)
