"""What visitors of the page ask of a solve, followed where it can be resumed from: pause, next level, stop, resolution.

A solve that nobody steers is not touched, and one that was stopped is continued bit for bit by the same command.
"""

from collections.abc import Callable
from typing import Protocol, runtime_checkable

from reconstruct.config import FitConfig
from reconstruct.solve.checkpoint import SolveState


class Rescheduled(Exception):
    """The solve is to go on with another schedule."""

    def __init__(self, state: SolveState, config: FitConfig, resolution: str):
        """From `state`, at the beginning of a level of `config`, which has the resolution of that preset."""
        super().__init__(resolution)
        self.state, self.config, self.resolution = state, config, resolution


@runtime_checkable
class Steering(Protocol):
    """What a solve asks on its way."""

    def wait(self, save: Callable[[], None]) -> None:
        """Return at once, or after a pause; `save` is called before one."""
        ...

    def is_stopped(self) -> bool:
        """Whether to save and end with what there is. Asked where a solve can be resumed from, as the next two."""
        ...

    def ends_level(self) -> bool:
        """Whether to go on with the next level, or to end."""
        ...

    def ends_solve(self, state: SolveState, config: FitConfig) -> bool:
        """Whether to end after a level.

        Raises:
            Rescheduled: go on with another schedule.
        """
        ...


class Unsteered:
    """A solve that nobody steers."""

    def wait(self, save: Callable[[], None]) -> None:
        """Never."""

    def is_stopped(self) -> bool:
        """Never."""
        return False

    def ends_level(self) -> bool:
        """Never."""
        return False

    def ends_solve(self, state: SolveState, config: FitConfig) -> bool:
        """Never."""
        return False
