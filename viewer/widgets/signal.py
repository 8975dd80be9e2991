"""Signal: functions that are called when something happens."""

from collections.abc import Callable
from typing import Generic, TypeVar

Value = TypeVar("Value")


class Signal(Generic[Value]):
    """Calls the connected functions with a value, in the order of their connection and in the thread that emits."""

    def __init__(self) -> None:
        """Start with no connected function."""
        self._receivers: tuple[Callable[[Value], object], ...] = ()

    def connect(self, receiver: Callable[[Value], object]) -> None:
        """Call this function from now on."""
        self._receivers = (*self._receivers, receiver)

    def disconnect(self, receiver: Callable[[Value], object]) -> None:
        """Call this function no more."""
        self._receivers = tuple(one for one in self._receivers if one != receiver)

    def emit(self, value: Value) -> None:
        """Call all connected functions."""
        for receiver in self._receivers:
            receiver(value)

    def __len__(self) -> int:
        """Return the number of connected functions."""
        return len(self._receivers)
