"""The photos and clips that a capture folder holds, by their names; nothing is opened."""

from pathlib import Path

from capture.decode.formats import is_photo_name
from capture.files.names import is_clip_name, natural_order
from capture.session.sorting import MASK, ROLE_FOLDERS


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
