"""What the terminal shows of a run: its progress, and the address of its page, which another process serves."""

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from types import FrameType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from capture.files.names import in_one_line
from reconstruct.run_folder.folder import Progress as Step
from reconstruct.run_folder.forecast import STAGE_NAMES, Forecast, left_text

PAGE_WAIT_S = 20.0  # for the viewer to send its address: it imports torch, which takes seconds on a busy machine
LINE_EVERY_S = 4.0  # between progress lines where no bar can be drawn: nobody looks at a still screen for over 5 s
FIRST_LINE_S = 1.0  # after the start, which itself took a second or two; a quick refusal stands alone
LOOK_EVERY_S = 0.25  # whether a line is due


class Display:
    """Shows progress: how far the whole is, the time left, and what is done now. In a terminal it draws one bar,
    elsewhere it prints lines.

    Where it prints lines and a step takes long, `beat` says for how long, and at what. This is for the eye alone: the
    run's log does not have it.
    """

    def __init__(self, console: Console, clock: Callable[[], float] = time.monotonic):
        """Draw on this console; `clock` tells seconds."""
        words = TextColumn("{task.fields[words]}", markup=False)
        columns = (TextColumn("{task.description}"), BarColumn(24), words)
        self.console = console
        self.progress = Progress(*columns, TimeElapsedColumn(), console=console, disable=not console.is_terminal)
        self._task: TaskID | None = None
        self._clock, self._one_at_a_time = clock, threading.Lock()
        self._forecast, self._step = Forecast(), Step(0.0, 0.0, "")
        self._doing = ""  # what is being done; "" while the run waits
        self._since = self._last = self._stepped = clock()  # since when, when a line was printed, when a step was done

    def __call__(self, step: Step) -> None:
        """Show one step."""
        with self._one_at_a_time:
            is_new = step.stage != self._step.stage
            self._forecast.see(asdict(step))
            self._step, self._doing = step, in_one_line(step.message)
            self._since = self._stepped = self._clock()
            if not self.progress.disable:
                self._draw()
            elif is_new or not step.numbers or self._since - self._last >= LINE_EVERY_S:
                self._print(self._doing)

    def activity(self, sentence: str) -> None:
        """Show what is done until the next step; an empty sentence: the run waits, and nothing is to be said."""
        with self._one_at_a_time:
            self._doing, self._since = in_one_line(sentence), self._clock()
            self._draw()

    def beat(self) -> None:
        """Move the bar on; elsewhere print what is being done, and for how long, after LINE_EVERY_S without a line."""
        with self._one_at_a_time:
            now = self._clock()
            if self._doing:
                self._forecast.at(self._step.t + now - self._stepped)
                self._draw()
            if self.progress.disable and self._doing and now - self._last >= LINE_EVERY_S:
                seconds = now - self._since
                self._print(f"{self._doing}, {seconds:.0f} s so far" if seconds >= 1 else self._doing)

    @contextmanager
    def beating(self, sentence: str) -> Iterator[None]:
        """Beat while the block runs, which begins with what the sentence says; it may draw the bar in between."""
        self.activity(sentence)
        self._last = self._clock() + FIRST_LINE_S - LINE_EVERY_S
        ended = threading.Event()

        def go_on() -> None:
            while not ended.wait(LOOK_EVERY_S):
                self.beat()

        thread = threading.Thread(target=go_on, name="heartbeat", daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()

    def _where(self) -> tuple[str, float, str]:
        """Return what is done in plain words, the share done, and how far that is in words.

        Of a run all of it; of other commands, which have one stage and plan no time, the steps and seconds of that.
        """
        step, stage = self._step, self._forecast.stage
        if self._forecast.left_s is not None:
            share, left = self._forecast.share, self._forecast.left_s
            words = "" if stage == "done" else f"{share:.0%}, {left_text(left)}"
        else:
            share = step.done / step.total if step.total else 0.0
            counts = f"{step.done:g} of {step.total:g}" if step.total > 1 else ""
            words = ", ".join(filter(None, (counts, "" if share >= 1 else left_text(step.eta_s))))
        return STAGE_NAMES.get(stage, stage), share, words

    def _draw(self) -> None:
        name, share, words = self._where()
        if self.progress.disable or not name:
            return
        if self._task is None:
            self._task = self.progress.add_task(name, words=words, total=1.0)
        words = ", ".join(filter(None, (words, _beside(name, self._doing))))
        self.progress.update(self._task, description=name, completed=share, words=words)

    def _print(self, doing: str) -> None:
        self._last = self._clock()
        name, _, words = self._where()
        text = ", ".join(filter(None, (words, _beside(name, doing))))
        print_lines(self.console, ": ".join(filter(None, (name, text))))


def _beside(name: str, doing: str) -> str:
    """Return what is done, unless the stage's name says it."""
    return "" if doing.casefold() == name.casefold() else doing


def print_lines(console: Console, *lines: str) -> None:
    """Print lines as they are: nothing in them is markup, none is broken, and no name in them breaks one."""
    for line in lines:
        console.print(in_one_line(line), markup=False, highlight=False, soft_wrap=True)


@contextmanager
def page(run_dir: Path, mode: str, console: Console) -> Iterator[None]:
    """Serve the page of a run in another process while the block runs. A page that fails or is slow stops no run.

    Args:
        mode: "on", "off": no page, or "keep": after the block, wait until Ctrl-C.
    """
    if mode == "off":
        yield
        return
    context = multiprocessing.get_context("spawn")
    receive, send = context.Pipe(duplex=False)
    process = context.Process(target=_serve, args=(run_dir, send), daemon=True)
    with on_signal(signal.SIGINT, signal.SIG_IGN):  # it takes no notice of Ctrl-C: we end it
        process.start()
    send.close()
    reader = threading.Thread(target=_print_addresses, args=(receive, console), daemon=True)
    reader.start()
    try:
        yield
        reader.join(0 if mode == "on" else PAGE_WAIT_S)
        if mode == "keep":
            console.print("The page stays until Ctrl-C.")
            with suppress(KeyboardInterrupt):
                process.join()
    finally:
        process.terminate()
        process.join()


@contextmanager
def on_signal(number: int, does: Callable[[int, FrameType | None], object] | signal.Handlers) -> Iterator[None]:
    """Have a signal do this while the block runs. In a thread that is not the main one it changes nothing."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(number, does)
    try:
        yield
    finally:
        signal.signal(number, before)


def _serve(run_dir: Path, send: Any) -> None:
    """Serve the page, in its process. Its address goes through a pipe, so that it does not disturb the progress bar."""
    from viewer.page.serve import view

    threading.Thread(target=_end_with_parent, daemon=True).start()
    view(run_dir, say=send.send)


def _end_with_parent() -> None:
    """End this process when its parent has ended, however that happened."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os.kill(os.getpid(), signal.SIGTERM)


def _print_addresses(receive: Any, console: Console) -> None:
    """Print what the page's process sends, until it ends."""
    try:
        while True:
            console.print(receive.recv(), markup=False, soft_wrap=True)
    except EOFError:
        return  # the page has ended
