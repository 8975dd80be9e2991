"""Names of files.

A name that is read from a file must stay in that file's folder. Names are sorted naturally: IMG_9 before IMG_10. A
frame of a clip has a path like a photo's: clip.mov at 12.34 s is clip#t=12.340s.mov. No file has that name; it states
the clip and the time. The clip's suffix stays at the end, so that the stems of frames are unique, as those of photos.
"""

import difflib
import re
from contextlib import suppress
from pathlib import Path

from capture.errors import CaptureError

DEVICES = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)", re.IGNORECASE)  # names that Windows keeps for devices
CLIP_SUFFIXES = {".mp4", ".mov", ".m4v", ".3gp", ".mkv", ".webm", ".avi"}
_NAME = re.compile(r"(?P<stem>.+)#t=(?P<seconds>\d+\.\d{3})s")


def inside(folder: Path, name: str, said_by: str) -> Path:
    """Return the path of a named file in a folder or below it.

    Absolute names, `..` and links that lead out of the folder are refused, because the names may be untrusted.

    Args:
        said_by: file and field that give the name, for the message.

    Raises:
        CaptureError: the path leaves the folder, does not exist, or the name is invalid.
    """
    shown = repr(name if len(name) <= 80 else name[:77] + "...")
    try:
        path = folder / name
        stays, exists = path.resolve().is_relative_to(folder.resolve()), path.is_file()
    except (OSError, ValueError, RuntimeError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else type(error).__name__
        raise CaptureError(f"{said_by} {shown} is no file name ({reason}); a file in {folder} was needed.") from error
    if not stays:
        raise CaptureError(f"{said_by} {shown} leaves the folder {folder}; keep all files in it.")
    if not exists:
        raise CaptureError(
            f"{said_by} names {shown}, which does not exist in {folder}; complete the folder, or correct the name."
        )
    return path


def refuse_no_folder(path: Path, needed: str) -> None:
    """Refuse a path that is no folder, and name a folder with a similar name if there is one.

    Args:
        needed: "the folder that holds the photos".

    Raises:
        CaptureError: it is none.
    """
    if path.is_dir():
        return
    if path.exists():
        raise CaptureError(f"{path} is a file, not a folder; {needed} was needed.")
    meant = similar_folder(path)
    hint = f"did you mean {meant}?" if meant else f"{needed} was needed."
    raise CaptureError(f"{path} is not a folder; {hint}")


def similar_folder(path: Path) -> Path | None:
    """Return the folder whose path is spelt most like a path that is none; None where no name is like it."""
    here = Path(path.anchor)
    for part in path.parts[1 if path.anchor else 0 :]:
        if not (here / part).is_dir():
            names: dict[str, str] = {}
            with suppress(OSError):  # a folder that may not be listed
                names = {each.name.casefold(): each.name for each in here.iterdir() if each.is_dir()}
            near = difflib.get_close_matches(part.casefold(), names, 1)
            if not near:
                return None
            part = names[near[0]]
        here /= part
    return here


def in_one_line(text: str) -> str:
    """Return a text that may hold strangers' names, with nothing left in it that breaks or turns a line."""
    return "".join(letter if letter.isprintable() else " " for letter in text)


def natural_order(path: Path) -> list[tuple[int, str]]:
    """Return a sort key in which the digits of a name count as numbers."""
    parts = re.split(r"([0-9]+)", path.name)  # every second part is digits
    return [(int(part) if k % 2 else 0, part) for k, part in enumerate(parts)]


def is_shown(path: Path) -> bool:
    """Return whether a name is not hidden, and text: one of other bytes cannot be printed, sent or written down."""
    return not path.name.startswith(".") and not any("\ud800" <= letter <= "\udfff" for letter in path.name)


def is_clip_name(path: Path) -> bool:
    """Return whether a name has the suffix of a clip and is shown."""
    return path.suffix.lower() in CLIP_SUFFIXES and is_shown(path)


def frame_path(clip: Path, time_s: float) -> Path:
    """Return the path of the frame that is shown `time_s` after the clip's first frame."""
    return clip.with_name(f"{clip.stem}#t={time_s:.3f}s{clip.suffix}")


def clip_of(path: Path) -> tuple[Path, float] | None:
    """Return the clip and the time (s) of a frame's path; None for any other path."""
    match = _NAME.fullmatch(path.stem)
    if match is None or not is_clip_name(path):
        return None
    return path.with_name(match["stem"] + path.suffix), float(match["seconds"])


def stored_file(path: Path) -> Path:
    """Return the file on disk for a photo's path: the clip for a frame, else the path itself."""
    found = clip_of(path)
    return path if found is None else found[0]
