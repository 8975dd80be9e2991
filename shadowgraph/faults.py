"""The ways in which a command can fail, and the sentence for each."""

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType, TracebackType

from capture.errors import FOR_STUDIO, Remedy, UserError
from capture.files.names import in_one_line
from viewer.studio.words import in_page_words

OPTIONS = {
    Remedy.NAME_BOARD: "--board",
    Remedy.BOARD_PHOTO: 'or session.toml: roles = { board = ["NAME.jpg"] }',
    Remedy.LIGHTS_FILE: "--lights FILE.lp",
    Remedy.GROUND: "--ground HEIGHT",
    Remedy.COARSER: "--preset draft",
    Remedy.OTHER_SEED: "--seed 1",
    Remedy.START_AGAIN: "--force",
    Remedy.OTHER_FOLDER: "--out",
    Remedy.PACK_FAULT: "--debug shows more",
}


class Terminated(KeyboardInterrupt):
    """SIGTERM arrived. It ends a command as Ctrl-C does; the last state is saved."""


@contextmanager
def sigterm_as_ctrl_c() -> Iterator[None]:
    """Raise Terminated on SIGTERM while the block runs. In a thread that is not the main one it changes nothing."""

    def stop(_number: int, _frame: FrameType | None) -> None:
        raise Terminated

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _is_out_of_memory(error: Exception) -> bool:
    """Return whether memory ran out. Torch and OpenCV do not raise MemoryError then."""
    words = ("not enough memory", "can't allocate memory", "out of memory")
    return isinstance(error, MemoryError) or any(text in str(error).lower() for text in words)


def say_fault(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Print where a fault of the program is and what to do: for sys.excepthook, without --debug."""
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    where = f" ({Path(trace.tb_frame.f_code.co_filename).name}, line {trace.tb_lineno})" if trace else ""
    said = in_one_line(f"{kind.__name__}: {error}{where}")
    fault = UserError(f"a fault of the program: {said}. Started again, it goes on from here.", Remedy.PACK_FAULT)
    sys.stderr.write(f"shadowgraph: {sentence_for(fault)}\n")


def _in_words(error: UserError) -> str:
    """Return the text of an error with what to do as options, or as buttons of the studio that started this process."""
    if os.environ.get(FOR_STUDIO) == "1":
        return in_page_words(error)
    return error.worded(lambda one: f"{one.value} ({OPTIONS[one]})" if one in OPTIONS else one.value)


def sentence_for(error: Exception) -> str | None:
    """Say in one sentence what is wrong with the input or the machine; None: it is a fault of the program."""
    if isinstance(error, UserError):  # which may quote a stranger's file: nothing in it commands the terminal
        return in_one_line(_in_words(error))
    if isinstance(error, OSError):  # no room, no right to write, a drive that went away
        return (
            f"{error.filename or 'a file'}: {error.strerror or error}. Check that the place can be written to and has "
            "room; started again, it goes on from here."
        )
    if isinstance(error, RecursionError):
        return "a file that was read is nested without end, which none of ours is. Make the result again."
    if _is_out_of_memory(error):
        said = (str(error) or "nothing left").splitlines()[0]
        found = f"the memory of this machine is used up ({said}). Started again, it goes on from here."
        return _in_words(UserError(found, "close other programs", Remedy.COARSER))
    return None
