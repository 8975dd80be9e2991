"""The title of a capture or run: what a person typed, kept with the folder; without it, the folder's name."""

import re
from pathlib import Path

from capture.errors import CaptureError
from capture.files.atomic import atomic_file
from capture.files.names import DEVICES, in_one_line
from capture.files.regular import read_regular

TITLE = ".title"  # in the folder of a capture or run, UTF-8; no input of a run: a title may change while one waits
LONGEST = 120  # letters
LONGEST_NAME = 200  # bytes: systems take 255, and an ending is still to come
_NOT_IN_NAMES = re.compile(r'[<>:"/\\|?*\x00-\x1f\x7f]')  # of files on Windows, and on others


def title_of(folder: Path, *others: Path) -> str:
    """Return the title that is kept with a folder, else with one of the others, else the folder's name."""
    titles = filter(None, map(_kept, (folder, *others)))
    return next(titles, folder.resolve().name)


def keep_title(folder: Path, title: str) -> None:
    """Keep a title with a folder.

    Raises:
        CaptureError: it has no letter.
        OSError: the folder cannot be written to.
    """
    with atomic_file(folder / TITLE) as temporary:
        temporary.write_text(plain_title(title), encoding="utf-8")


def plain_title(title: str) -> str:
    """Return a title on one line, without what no page can show.

    Raises:
        CaptureError: it has no letter.
    """
    if not (shown := " ".join(in_one_line(title).split())[:LONGEST].strip()):
        raise CaptureError("A title of at least one letter is needed.")
    return shown


def hand_title_on(capture: Path, run: Path) -> None:
    """Give a run the title of its capture, where that has one and the run has none.

    Raises:
        OSError: the run's folder cannot be written to.
    """
    if (title := _kept(capture)) and not _kept(run):
        keep_title(run, title)


def file_stem(folder: Path) -> str:
    """Return a folder's title as the name of a file to save, without a suffix."""
    return as_name(title_of(folder), folder.resolve().name)


def as_name(title: str, otherwise: str) -> str:
    """Return a title as the name of a file or folder, as every system takes it; `otherwise` where nothing is left."""
    name = _NOT_IN_NAMES.sub("-", plain_title(title)).encode()[:LONGEST_NAME].decode("utf-8", "ignore").strip(" .")
    return f"_{name}" if DEVICES.fullmatch(name) else name if name.strip("-") else otherwise


def _kept(folder: Path) -> str:
    try:
        return plain_title(read_regular(folder / TITLE, 8 * LONGEST).decode("utf-8", "replace"))
    except (OSError, CaptureError):  # none, or a stranger's link or device
        return ""
