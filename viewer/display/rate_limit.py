"""RateLimit: how often a page may send what costs much, so that a run beside it keeps the processor."""

import time
from collections.abc import Callable

MIN_INTERVAL_S = 2.0  # as often as a run writes its growing mesh, and as a visitor can follow
COST_FACTOR = 25.0  # times what the last sending cost: at most a 25th of one processor, 4 % of a run that uses one


class RateLimit:
    """Says when the next sending may begin: MIN_INTERVAL_S, or COST_FACTOR times its cost, after the last one began.

    The cost of a sending is the CPU time of the whole process from its beginning until `is_due` is called again: other
    threads do the sending, once to each visitor.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic, spent: Callable[[], float] = time.process_time):
        """Allow the first sending at once.

        Args:
            clock: seconds.
            spent: CPU seconds of this process.
        """
        self._clock, self._spent = clock, spent
        self._begun: tuple[float, float] | None = None  # clock and CPU seconds when the last sending began
        self._cost: float | None = None  # CPU seconds of the last sending; None: not asked since

    def begin(self) -> None:
        """Note that a sending begins."""
        self._begun, self._cost = (self._clock(), self._spent()), None

    def is_due(self) -> bool:
        """Return whether another sending may begin."""
        if self._begun is None:
            return True
        start, before = self._begun
        if self._cost is None:
            self._cost = self._spent() - before
        return self._clock() - start >= max(MIN_INTERVAL_S, COST_FACTOR * self._cost)
