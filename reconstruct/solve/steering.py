"""Requests of page visitors to a solve: pause, next level, stop, resolution. They act where a solve can be resumed.

A solve without requests is not affected. A stopped solve is resumed bit for bit by the same command.
"""

from collections.abc import Callable
from typing import Protocol, runtime_checkable

from reconstruct.config import FitConfig
from reconstruct.solve.checkpoint import SolveState


class Rescheduled(Exception):
    """Signals that the solve must continue with another schedule."""

    def __init__(self, state: SolveState, config: FitConfig, resolution: str):
        """Continue from `state`, at the beginning of a level of `config`; `resolution` is the name of its preset."""
        super().__init__(resolution)
        self.state, self.config, self.resolution = state, config, resolution


@runtime_checkable
class Steering(Protocol):
    """Requests that a solve polls as it runs."""

    def wait(self, save: Callable[[], None]) -> None:
        """Return at once, or after a pause; `save` is called before a pause."""
        ...

    def is_stopped(self) -> bool:
        """Return whether to save and end with the current surface; asked, as the next two, where a solve can resume."""
        ...

    def ends_level(self) -> bool:
        """Return whether to end this level, and continue with the next one if any."""
        ...

    def ends_solve(self, state: SolveState, config: FitConfig) -> bool:
        """Return whether to end the solve after a level.

        Raises:
            Rescheduled: continue with another schedule.
        """
        ...


class NoSteering:
    """Steering without requests."""

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
