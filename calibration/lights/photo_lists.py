"""Match photos to rows of a list of lights, in folders whose files give the match loosely or not at all."""

import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from capture.decode.formats import is_photo_name
from capture.errors import CalibrationError
from capture.files.names import natural_order
from capture.session.session import ROLE_FOLDERS

NOT_A_PHOTO = re.compile(r"(^|[^a-z])(mask|normal|normals|depth|albedo|silhouette)([^a-z]|$)", re.IGNORECASE)
DARK = ROLE_FOLDERS["dark"]
NAMED, LONGEST = 5, 60  # files listed in a message, and letters of each name


def bare(name: str) -> str:
    """Return a photo's name without folders and ending, in lower case, for comparison with lists."""
    return PurePosixPath(name.replace("\\", "/")).stem.lower()


def photos_in(folder: Path) -> list[Path]:
    """The folder's photos in natural order, without masks and maps."""
    if not folder.is_dir():
        return []
    paths = [p for p in folder.iterdir() if is_photo_name(p) and p.is_file() and not NOT_A_PHOTO.search(p.stem)]
    return sorted(paths, key=natural_order)


def folders_of(folder: Path) -> list[Path]:
    """Return the folder and its subfolders by name, where lit photos may lie; links that lead outside are left out."""
    root = folder.resolve()
    below = sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith(".") and p.name != DARK)
    return [folder, *(p for p in below if p.resolve().is_relative_to(root))]


def dark_photos(folder: Path, photos: Sequence[Path]) -> list[Path]:
    """Return the photos without light in dark/, in the folder of a scene or beside its photos."""
    return photos_in(folder / DARK) or photos_in(photos[0].parent / DARK)


def match(names: Sequence[str | None], folders: Sequence[Path], source: Path) -> tuple[list[Path], str]:
    """Return the photo of each row of a list, and how it was found.

    Photos are matched by name in the first folder that has them all. Otherwise, if one folder has as many photos as the
    list has rows and none of the names, they are matched by order.

    Raises:
        CalibrationError: neither; gives the numbers of photos and rows, and the missing name.
    """
    stocks = [(folder, photos_in(folder)) for folder in folders]
    wanted = [bare(name) for name in names if name is not None]
    if len(wanted) == len(names):
        if len(set(wanted)) < len(wanted):
            twice = next(name for name in wanted if wanted.count(name) > 1)
            raise CalibrationError(f"{source} lists {twice[:LONGEST]!r} twice; one line for each photo was needed.")
        for _, photos in stocks:
            by_name: dict[str, Path] = {}
            for path in photos:
                by_name.setdefault(bare(path.name), path)
            if set(wanted) <= set(by_name):
                return [by_name[name] for name in wanted], "by name"
    folder, photos = max(stocks, key=lambda stock: len(stock[1]))
    known = {bare(path.name) for path in photos}
    missing = [name for name in wanted if name not in known]
    if len(photos) == len(names) and len(missing) in (0, len(names)):
        return photos, "by order, because the names in the list are not those of the photos" if missing else "by order"
    listed = ", ".join(name[:LONGEST] for name in missing[:NAMED]) + (", ..." if len(missing) > NAMED else "")
    raise CalibrationError(
        f"{source} lists {len(names)} lights and {folder} holds {len(photos)} photos"
        + (f", of which {len(names) - len(missing)} are in the list; it lacks {listed}" if missing else "")
        + ". Equal names were needed, or equally many photos and lines in the same order."
    )
