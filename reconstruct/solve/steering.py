"""Requests of page visitors to a solve: pause, next level, stop, resolution. They act where a solve can be resumed.

A solve without requests is not affected. A stopped solve is resumed bit for bit by the same command.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from reconstruct.config import FitConfig
from reconstruct.solve.checkpoint import SolveState


@dataclass(frozen=True)
class Rescheduled:
    """The end of a solve that has to continue with another schedule."""

    state: SolveState  # at the beginning of a level of `config`
    config: FitConfig
    resolution: str  # the name of its preset


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

    def ends_solve(self, state: SolveState, config: FitConfig) -> bool | Rescheduled:
        """Return whether to end the solve after a level, and with what other schedule to continue if any."""
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
