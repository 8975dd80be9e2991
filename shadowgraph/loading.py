"""Load the program's packages without looking for garbage among what they make, all of which stays."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def loading() -> Iterator[None]:
    """Import what a command needs in this block; the garbage collector never looks at what is there at its first end.

    torch and the packages that come with it make a million objects, and the collector would go through them again and
    again, half a CPU second until they are loaded, and at every later collection.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if not gc.get_freeze_count():  # what a program that calls commands has made since may be garbage
            gc.freeze()
        if was_on:
            gc.enable()
