"""Stages that are done once: a later invocation of the same run reads their results back when needed.

What the calibration logs of its steps, for a progress display.
"""

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Generic, TypeVar

from reconstruct.run_folder.folder import RunFolder

T = TypeVar("T")


@contextmanager
def log_to(say: Callable[[str], None], warn: Callable[[str], None]) -> Iterator[None]:
    """Say what the calibration logs of its steps while this lasts; of this thread alone, as runs may be side by side.

    Args:
        warn: gets what it warns of; `say` gets the rest.
    """
    logger, handler, thread = logging.getLogger("calibration"), logging.Handler(logging.INFO), threading.get_ident()

    def emit(record: logging.LogRecord) -> None:
        if record.thread == thread:
            (warn if record.levelno >= logging.WARNING else say)(record.getMessage())

    handler.emit = emit
    if logger.getEffectiveLevel() > logging.INFO:
        logger.setLevel(logging.INFO)
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


class Lazy(Generic[T]):
    """A lazy value: made at its first use, and then kept."""

    def __init__(self, make: Callable[[], T]):
        self._make, self._made = make, list[T]()

    def get(self) -> T:
        """Return the value."""
        if not self._made:
            self._made.append(self._make())
        return self._made[0]

    def forget(self) -> None:
        """Drop the value; it is made again at its next use."""
        self._made.clear()


def once(
    run: RunFolder,
    stage: str,
    message: str,
    do: Callable[[], Any],
    needs: Lazy[Any] | None = None,
    leaves: str | None = None,
) -> bool:
    """Do a stage unless an earlier invocation finished it; return True if it was done now.

    A result is read back from its file, so that an interrupted and an uninterrupted run continue from the same numbers.

    Args:
        message: the log's message while the stage runs.
        needs: a value that is made in its own stage, before this stage begins.
        leaves: the file of its result: one that somebody removed is made again.
    """
    if leaves is not None and not run.file(leaves).exists():
        run.reopen(stage)
    if run.is_finished(stage):
        return False
    if needs is not None:
        needs.get()
    with run.stage(stage, message):
        do()
    return True
