"""Connect the progress of exports and films, and what packages log of their steps, to a progress display."""

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

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


class _Told(logging.Handler):
    """Hands on what one thread logs."""

    def __init__(self, say: Callable[[str], None], warn: Callable[[str], None]):
        super().__init__(logging.INFO)
        self._say, self._warn, self._thread = say, warn, threading.get_ident()

    def emit(self, record: logging.LogRecord) -> None:
        if record.thread == self._thread:
            say = self._warn if record.levelno >= logging.WARNING else self._say
            say(record.getMessage())


@contextmanager
def log_to(package: str, say: Callable[[str], None], warn: Callable[[str], None]) -> Iterator[None]:
    """Say what a package logs of its steps, as long as this lasts; of this thread alone, as runs may be side by side.

    Args:
        package: name of its logger.
        warn: gets what it warns of; `say` gets the rest.
    """
    logger, handler = logging.getLogger(package), _Told(say, warn)
    if logger.getEffectiveLevel() > logging.INFO:
        logger.setLevel(logging.INFO)
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
