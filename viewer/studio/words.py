"""Words of the page: its buttons for the remedies of an error, and folders by the names that a visitor knows."""

import os
from pathlib import Path

from capture.errors import Remedy, UserError

_BUTTONS = {  # "": the page has no way to do it
    Remedy.NAME_BOARD: 'choose the board under "Board"',
    Remedy.BOARD_PHOTO: 'choose "board" below the picture that shows it',
    Remedy.LIGHTS_FILE: "drop a file of lights with the photos",
    Remedy.GROUND: "",
    Remedy.COARSER: 'start "A first look"',
    Remedy.OTHER_SEED: "start another run",
    Remedy.START_AGAIN: "",
    Remedy.OTHER_FOLDER: "start another run",
    Remedy.PACK_FAULT: "",
}


def in_page_words(error: Exception) -> str:
    """Return the text of an error with the buttons of the page for what is to be done."""
    return error.worded(lambda one: _BUTTONS.get(one, one.value)) if isinstance(error, UserError) else str(error)


def without_folder(text: str, folder: Path, called: str = "this folder") -> str:
    """Return a sentence with the names of files without this folder: where it lies is the studio's machine's alone."""
    return text.replace(f"{folder}{os.sep}", "").replace(str(folder), called)
