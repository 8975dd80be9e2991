"""Measure the cost of a stage: seconds, CPU seconds, peak memory."""

import ctypes
import gc
import os
import sys
import threading
from dataclasses import dataclass
from pathlib import Path

import psutil

try:
    import resource
except ImportError:  # Windows has no such limits
    resource = None

MALLOPT_ARENA_MAX, FEW_ARENAS = -8, 2  # of glibc's malloc.h; its default is eight for each core
GROUPS = Path("/sys/fs/cgroup")
MEMORY_PERIOD_S = 0.1  # how often memory is sampled; a sample costs about 20 microseconds


@dataclass
class Cost:
    """The resources that a stage has used so far."""

    seconds: float = 0.0
    cpu_seconds: float = 0.0
    peak_memory_bytes: int = 0


def cpu_seconds() -> float:
    """Return the CPU seconds of this process so far, user and system, with its finished children."""
    t = os.times()
    return t.user + t.system + t.children_user + t.children_system


def memory_room() -> int:
    """Return the bytes of memory that this process can hold: free memory, within its group's and its own limits."""
    process = psutil.Process()
    held = process.memory_info()
    rooms = [psutil.virtual_memory().available + held.rss, *_group_rooms(held.rss)]
    if resource is not None:  # reserved and never touched, address space counts against these limits as well
        for limit, taken in ((resource.RLIMIT_AS, held.vms), (resource.RLIMIT_DATA, getattr(held, "data", 0))):
            most = resource.getrlimit(limit)[0]
            if most != resource.RLIM_INFINITY:
                rooms.append(most - max(0, taken - held.rss))
    return max(0, min(rooms))


def _group_rooms(held: int) -> list[int]:
    """Return the bytes that each control group (version 2) of this process leaves to it; file pages do not count."""
    try:
        line = next(x for x in Path("/proc/self/cgroup").read_text().splitlines() if x.startswith("0::"))
    except (OSError, StopIteration):
        return []
    rooms, group = [], GROUPS / line[3:].lstrip("/")
    for folder in (x for x in (group, *group.parents) if x.is_relative_to(GROUPS)):
        try:
            most, now = ((folder / name).read_text().strip() for name in ("memory.max", "memory.current"))
            parts = dict(row.split() for row in (folder / "memory.stat").read_text().splitlines())
            rooms.append(int(most) - int(now) + int(parts.get("inactive_file", 0)) + held)
        except (OSError, ValueError):  # no limit there, or no such group
            continue
    return rooms


def give_memory_back() -> None:
    """Collect reference cycles, and return freed memory to the system.

    Python collects cycles after many new objects, not after large ones, such as a mesh or data that was being sent to
    a visitor who disconnected. glibc keeps freed memory in pieces, and more and more of it.
    """
    gc.collect()
    _configure_allocator("malloc_trim", 0)


def share_memory_among_threads() -> None:
    """Let all threads share a few memory pools; for a long-lived process with many short-lived threads.

    glibc gives each thread its own pool and keeps freed memory in it: measured on a page, .18 MB for every visitor who
    came and left; with two pools, a tenth of that.
    """
    _configure_allocator("mallopt", MALLOPT_ARENA_MAX, FEW_ARENAS)


def _configure_allocator(function: str, *values: int) -> None:
    if sys.platform == "linux":
        found = getattr(ctypes.CDLL(None), function, None)  # other C libraries may lack it
        if found is not None:
            found(*values)


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
