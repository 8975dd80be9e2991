"""Stages that are done once: a later invocation of the same run reads their results back when needed."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from reconstruct.run_folder.folder import RunFolder

T = TypeVar("T")


@dataclass(frozen=True)
class ResultFile(Generic[T]):
    """How the result of a stage is stored in the run folder."""

    file: str
    save: Callable[[T, Path], None]
    load: Callable[[Path], T]


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
    make: Callable[[], T],
    result: ResultFile[T],
    needs: Lazy[Any] | None = None,
) -> Lazy[T]:
    """Return the result of a stage: from an earlier invocation that finished it, else made now.

    A new result is read back from its file, so that an interrupted and an uninterrupted run continue from the same
    numbers.

    Args:
        message: the log's message while the stage runs.
        needs: a value that is made in its own stage, before this stage begins.
    """
    path = run.file(result.file)
    if not path.exists():
        run.reopen(stage)  # a result that somebody removed is made again
    done_once(run, stage, message, lambda: result.save(make(), path), needs)
    return Lazy(lambda: result.load(path))


def done_once(run: RunFolder, stage: str, message: str, do: Callable[[], Any], needs: Lazy[Any] | None = None) -> bool:
    """Do a stage whose results are not read back in this run; return True if done now. Arguments as for `once`."""
    if run.is_finished(stage):
        return False
    if needs is not None:
        needs.get()
    with run.stage(stage, message):
        do()
    return True
