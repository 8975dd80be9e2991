"""The name of one frame of a clip: clip.mov at 12.34 s is clip#t=12.340s.mov, a path like any other photo's.

No file has that name: it says which file to open, and where. The clip's own ending stays at the end, so that stems of
frames differ as those of photos do.
"""

import re
from pathlib import Path

CLIP_SUFFIXES = {".mp4", ".mov", ".m4v", ".3gp", ".mkv", ".webm", ".avi"}
_NAME = re.compile(r"(?P<stem>.+)#t=(?P<seconds>\d+\.\d{3})s")


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
