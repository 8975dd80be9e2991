"""What the terminal shows of a run: its progress, and the address of its page, which another process serves."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from reconstruct.run_folder.folder import Progress as Step

PAGE_WAIT_S = 20.0  # for the viewer to send its address: it imports torch, which takes seconds on a busy machine
LINE_EVERY_S = 5.0  # between progress lines where no bar can be drawn


class Display:
    """Shows progress: stage, n of m, time left. In a terminal it draws a bar, elsewhere it prints lines."""

    def __init__(self, console: Console):
        """Draw on this console."""
        columns = (TextColumn("{task.description:<10}"), BarColumn(24), TextColumn("{task.fields[words]}"))
        self.console = console
        self.progress = Progress(*columns, TimeElapsedColumn(), console=console, disable=not console.is_terminal)
        self._task: TaskID | None = None
        self._stage, self._last = "", -LINE_EVERY_S

    def __call__(self, step: Step) -> None:
        """Show one step."""
        is_new = step.stage != self._stage
        self._stage = step.stage
        counts = f"{step.done:g} of {step.total:g}" if step.total > 1 else ""
        eta = "" if step.eta_s is None or step.done >= step.total else f"{step.eta_s:.0f} s left"
        words = ", ".join(part for part in (counts, eta, step.message) if part)
        if self.progress.disable:
            if is_new or not step.numbers or step.t - self._last >= LINE_EVERY_S:
                self._last = step.t
                self.console.print(f"{step.stage}: {words}", markup=False, highlight=False)
            return
        if self._task is None or is_new:
            self._task = self.progress.add_task(step.stage, words=words, total=step.total or None)
        self.progress.update(self._task, completed=step.done, total=step.total or None, words=words)


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
