"""Names of files.

A name that a file gives lies in that file's folder, or is refused. IMG_9 comes before IMG_10. One frame of a clip has a
path like any other photo's: clip.mov at 12.34 s is clip#t=12.340s.mov. No file has that name: it says which file to
open, and where. The clip's own ending stays at the end, so that stems of frames differ as those of photos do.
"""

import re
from pathlib import Path

from capture.errors import CaptureError

CLIP_SUFFIXES = {".mp4", ".mov", ".m4v", ".3gp", ".mkv", ".webm", ".avi"}
_NAME = re.compile(r"(?P<stem>.+)#t=(?P<seconds>\d+\.\d{3})s")


def inside(folder: Path, name: str, said_by: str) -> Path:
    """The file of that name in a folder or below it.

    Absolute names, `..` and links that lead out of the folder are refused: the list of names may be a stranger's.

    Args:
        said_by: file and field that give the name, for the message.

    Raises:
        CaptureError: it leaves the folder, does not exist, or is no name at all.
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


def natural_order(path: Path) -> list[tuple[int, str]]:
    """A key to sort by: digits in a name count as a number."""
    parts = re.split(r"([0-9]+)", path.name)  # every second part is digits
    return [(int(part) if k % 2 else 0, part) for k, part in enumerate(parts)]


def is_clip_name(path: Path) -> bool:
    """Whether the name ends as a clip's does and is not hidden."""
    return path.suffix.lower() in CLIP_SUFFIXES and not path.name.startswith(".")


def frame_path(clip: Path, time_s: float) -> Path:
    """The path of the frame shown `time_s` after the clip's first one."""
    return clip.with_name(f"{clip.stem}#t={time_s:.3f}s{clip.suffix}")


def clip_of(path: Path) -> tuple[Path, float] | None:
    """The clip and the time in seconds of a frame; None for any other path."""
    match = _NAME.fullmatch(path.stem)
    if match is None or not is_clip_name(path):
        return None
    return path.with_name(match["stem"] + path.suffix), float(match["seconds"])


def stored_file(path: Path) -> Path:
    """The file on disk behind a photo's path: the clip for a frame, else the path itself."""
    found = clip_of(path)
    return path if found is None else found[0]
