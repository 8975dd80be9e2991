"""The command `shadowgraph`, also as `python -m shadowgraph` or, from a checkout that is not installed, by its path."""

import os
import signal
import sys
from pathlib import Path
from types import FrameType

if not __package__:  # started by its path: the checkout is where the other packages are
    sys.path[0] = str(Path(__file__).resolve().parents[1])

OUTPUT = 1  # the number of the standard output
CLOSED = 128 + 13  # the exit code of a command that SIGPIPE ends, which Windows does not know
SHOW_CURSOR = b"\x1b[?25h"  # a progress bar hides it


def start() -> int:
    """Do what the command line asks for and return the exit code; see `shadowgraph.command.main`.

    Ctrl-C ends a command, which saves its state; a second one ends the process at once, as `kill -9` does. Neither
    prints a traceback, wherever it arrives: while packages are loaded, at work, or at the end.
    """
    is_heard = signal.getsignal(signal.SIGINT) != signal.SIG_IGN  # a shell lets it pass by what runs behind it
    signal.signal(signal.SIGINT, _stop if is_heard else signal.SIG_IGN)
    try:
        from shadowgraph.command import main

        return main()
    except KeyboardInterrupt:  # before the command had begun
        return 128 + signal.SIGINT
    except BrokenPipeError:  # who reads the output, as `head` does, has seen enough
        os._exit(CLOSED)  # Python would print another traceback when it flushes the output at the end
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL if is_heard else signal.SIG_IGN)


def _stop(_number: int, _frame: FrameType | None) -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    if os.isatty(OUTPUT):
        os.write(OUTPUT, SHOW_CURSOR)
    raise KeyboardInterrupt


if __name__ == "__main__":
    sys.exit(start())
