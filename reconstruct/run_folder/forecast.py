"""How far a whole run is and how long it still takes: from the lines of its log, and from nothing else.

At its start a run measures its machine and logs how many seconds each part should take (`reconstruct/run/machine.py`),
as numbers whose names begin with PLAN. What the parts then take corrects the rest: a machine that is busy with other
things is slower than it measured itself. What is shown follows a better estimate within a share of the time left, so
that it does not jump, and the bar never goes back.

Measure the cost of a stage: seconds, CPU seconds, peak memory.
"""

import ctypes
import gc
import math
import os
import sys
import threading
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

try:
    import resource
except ImportError:  # Windows has no such limits
    resource = None
MALLOPT_ARENA_MAX, FEW_ARENAS = -8, 2  # of glibc's malloc.h; its default is eight for each core
GROUPS = Path("/sys/fs/cgroup")
MEMORY_PERIOD_S = 0.1  # how often memory is sampled; a sample costs about 20 microseconds
STAGE_NAMES = {  # in the order of a run; the stage `solve` begins with what is logged as `hull`
    "capture": "Reading the photos",
    "calibrate": "Finding camera and lights",
    "check": "Judging the photos",
    "hull": "Carving the first shape",
    "solve": "Fitting the surface",
    "mesh": "Making the mesh",
    "detail": "Reading the finest detail",
    "report": "Writing the report",
    "done": "Finished",
}
PLAN = "plan "  # begins the name of a part's expected seconds: "plan solve 48" is that of its steps up to the 48th
TRUST = 0.05  # of the whole: once the parts that are over make up as much of the plan, they count more than the plan
SETTLE, SETTLE_S = 0.15, 2.0  # of the time left, and at least so many seconds: how fast the shown time follows
OVERDUE = 0.1  # of the time that an uncounted part has taken, when that is more than expected: what it is given still


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


class Forecast:
    """Follows a run line by line. `share` (0 to 1) and `left_s` are of the whole run; None: nothing is known yet."""

    def __init__(self, lines: Iterable[Mapping[str, Any]] = ()):
        """Follow the lines that a log has so far."""
        self.share, self.left_s, self.stage = 0.0, None, ""
        self._plan: dict[str, dict[int, float]] = {}  # seconds of each stage up to a step, 0: of all of it
        self._began = self._stage_began = self._now = 0.0  # s of the log's clock
        self._counts: list[tuple[float, float]] = []  # of this stage: when, and the planned seconds of the steps done
        for line in lines:
            self.see(line)

    def see(self, line: Mapping[str, Any]) -> None:
        """Take in a line of the log."""
        now, stage = float(line.get("t") or 0.0), str(line.get("stage", "")).split("/")[0]
        done = float(line.get("done") or 0)
        plan = _plan_of(line.get("numbers") or {})
        if plan:
            self._plan, self._began, self.stage = plan, now, ""
        if stage == "solve" and not done and self.stage != "solve":
            stage = "hull"
        if stage != self.stage:
            self.stage, self._stage_began, self._counts = stage, now, []
        if done > 0 and max(self._plan.get(stage, {0: 0.0})) > 0:
            self._counts = [*self._counts[:1], (now, _planned(self._plan[stage], done))]
        self.at(now)

    def at(self, now: float) -> None:
        """Go on to a moment (s of the log's clock) at which no line was written."""
        passed, self._now = max(now - self._now, 0.0), max(now, self._now)
        if self.stage == "done":
            self.share, self.left_s = 1.0, 0.0
        elif self._plan and self.stage in STAGE_NAMES:
            better, before = self._estimate(), self.left_s
            if before is not None:
                before = max(before - passed, 0.0)
                settled = 1 - math.exp(-passed / (SETTLE_S + SETTLE * max(before, better)))
                better = before + settled * (better - before)
            self.left_s = better
            self.share = max(self.share, self._now / max(self._now + better, 1e-9))

    def _estimate(self) -> float:
        """Return the seconds left as they are best known now, from the pace of what is over."""
        whole = {stage: steps[max(steps)] for stage, steps in self._plan.items()}
        order = list(STAGE_NAMES)
        here = order.index(self.stage)
        before, later = (
            sum(seconds for stage, seconds in whole.items() if is_there(order.index(stage)))
            for is_there in (lambda place: place < here, lambda place: place > here)
        )
        trust, own = TRUST * sum(whole.values()), whole.get(self.stage, 0.0)
        (first_at, first), (last_at, last) = (self._counts[0], self._counts[-1]) if self._counts else ((0.0, 0.0),) * 2
        pace = (self._stage_began - self._began + last_at - first_at + trust) / (before + last - first + trust)
        if self._counts:
            of_steps = (last_at - first_at + trust * pace) / (last - first + trust)
            rest = max((own - last) * of_steps - (self._now - last_at), 0.0)
        else:
            taken = self._now - self._stage_began
            rest = max(own * pace - taken, OVERDUE * taken)
        return rest + later * pace


def left_text(seconds: float | None) -> str:
    """Return the time left as a person says it; "" where it is not known."""
    if seconds is None:
        return ""
    if seconds < 10:
        return "a few seconds left"
    if seconds < 90:
        return f"about {round(seconds, -1):.0f} s left"
    return f"about {round(seconds / 60):.0f} min left"


def duration_text(seconds: float) -> str:
    """Return a duration as text: "40 s", "2 min 5 s"."""
    whole = round(seconds)
    return f"{whole} s" if whole < 60 else f"{whole // 60} min {whole % 60} s"


def plan_numbers(plan: Mapping[str, float | Mapping[int, float]]) -> dict[str, float]:
    """Return a plan as the numbers of a log line.

    Args:
        plan: seconds of each stage, or of its steps up to each of some.
    """
    numbers = {}
    for stage, seconds in plan.items():
        steps = seconds if isinstance(seconds, Mapping) else {0: seconds}
        numbers |= {f"{PLAN}{stage} {step}": value for step, value in steps.items()}
    return numbers


def _plan_of(numbers: Mapping[str, float]) -> dict[str, dict[int, float]]:
    plan: dict[str, dict[int, float]] = {}
    for name, seconds in numbers.items():
        stage, _, step = name.removeprefix(PLAN).partition(" ")
        if name.startswith(PLAN) and stage in STAGE_NAMES and step.isdecimal():
            plan.setdefault(stage, {})[int(step)] = max(float(seconds), 0.0)
    return plan


def _planned(steps: Mapping[int, float], done: float) -> float:
    """Return the planned seconds of the first steps of a stage."""
    before, at = 0.0, 0
    for step, seconds in sorted(steps.items()):
        if done <= step:
            return before + (seconds - before) * (done - at) / (step - at)
        before, at = seconds, step
    return before
