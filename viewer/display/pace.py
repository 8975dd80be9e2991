"""How often a page may send what is dear to send, so that a run beside it keeps the processor."""

import time
from collections.abc import Callable

LEAST_S = 2.0  # as often as a run writes its growing mesh, and as a visitor can follow
REST = 25.0  # times what the last sending cost: at most a 25th of one processor, 4 % of a run that uses one


class Pace:
    """Says when the next sending is due: after LEAST_S seconds, or REST times the CPU seconds of the last one.

    Its cost is what the whole process spent from its beginning until it was asked again: other threads do the sending,
    once to each visitor.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic, spent: Callable[[], float] = time.process_time):
        """The first sending is due at once.

        Args:
            clock: seconds.
            spent: CPU seconds of this process.
        """
        self._clock, self._spent = clock, spent
        self._begun: tuple[float, float] | None = None  # clock and CPU seconds when the last sending began
        self._cost: float | None = None  # CPU seconds of the last sending; None: not asked since

    def begin(self) -> None:
        """A sending begins."""
        self._begun, self._cost = (self._clock(), self._spent()), None

    def is_due(self) -> bool:
        """Whether another may begin."""
        if self._begun is None:
            return True
        start, before = self._begun
        if self._cost is None:
            self._cost = self._spent() - before
        return self._clock() - start >= max(LEAST_S, REST * self._cost)
