"""Stages that are done once: a later invocation of the same run reads their results back, when something needs them."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from reconstruct.run_folder.folder import RunFolder

T = TypeVar("T")


@dataclass(frozen=True)
class Result(Generic[T]):
    """How the result of a stage lies in the run folder."""

    file: str
    save: Callable[[T, Path], None]
    load: Callable[[Path], T]


class Later(Generic[T]):
    """A value that is made when it is first asked for, and then kept."""

    def __init__(self, make: Callable[[], T]):
        self._make, self._made = make, list[T]()

    def get(self) -> T:
        """The value."""
        if not self._made:
            self._made.append(self._make())
        return self._made[0]

    def forget(self) -> None:
        """Let the value go; it is made again if it is asked for again."""
        self._made.clear()


def once(
    run: RunFolder,
    stage: str,
    message: str,
    make: Callable[[], T],
    result: Result[T],
    needs: Later[Any] | None = None,
) -> Later[T]:
    """The result of a stage: of an earlier invocation if that finished it, else made now.

    What was made is read back from its file, so that an interrupted run and one without a break go on from the same
    numbers.

    Args:
        message: what the log says while the stage works.
        needs: a value whose making is a stage of its own: made before this stage begins.
    """
    path = run.file(result.file)
    if not run.is_finished(stage):
        if needs is not None:
            needs.get()
        with run.stage(stage, message):
            result.save(make(), path)
    return Later(lambda: result.load(path))


def done_once(run: RunFolder, stage: str, message: str, do: Callable[[], Any], needs: Later[Any] | None = None) -> bool:
    """Do a stage whose results nothing in this run reads back; whether it was done now. Arguments as for `once`."""
    if run.is_finished(stage):
        return False
    if needs is not None:
        needs.get()
    with run.stage(stage, message):
        do()
    return True
