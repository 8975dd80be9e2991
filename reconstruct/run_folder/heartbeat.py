"""A line of progress whenever a step takes long: a user sees that the run works, and at what."""

import threading
import time
from collections.abc import Callable

from reconstruct.run_folder.cost import cpu_seconds

SILENCE_S = 4.0  # after which a line is due: nobody should look at a still screen for longer than 5 s
WORKING = 0.05  # CPU seconds per second: a run that waits, because a visitor of its page paused it, uses less


class Heartbeat:
    """Calls `say` with the seconds since the last line, in a thread, while a block runs and the process computes."""

    def __init__(self, say: Callable[[float], None], silence_s: float = SILENCE_S):
        self._say, self._silence = say, silence_s
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._since = self._due = time.monotonic()

    def reset(self) -> None:
        """Begin to count anew: a line was written."""
        self._since = time.monotonic()
        self._due = self._since + self._silence

    def __enter__(self) -> "Heartbeat":
        self.reset()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()

    def _watch(self) -> None:
        cpu = cpu_seconds()
        while not self._end.wait(self._silence / 8):
            now = time.monotonic()
            if now < self._due:
                continue
            used = cpu_seconds() - cpu
            cpu, self._due = cpu + used, now + self._silence
            if used > WORKING * self._silence:
                self._say(now - self._since)
