"""Pictures in a capture that are not read, and must not be missed in silence: other formats, names that are no text.

The photos and clips that a capture folder holds, by their names; nothing is opened.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from capture.decode.formats import is_photo_name
from capture.errors import CaptureError
from capture.files.names import is_clip_name, natural_order
from capture.session.sorting import MASK, ROLE_FOLDERS

OTHER_FORMATS = re.compile(
    r"\.(jxl|webp|gif|bmp|jp2|j2k|jpf|jpx|jxr|wdp|bpg|hdr|p[bgnp]m|pfm|tga|psd|mpo|jps|insp|lfr"
    r"|gpr|iiq|3fr|fff|erf|mrw|nrw|sr2|srf|x3f|rwl|mef|mos|dcr|crw)",  # cameras' own
    re.IGNORECASE,
)


def photos_of(capture: Path) -> list[Path]:
    """Return the photos of a capture, folder by folder, in the natural order of their names; no mask."""
    found: list[Path] = []
    for place in (capture, *(capture / name for name in ROLE_FOLDERS.values())):
        if place.is_dir():
            mine = [path for path in place.iterdir() if is_photo_name(path) and path.name != MASK and path.is_file()]
            found += sorted(mine, key=natural_order)
    return found


def folder_role(photo: Path, capture: Path) -> str:
    """Return the role that a photo's folder gives it; "" for one in the capture itself."""
    return next((role for role, name in ROLE_FOLDERS.items() if photo.parent == capture / name), "")


def clips_of(capture: Path) -> list[Path]:
    """Return the clips of a capture."""
    places = [place for place in (capture, capture / ROLE_FOLDERS["lit"]) if place.is_dir()]
    return [path for place in places for path in sorted(place.iterdir()) if is_clip_name(path) and path.is_file()]


def skipped_pictures(folder: Path) -> str:
    """Return a sentence on the pictures that are not read in a capture's folders; or ""."""
    places = [place for place in (folder, *(folder / name for name in ROLE_FOLDERS.values())) if place.is_dir()]
    found = [path for place in places for path in sorted(place.iterdir()) if _is_skipped(path) and path.is_file()]
    if not found:
        return ""
    first = _as_text(found[0]).name + (f" and {len(found) - 1} more" if len(found) > 1 else "")
    return f"skipped, because they cannot be read: {first}. Export them as JPEG, PNG, TIFF or DNG, under plain names."


@contextmanager
def naming_skipped(folder: Path) -> Iterator[tuple[str, ...]]:
    """Yield what is to be noted of skipped pictures; an error of the block ends with it, too."""
    said = skipped_pictures(folder)
    try:
        yield (said,) if said else ()
    except CaptureError as error:
        if not said:
            raise
        raise type(error)(f"{error} Pictures were {said}") from error


def _is_skipped(path: Path) -> bool:
    is_photo = is_photo_name(_as_text(path)) and not is_photo_name(path)
    return not path.name.startswith(".") and (is_photo or OTHER_FORMATS.fullmatch(path.suffix) is not None)


def _as_text(path: Path) -> Path:
    return path.with_name(path.name.encode("utf-8", "replace").decode())
