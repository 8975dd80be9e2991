"""What a stage costs: seconds, CPU seconds, peak memory."""

import os
import threading
from dataclasses import dataclass

import psutil

MEMORY_PERIOD_S = 0.1  # how often memory is sampled; a sample costs about 20 microseconds


@dataclass
class Cost:
    """What a stage has used so far."""

    seconds: float = 0.0
    cpu_seconds: float = 0.0
    peak_memory_bytes: int = 0


def cpu_seconds() -> float:
    """CPU seconds of this process so far, user and system, with its finished children."""
    t = os.times()
    return t.user + t.system + t.children_user + t.children_system


class PeakMemory:
    """Samples this process's resident memory in a thread while a block runs."""

    def __init__(self):
        self.peak = 0
        self._process = psutil.Process()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> "PeakMemory":
        self._sample()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()
        self._sample()

    def _sample(self) -> None:
        self.peak = max(self.peak, self._process.memory_info().rss)

    def _watch(self) -> None:
        while not self._end.wait(MEMORY_PERIOD_S):
            self._sample()
