"""Pictures in a capture that are not read, and must not be missed in silence: other formats, names that are no text."""

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from capture.decode.formats import is_photo_name
from capture.errors import CaptureError

OTHER_FORMATS = re.compile(
    r"\.(jxl|webp|gif|bmp|jp2|j2k|jpf|jpx|jxr|wdp|bpg|hdr|p[bgnp]m|pfm|tga|psd|mpo|jps|insp|lfr"
    r"|gpr|iiq|3fr|fff|erf|mrw|nrw|sr2|srf|x3f|rwl|mef|mos|dcr|crw)",  # cameras' own
    re.IGNORECASE,
)


def skipped_pictures(folder: Path, below: Iterable[str]) -> str:
    """Return a sentence on the pictures that are not read in a folder, and in folders of these names in it; or ""."""
    places = [place for place in (folder, *(folder / name for name in below)) if place.is_dir()]
    found = [path for place in places for path in sorted(place.iterdir()) if _is_skipped(path) and path.is_file()]
    if not found:
        return ""
    first = _as_text(found[0]).name + (f" and {len(found) - 1} more" if len(found) > 1 else "")
    return f"skipped, because they cannot be read: {first}. Export them as JPEG, PNG, TIFF or DNG, under plain names."


@contextmanager
def naming_skipped(folder: Path, below: Iterable[str]) -> Iterator[tuple[str, ...]]:
    """Yield what is to be noted of skipped pictures; an error of the block ends with it, too."""
    said = skipped_pictures(folder, below)
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
