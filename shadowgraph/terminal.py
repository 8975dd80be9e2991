"""What the terminal shows of a run: its progress, and the address of its page, which another process serves."""

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from reconstruct.run_folder.folder import Progress as Step

PAGE_WAIT_S = 20.0  # for the viewer to send its address: it imports torch, which takes seconds on a busy machine
LINE_EVERY_S = 4.0  # between progress lines where no bar can be drawn: nobody looks at a still screen for over 5 s
FIRST_LINE_S = 1.0  # after the start, which itself took a second or two; a quick refusal stands alone
LOOK_EVERY_S = 0.25  # whether a line is due


class Display:
    """Shows progress: stage, n of m, time left. In a terminal it draws a bar, elsewhere it prints lines.

    Where it prints lines and a step takes long, `beat` says for how long, and at what. This is for the eye alone: the
    run's log does not have it.
    """

    def __init__(self, console: Console, clock: Callable[[], float] = time.monotonic):
        """Draw on this console; `clock` tells seconds."""
        columns = (TextColumn("{task.description:<10}"), BarColumn(24), TextColumn("{task.fields[words]}"))
        self.console = console
        self.progress = Progress(*columns, TimeElapsedColumn(), console=console, disable=not console.is_terminal)
        self._task: TaskID | None = None
        self._clock, self._one_at_a_time = clock, threading.Lock()
        self._stage, self._doing = "", ""  # what is being done; "" while the run waits
        self._since = self._last = clock()  # since when, and when a line was printed

    def __call__(self, step: Step) -> None:
        """Show one step."""
        is_new = step.stage != self._stage
        counts = f"{step.done:g} of {step.total:g}" if step.total > 1 else ""
        eta = "" if step.eta_s is None or step.done >= step.total else f"{step.eta_s:.0f} s left"
        words = ", ".join(part for part in (counts, eta, step.message) if part)
        with self._one_at_a_time:
            self._stage, self._doing, self._since = step.stage, words, self._clock()
            if self.progress.disable:
                if is_new or not step.numbers or self._since - self._last >= LINE_EVERY_S:
                    self._print(words)
                return
            if self._task is None or is_new:
                self._task = self.progress.add_task(step.stage, words=words, total=step.total or None)
            self.progress.update(self._task, completed=step.done, total=step.total or None, words=words)

    def activity(self, sentence: str) -> None:
        """Show what is done until the next step; an empty sentence: the run waits, and nothing is to be said."""
        with self._one_at_a_time:
            self._doing, self._since = sentence, self._clock()
            if self._task is not None and sentence:
                self.progress.update(self._task, words=sentence)

    def beat(self) -> None:
        """Print what is being done, and for how long, if no line was printed for LINE_EVERY_S."""
        with self._one_at_a_time:
            now = self._clock()
            if self.progress.disable and self._doing and now - self._last >= LINE_EVERY_S:
                seconds = now - self._since
                self._print(f"{self._doing}, {seconds:.0f} s so far" if seconds >= 1 else self._doing)

    @contextmanager
    def beating(self, sentence: str) -> Iterator[None]:
        """Beat while the block runs, which begins with what the sentence says; it may draw the bar in between."""
        self.activity(sentence)
        self._last = self._clock() + FIRST_LINE_S - LINE_EVERY_S
        ended = threading.Event()
        thread = threading.Thread(target=_call_until, args=(self.beat, ended), name="heartbeat", daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()

    def _print(self, words: str) -> None:
        self._last = self._clock()
        text = f"{self._stage}: {words}" if self._stage else words
        print_lines(self.console, text)


def _call_until(beat: Callable[[], None], ended: threading.Event) -> None:
    while not ended.wait(LOOK_EVERY_S):
        beat()


def print_lines(console: Console, *lines: str) -> None:
    """Print lines as they are: nothing in them is markup, and none is broken."""
    for line in lines:
        console.print(line, markup=False, highlight=False, soft_wrap=True)


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
