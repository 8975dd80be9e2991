"""Connect the progress callback of exports and films to a progress display."""

import time
from collections.abc import Callable

from reconstruct.export.export import OnProgress
from reconstruct.run_folder.folder import Progress


def progress(stage: str, show: Callable[[Progress], object]) -> OnProgress:
    """Return a callback that shows n of m and the time left as steps of a stage."""
    begin = time.monotonic()

    def on_progress(done: int, total: int, message: str) -> None:
        passed = time.monotonic() - begin
        eta = passed * (total - done) / done if done else None
        show(Progress(passed, time.process_time(), stage, done, total, eta, message))

    return on_progress
