"""What the terminal says while a run works: where no bar can be drawn, a line at least every few seconds."""

import io
import signal
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest
from rich.console import Console
from waiting import PATIENCE_S

from capture.errors import CaptureError
from reconstruct.run_folder.folder import Progress, RunFolder, read_log
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
