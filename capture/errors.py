"""Errors that are the user's data's fault: what, where and what to do; exit code 2, no traceback."""

from collections.abc import Callable
from enum import Enum

FOR_STUDIO = "SHADOWGRAPH_FOR_STUDIO"  # variable of the environment: "1" for processes whose errors the studio shows


class Remedy(Enum):
    """Something to do that each front end has its own way for; the value says it where there is none."""

    NAME_BOARD = "name the board, such as checkerboard:9x6:24.25, or paper:A4 if it is a blank sheet"
    BOARD_PHOTO = "put the board's photo into board/"
    LIGHTS_FILE = "give a file of lights"
    GROUND = "give the ground's height"
    COARSER = "choose a coarser preset"
    OTHER_SEED = "start again with another seed"
    START_AGAIN = "start again in this folder"
    OTHER_FOLDER = "name another folder for the results"
    PACK_FAULT = "report it with what `shadowgraph report RUN --bundle fault.zip` packs"


class UserError(Exception):
    """The input is at fault.

    `found` says what was measured, what was needed and where; each of `remedies` is something to do next, in the words
    of a command: a text that serves every reader, or a Remedy, which a front end says in its own words.
    """

    def __init__(self, found: str, *remedies: str | Remedy):
        """Keep the fields; the text of the error is worded for a program that catches it."""
        super().__init__(found, *remedies)
        self.found, self.remedies = found, remedies

    def worded(self, say: Callable[[Remedy], str]) -> str:
        """Return the sentences for one front end; `say` returns its words for a remedy, "" for one that it lacks."""
        said = [say(one) if isinstance(one, Remedy) else one for one in self.remedies]
        ways = ", or ".join(filter(None, said))
        return f"{self.found} {ways[0].upper()}{ways[1:]}." if ways else self.found

    def __str__(self) -> str:
        return self.worded(lambda remedy: remedy.value)


class CaptureError(UserError):
    """A photo or a capture folder cannot be used."""


class CalibrationError(UserError):
    """Camera, ground or lights cannot be found from these photos."""


class ReconstructionError(UserError):
    """No surface can be reconstructed from these photos."""
