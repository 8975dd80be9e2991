"""What the terminal says while a run works: where no bar can be drawn, a line at least every few seconds."""

import io
import signal
import subprocess
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from waiting import PATIENCE_S

from capture.errors import CaptureError
from reconstruct.run_folder.folder import Progress, RunFolder, read_log
from reconstruct.run_folder.forecast import STAGE_NAMES, Forecast, plan_numbers
from shadowgraph.command import sentence_for
from shadowgraph.terminal import LINE_EVERY_S, Display, print_lines

ROOT = Path(__file__).parent.parent


class Screen:
    """A display that prints lines, with a clock that the test sets."""

    def __init__(self):
        self.now, self._text = 0.0, io.StringIO()
        console = Console(file=self._text, force_terminal=False, width=200)
        self.display = Display(console, clock=lambda: self.now)

    def lines(self) -> list[str]:
        return self._text.getvalue().splitlines()

    def wait(self, seconds: float) -> None:
        """Let time pass, with a beat every quarter of a second."""
        for _ in range(round(4 * seconds)):
            self.now += 0.25
            self.display.beat()


def step(done: int, message: str = "level 1", **numbers: float) -> Progress:
    return Progress(0.0, 0.0, "solve", done, 60, None, message, numbers)


def test_no_more_than_the_promised_time_passes_without_a_line_however_steps_and_silence_alternate():
    screen = Screen()
    printed, seen = [0.0], 0
    for quarter in range(200):
        screen.now += 0.25
        if quarter % 23 < 9:  # quick steps that tell numbers, then a long one
            screen.display(step(quarter, loss=0.1))
        elif quarter % 23 == 9:
            screen.display.activity("reading shadows")
        screen.display.beat()
        if len(screen.lines()) > seen:
            seen = len(screen.lines())
            printed.append(screen.now)
    gaps = [after - before for before, after in pairwise(printed)]
    assert max(gaps) <= LINE_EVERY_S + 0.25
    assert min(gaps[1:]) >= LINE_EVERY_S  # and quick steps do not flood the screen
    assert any("reading shadows" in line for line in screen.lines())


def test_a_run_says_soon_what_it_opens_and_a_quick_refusal_stands_alone():
    screen = Screen()
    with screen.display.beating("opening capture"):
        screen.wait(0.75)
        assert screen.lines() == []
        screen.wait(0.25)
        assert screen.lines() == ["opening capture, 1 s so far"]


@pytest.mark.parametrize("sentence", ["reading shadows", ""])
def test_an_activity_is_shown_but_is_no_step_of_the_run(tmp_path, sentence):
    steps, shown = [], []
    with RunFolder(tmp_path / "run", steps.append, shown.append) as run, run.stage("solve"):
        run.progress("solve", 3, 60, "level 1", {"loss": 0.5})
        before = read_log(tmp_path / "run" / "log.jsonl")
        run.activity(sentence)
        assert read_log(tmp_path / "run" / "log.jsonl") == before
        assert len(steps) == len(before)
    assert shown == [sentence]


@pytest.mark.parametrize("name", ["a\nb", "a\r\x1b[2Jb", "a\u202eb", "a\u2028b", "a\x07\x9bb", "[/x]b", "[red]b\t"])
def test_no_name_of_a_file_breaks_a_line_or_commands_the_terminal(name):
    shown = "".join(letter if letter.isprintable() else " " for letter in name)
    for is_terminal in (False, True):
        text = io.StringIO()
        console = Console(file=text, force_terminal=is_terminal, color_system=None, width=200)
        display = Display(console)
        with display.progress:
            display(step(0, name))
            display.activity(f"reading {name}")
        print_lines(console, name, sentence_for(CaptureError(name)) or "")
        lines = [line.rstrip() for line in text.getvalue().replace("\x1b[?25h", "").splitlines()]
        assert lines[-2:] == [shown.rstrip(), shown.rstrip()]
        if is_terminal:
            assert f"reading {shown}" in lines[-3]
        else:
            assert len(lines) == 3 and lines[0].endswith(f": 0 of 60, {shown}".rstrip())


@pytest.mark.parametrize("place", ["loading", "working", "cleaning", "ending"])
def test_ctrl_c_prints_no_traceback_wherever_it_arrives_and_a_second_one_ends_at_once(place):
    code = f"""
import atexit, signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.argv = ["shadowgraph", "doctor"]

def wait(place):
    if place == {place!r}:
        print("here", flush=True)
        time.sleep({PATIENCE_S})

class Loader:
    def find_spec(self, name, *_):
        if name == "shadowgraph.command":
            wait("loading")

def execute(*_):
    try:
        wait("working")
        if {place!r} == "cleaning":
            raise KeyboardInterrupt
    finally:
        wait("cleaning")

sys.meta_path.insert(0, Loader())
atexit.register(wait, "ending")
from shadowgraph.__main__ import start
if {place!r} != "loading":
    import shadowgraph.command
    shadowgraph.command.execute = execute
sys.exit(start())
"""
    process = subprocess.Popen(
        [sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None and process.stdout.readline() == "here\n"
    for _ in range(2):
        process.send_signal(signal.SIGINT)
    error = process.communicate(timeout=PATIENCE_S)[1]
    assert "Traceback" not in error and process.returncode in (130, -signal.SIGINT)


# --- one bar for a whole run -----------------------------------------------------------------------------------------


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
