"""One bar for a whole run: it never goes back, and the time left does not jump, however wrong the plan was."""

import io
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import pytest
from rich.console import Console

from reconstruct.run_folder.folder import Progress
from reconstruct.run_folder.forecast import STAGE_NAMES, Forecast, plan_numbers
from shadowgraph.terminal import Display

PLANNED = {
    "capture": 4.0,
    "calibrate": 6.0,
    "check": 1.0,
    "hull": 8.0,
    "solve": {42: 3.0, 90: 9.0, 144: 22.0},
    "mesh": 1.0,
    "report": 2.0,
}
ODD = {  # how long a stage takes, as a multiple of its plan
    "as planned": {},
    "a machine that is busy with other things": dict.fromkeys(PLANNED, 8.0),
    "a faster machine": dict.fromkeys(PLANNED, 0.4),
    "photos on a slow disk": {"capture": 6.0},
    "a surface that is soon good": {"solve": 0.3},
    "kernels that are compiled first": {"hull": 4.0},
    "other programs begin in the middle": {"solve": 4.0, "mesh": 4.0, "report": 4.0},
}


def lines_of(times: dict[str, float]) -> Iterator[dict[str, Any]]:
    """The log of a run whose stages take so many times what was planned."""
    t = 0.5
    yield line(t, "capture", numbers=plan_numbers(PLANNED))
    for stage, plan in PLANNED.items():
        factor = times.get(stage, 1.0)
        yield line(t, "solve" if stage == "hull" else stage)  # the solve's first line, before its first shape
        if isinstance(plan, dict):
            at = [(0, 0.0), *plan.items()]
            for (first, before), (last, after) in pairwise(at):
                for step in range(first + 1, last + 1):
                    share = (step - first) / (last - first)
                    yield line(t + factor * (before + share * (after - before)), stage, step, 144)
            t += factor * max(plan.values())
        else:
            if stage == "hull":
                yield line(t, stage, 0, 2)
                yield line(t + factor * plan / 4, stage, 2, 2)
            t += factor * plan
            yield line(t, stage, 1, 1)
    yield line(t, "done", 1, 1)


def line(t: float, stage: str, done: float = 0, total: float = 0, **more: Any) -> dict[str, Any]:
    return {"t": t, "cpu_s": t, "stage": stage, "done": done, "total": total, "eta_s": None, "message": "", **more}


def looked_at(lines: list[dict[str, Any]], every: float = 0.5) -> list[tuple[float, float, float]]:
    """Time, share and seconds left of somebody who looks twice a second."""
    forecast, seen, left = Forecast(), [], list(lines)
    for look in range(1, int(lines[-1]["t"] / every)):
        now = look * every
        while left and left[0]["t"] <= now:
            forecast.see(left.pop(0))
        forecast.at(now)
        if forecast.left_s is not None:
            seen.append((now, forecast.share, forecast.left_s))
    return seen


@pytest.mark.parametrize("times", ODD.values(), ids=ODD)
def test_the_bar_never_goes_back_and_the_time_left_never_jumps(times):
    lines = list(lines_of(times))
    seen = looked_at(lines)
    assert len(seen) > 30 and seen[0][0] <= 1.5  # known from the start
    for (t0, share, left), (t1, next_share, next_left) in pairwise(seen):
        assert next_share >= share
        passed = t1 - t0
        assert abs(next_left - left + passed) <= 0.25 * max(left, 2.0) + passed, (t1, left, next_left)
    shown, end = [left for _, _, left in seen], lines[-1]["t"]
    half = next(row for row in seen if row[0] >= end / 2)
    is_sudden = len(times) < len(PLANNED) and "capture" not in times  # what comes later cannot be known at half time
    off = 4.0 if is_sudden else 2.2
    assert end / 2 / off <= half[2] <= end / 2 * off
    assert shown[-1] < 0.1 * end + 3


@pytest.mark.parametrize("is_terminal", [True, False])
def test_a_terminal_shows_one_bar_of_the_whole_and_names_each_stage_once(is_terminal):
    text, clock = io.StringIO(), [0.0]
    console = Console(file=text, force_terminal=is_terminal, width=160, legacy_windows=False, color_system=None)
    display = Display(console, clock=lambda: clock[0])
    with display.progress:
        for one in lines_of({}):
            clock[0] = one["t"]
            display(Progress(**{"numbers": {}} | one))
        assert len(display.progress.tasks) == (1 if is_terminal else 0)
    if is_terminal:
        assert display.progress.tasks[0].completed == 1.0
        return
    names = [row.partition(":")[0] for row in text.getvalue().splitlines() if not row.startswith("solve")]
    each = [name for k, name in enumerate(names) if k == 0 or name != names[k - 1]]
    assert each == [name for stage, name in STAGE_NAMES.items() if stage in PLANNED or stage == "done"]
